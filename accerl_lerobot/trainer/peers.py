# SPDX-License-Identifier: Apache-2.0
"""The trainer's other ranks: processes that make each update along with the first, which the engine talks to.

    replay ──batch──► rank 0 ──its reference──► ranks 1, 2 …
                        ◄── torch.distributed: values, gradients, parts of weights ──►

What takes all ranks is done within `Peers.joining`: the others are told, do the same, and are waited for. One
that dies or hangs ends the wait, after `SHARE` of ``launch.stall_s`` at the latest, and the error names it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import ray
from ray.exceptions import RayActorError, RayError

from accerl_lerobot import errors
from accerl_lerobot.algorithms import AlgorithmConfig
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import WEIGHTS
from accerl_lerobot.experience import Segment
from accerl_lerobot.fault_points import fault_point
from accerl_lerobot.policies.config import Load, PolicyConfig, loader
from accerl_lerobot.trainer.config import TrainerConfig

if TYPE_CHECKING:
    from accerl_lerobot.trainer.ranks import Ranks, Rendezvous
    from accerl_lerobot.trainer.update import BaseUpdate

LOAD_S = 600.0  # how long a rank may take to load its policy
SHARE = 0.4
"""Share of ``launch.stall_s`` for which a rank waits for the others, so that the lost one is named first."""
PATIENCE = 0.9  # share of that after which the first rank has waited for another
BLAME_S = 10.0  # how long to wait for the failure that the first rank's own is the consequence of


class RankError(RuntimeError):
    """A rank is lost, or was not there in time."""


class LearnerSettings(NamedTuple):
    """How each rank makes its policy, and the updates of it."""

    policy: PolicyConfig  # the checkpoint to start from
    algorithm: AlgorithmConfig
    trainer: TrainerConfig
    seed: int  # seed of torch's global generator
    state: Path | None = None  # the ``training_state`` to resume from; None: begin
    load: Load | None = None  # makes the adapter; None: of LeRobot's checkpoint
    timeout_s: float = 120.0  # how long a rank waits for the others within an update

    def adapter(self) -> Any:
        import torch

        torch.set_num_threads(self.trainer.num_threads)
        torch.manual_seed(self.seed)
        return loader(self.load)(self.policy)

    def begin(self, adapter: Any, ranks: Ranks) -> BaseUpdate:
        """The updates, from the state on; what ranks share out is shared out then."""
        from accerl_lerobot.trainer.update import make_update

        update = make_update(adapter, self.algorithm, self.trainer, ranks)
        if self.state is not None:
            adapter.load_trainable(snapshot.load(self.state / WEIGHTS))
            update.restore(snapshot.load(self.state / "trainer"))
        return update


class TrainerRank:
    """Any rank but the first; becomes a Ray actor of one thread, so that calls are done in their order."""

    def __init__(self, rank: int, settings: LearnerSettings) -> None:
        errors.collect_warnings()
        self._rank, self._settings, self._adapter = rank, settings, settings.adapter()

    def ready(self) -> int:
        """Answers once the policy is loaded; returns this process's id."""
        return os.getpid()

    def node(self) -> str:
        return str(ray.get_runtime_context().get_node_id())

    def metrics(self) -> dict[str, float]:
        """Nothing: the first rank reports for all. Answering shows that it is not stuck."""
        return {}

    def join(self, rendezvous: Rendezvous) -> None:
        from accerl_lerobot.trainer import ranks

        size, timeout_s = self._settings.trainer.ranks, self._settings.timeout_s
        here = rendezvous.address == ranks.LOOPBACK
        ranks.use_only(ranks.LOOPBACK if here else ray.util.get_node_ip_address())
        store = ranks.join(rendezvous, size, timeout_s)
        group = ranks.Group(store, self._rank, size, self._adapter.device, timeout_s)
        self._update = self._settings.begin(self._adapter, group)

    def step(self, segments: Sequence[Segment]) -> None:
        fault_point("rank.step")
        self._update.step(segments)

    def lend_weights(self) -> None:
        """Its part of the trainable weights, for the first rank to export."""
        from accerl_lerobot.checkpoint.tensors import lending

        with lending():
            self._adapter.export_trainable()

    def lend_state(self) -> None:
        """Its part of all that is saved, in the order in which the first rank asks for it."""
        from accerl_lerobot.checkpoint.tensors import lending

        with lending():
            self._adapter.copy_weights()
            self.lend_weights()
            self._update.state()


