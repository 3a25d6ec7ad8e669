# SPDX-License-Identifier: Apache-2.0
"""The trainer's other ranks: processes that make each update along with the first, which the engine talks to.

    replay ──batch──► rank 0 ──its reference──► ranks 1, 2 …
                        ◄── torch.distributed: values, gradients, parts of weights ──►

Work of all ranks is done within `Peers.joining`: the others are told, do the same, and are waited for. A
rank that is lost ends the wait, after `SHARE` of ``launch.stall_s`` at the latest, and with it the trainer.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import ray

from accerl_lerobot import errors
from accerl_lerobot.algorithms import AlgorithmConfig
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import WEIGHTS
from accerl_lerobot.experience import Metrics, Segment
from accerl_lerobot.fault_points import fault_point
from accerl_lerobot.policies.config import Load, PolicyConfig, loader

if TYPE_CHECKING:
    from accerl_lerobot.algorithms.ratio_update import BaseUpdate

LOAD_S = 600.0  # how long a rank may take to load its policy
SHARE = 0.4
"""Share of ``launch.stall_s`` for which a rank waits for the others, so that the trainer ends by itself."""


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

    def begin(self, adapter: Any) -> BaseUpdate:
        """The updates, from the state on, once all ranks have come together."""
        from accerl_lerobot.algorithms.ratio_update import make_update

        update = make_update(adapter, self.algorithm, self.trainer)
        if self.state is not None:
            adapter.load_trainable(snapshot.load(self.state / WEIGHTS))
            update.restore(snapshot.load(self.state / "trainer"))
        return update


class TrainerRank:
    """Any rank but the first; becomes a Ray actor of one thread, so that calls are done in their order."""

    def __init__(self, rank: int, settings: LearnerSettings) -> None:
        errors.collect_warnings()
        self._rank = rank
        self._settings = settings
        self._adapter = settings.adapter()

    def ready(self) -> int:
        """Answers once the policy is loaded; returns this process's id."""
        return os.getpid()

    def node(self) -> str:
        return str(ray.get_runtime_context().get_node_id())

    def metrics(self) -> Metrics:
        """Nothing: the first rank reports for all. Answering shows that it is not stuck."""
        return {}

    def join(self, address: str, port: int) -> None:
        from accerl_lerobot.algorithms import ranks

        size = self._settings.trainer.ranks
        timeout_s = self._settings.timeout_s
        own_address = address
        if address != ranks.LOOPBACK:
            own_address = ray.util.get_node_ip_address()
        ranks.use_only(own_address)
        store = ranks.store_at(address, port, size, timeout_s)
        ranks.join(store, self._rank, size, self._adapter.device, timeout_s)
        self._update = self._settings.begin(self._adapter)

    def step(self, segments: Sequence[Segment]) -> None:
        fault_point("rank.step")
        self._update.step(segments)

    def gather_weights(self) -> None:
        """Its part of the trainable weights, for the first rank to export."""
        self._adapter.export_trainable()

    def gather_state(self) -> None:
        """Its part of all that is saved, in the order in which the first rank asks for it."""
        self._adapter.copy_weights()
        self._adapter.export_trainable()
        self._update.state()


class Peers:
    """The others, as the first rank sees them: `actors` are handles of `TrainerRank`, of rank 1, 2 …."""

    def __init__(self, actors: Sequence[Any], config: TrainerConfig, timeout_s: float) -> None:
        self._actors = list(actors)
        self._config = config
        self._timeout_s = timeout_s

    def begin(self, settings: LearnerSettings) -> BaseUpdate:
        """Loads the first rank's policy and meets the others, once they have loaded theirs."""
        from accerl_lerobot.algorithms import ranks

        adapter = settings.adapter()
        if not self._actors:
            return settings.begin(adapter)
        # Actors of one thread: by then they have loaded their policies.
        nodes = ray.get([actor.node.remote() for actor in self._actors], timeout=LOAD_S)
        this_node = str(ray.get_runtime_context().get_node_id())
        address = ranks.LOOPBACK
        if set(nodes) != {this_node}:
            address = ray.util.get_node_ip_address()
        ranks.use_only(address)
        size = self._config.ranks
        store, port = ranks.open_store(address, size, self._timeout_s)
        with self.joining("join", address, port):
            ranks.join(store, 0, size, adapter.device, self._timeout_s)
            return settings.begin(adapter)

    @contextmanager
    def joining(self, method: str, *arguments: Any) -> Iterator[None]:
        """They do `method` while the first rank does its part inside; an error of theirs is raised here."""
        calls = [getattr(actor, method).remote(*arguments) for actor in self._actors]
        yield
        if calls:
            ray.get(calls, timeout=self._timeout_s)

    def gathering(self, method: str) -> AbstractContextManager[None]:
        """As `joining`, for work of all ranks only where each keeps a part of the weights."""
        if self._config.zero:
            return self.joining(method)
        return nullcontext()