class Peers:
    """The others, as the first rank sees them: `actors` are handles of `TrainerRank`, of rank 1, 2 …."""

    def __init__(self, actors: Sequence[Any], config: TrainerConfig, timeout_s: float) -> None:
        self._actors, self._config, self._timeout_s = list(actors), config, timeout_s

    def begin(self, settings: LearnerSettings) -> BaseUpdate:
        """Loads the first rank's policy and meets the others, once they have loaded theirs."""
        from accerl_lerobot.trainer import ranks

        adapter = settings.adapter()
        if not self._actors:
            return settings.begin(adapter, ranks.ALONE)
        # Actors of one thread: by then they have loaded their policies.
        nodes = _collect("node", [actor.node.remote() for actor in self._actors], LOAD_S)
        address = ranks.LOOPBACK
        if set(nodes) != {str(ray.get_runtime_context().get_node_id())}:
            address = ray.util.get_node_ip_address()
        ranks.use_only(address)
        size, timeout_s = self._config.ranks, self._timeout_s
        store, rendezvous = ranks.create(address, size, timeout_s)
        with self.joining("join", rendezvous):
            return settings.begin(adapter, ranks.Group(store, 0, size, adapter.device, timeout_s))

    @contextmanager
    def joining(self, method: str, *arguments: Any) -> Iterator[None]:
        """They do `method` while the first rank does its part inside.

        Raises:
            RankError: one of them failed, with its traceback, or was not there in time.
        """
        calls = [getattr(actor, method).remote(*arguments) for actor in self._actors]
        began = time.monotonic()
        try:
            yield
        except Exception as error:
            # Who waits for the first rank is silent too: it is another's silence only if it was waited for.
            waited = time.monotonic() - began > PATIENCE * self._timeout_s
            if calls and (lost := _failure(method, calls, silence=waited, own=error)) is not None:
                raise lost from error
            raise
        if calls:
            _collect(method, calls, self._timeout_s)

    def lending(self, method: str) -> AbstractContextManager[None]:
        """As `joining`, for what takes all ranks only where each keeps a part of the weights."""
        return self.joining(method) if self._config.zero else nullcontext()


def _collect(method: str, calls: list[Any], timeout_s: float) -> list[Any]:
    try:
        return list(ray.get(calls, timeout=timeout_s))
    except RayError as error:  # no answer in time is one, too
        raise _failure(method, calls) or error from error


def _failure(
    method: str, calls: list[Any], silence: bool = True, own: Exception | None = None
) -> RankError | None:
    """The others' fault, if any: first of the dead, then, if `silence` is one, of the silent, then the rest.

    `own` is what the first rank has raised; what all ranks raise alike is not theirs.
    """
    done, silent = ray.wait(calls, num_returns=len(calls), timeout=BLAME_S)
    failures: dict[Any, RayError] = {}
    for call in done:
        try:
            ray.get(call)
        except RayError as error:
            failures[call] = error
    # A process that is gone made the others fail; what they say of it is only that it is gone.
    guilty = [call for call, error in failures.items() if isinstance(error, RayActorError)]
    if not guilty and silent and silence:
        names = ", ".join(f"rank {calls.index(call) + 1}" for call in silent)
        return RankError(f"trainer {names} did not do {method}: no answer")
    alike = {
        call for call, error in failures.items() if own and type(getattr(error, "cause", 0)) is type(own)
    }
    guilty += [call for call in failures if call not in alike]
    if not guilty:
        return None
    return RankError(f"trainer rank {calls.index(guilty[0]) + 1} failed in {method}:\n{failures[guilty[0]]}")
