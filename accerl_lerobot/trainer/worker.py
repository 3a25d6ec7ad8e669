# SPDX-License-Identifier: Apache-2.0
"""The trainer process. The length of a run is counted in its updates.

consumes    batches of segments from replay, the next one drawn while the current one is learned from
produces    weights, published after each update for the replicas that ask, also after the last update
waits for   a batch
ends        after `updates` updates, or when replay is closed

Replicas of the policy get weights from a `WeightPublisher`, through Ray's object store.

The trainer may have other ranks, processes that make each update along with the first:

    replay ──batch──► rank 0 ──its reference──► ranks 1, 2 …
                        ◄── torch.distributed: values, gradients, parts of weights ──►

Work of all ranks is done within `Peers.joining`: the others are told, do the same, and are waited for. A
rank that is lost ends the wait, after `RANK_WAIT_SHARE` of ``launch.stall_s`` at the latest, and with it the
trainer.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import ray

from accerl_lerobot import errors
from accerl_lerobot.algorithms import AlgorithmConfig
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import PRETRAINED, TRAINING_STATE, WEIGHTS
from accerl_lerobot.experience import Metrics, Segment, Tensors
from accerl_lerobot.fault_points import fault_point
from accerl_lerobot.policies.config import Load, PolicyConfig, loader
from accerl_lerobot.replay.buffer import ASYNCHRONOUS, Schedule
from accerl_lerobot.timeline import CHECKPOINT, COMPUTE, TRANSPORT, WAIT_IN, WEIGHT_SYNC, open_clock

if TYPE_CHECKING:
    from accerl_lerobot.algorithms.update import BaseUpdate

LOAD_S = 600.0  # how long a rank may take to load its policy
RANK_WAIT_SHARE = 0.4
"""Share of ``launch.stall_s`` for which a rank waits for the others: below 1, so that the loss of a rank is
raised here before the driver gives this process up."""
APPLIED_S = 1800.0  # timeout for all replicas together, in which one that hangs is restarted
ASK_S = 10.0  # how long a replica's question for newer weights waits before it is answered with nothing


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
        import torch

        from accerl_lerobot.algorithms.update import make_update

        update = make_update(adapter, self.algorithm, self.trainer)
        if self.state is not None:
            adapter.load_trainable(snapshot.load(self.state / WEIGHTS))
            update.restore(snapshot.load(self.state / "trainer"))
            torch.manual_seed(self.seed + update.version)  # not the numbers again that the run began with
        return update


class TrainerWorker:
    """Becomes a threaded Ray actor in `engines.ray_engine`: `run` on one thread, everything else beside it.

    `world_model` is the handle of a `WorldModelWorker`, where the algorithm learns on its states; `readers`
    are the inference replicas; `online` is the handle of an `OnlineLearningWorker`, which gets the batches
    too.
    """

    def __init__(
        self,
        settings: LearnerSettings,
        timeline: Path | None = None,
        peers: Sequence[Any] = (),
        world_model: Any = None,
        readers: Sequence[str] = (),
        online: Any = None,
    ) -> None:
        errors.collect_warnings()
        self._clock = open_clock(timeline, "trainer")
        self._config = settings.trainer
        self._peers = Peers(peers, self._config, settings.timeout_s)
        self._update = self._peers.begin(settings)
        if world_model is not None:
            from accerl_lerobot.algorithms.chunk_critic import ChunkCriticUpdate

            assert isinstance(self._update, ChunkCriticUpdate)
            self._update.learn_states_in(world_model, settings.timeout_s)
        self._online = online
        self._lock = threading.Lock()
        self._copied: Any = None
        self._in_turn = False
        self._publisher = WeightPublisher(readers, ray.put)
        self._history: deque[Metrics] = deque()  # filled on one thread, emptied on another
        self._clock.enter(WAIT_IN)

    def ready(self) -> int:
        """Answers once the policy is loaded; returns this process's id."""
        return os.getpid()

    def run(self, replay: Any) -> int:
        """Train; returns the number of updates made."""
        self._clock.enter(WEIGHT_SYNC)
        # A checkpoint need not hold a critic: all start from this one.
        with self._lock:
            self._publish()
        self._train(replay)
        self._clock.enter(WEIGHT_SYNC)
        self._publisher.wait_until_applied()
        self._clock.enter(WAIT_IN)
        return self._update.version

    def next_weights(self, reader: str, applied: int) -> tuple[int, list[Any]]:
        """See `WeightPublisher.next_weights`."""
        return self._publisher.next_weights(reader, applied)

    def _train(self, replay: Any) -> None:
        """Until the last update: take the batch, ask for the next one, step, publish."""
        decisions = self._config.batch_decisions
        updates = self._config.updates
        upcoming: Any = None
        if self._update.version < updates:
            upcoming = replay.sample.remote(decisions, self._update.version)
        idle_since = time.monotonic()
        while self._update.version < updates:
            batch = upcoming
            self._clock.enter(WAIT_IN)
            ray.wait([batch], timeout=None)
            self._clock.enter(TRANSPORT)
            segments = ray.get(batch)
            if not segments:
                break
            waited = time.monotonic() - idle_since
            if self._online is not None:
                self._online.learn.remote(batch)
            if self._update.version + 1 < updates:
                # It is learned from after the update below, so its lag is checked against one version more.
                upcoming = replay.sample.remote(decisions, self._update.version + 1)
            # If the lock is taken, `copy_state` has it, and waiting for it is time of the checkpoint.
            self._clock.enter(CHECKPOINT)
            with self._lock:
                self._step(batch, segments, waited)
            idle_since = time.monotonic()
            replay.learnt.remote()

    def _step(self, batch: Any, segments: list[Segment], waited: float) -> None:
        """Make an update on segments, of which `batch` is the reference, and publish its weights."""
        self._clock.enter(COMPUTE)
        started = time.monotonic()
        fault_point("trainer.update")
        with self._peers.joining("step", batch):
            metrics = self._update.step(segments)
        updated = time.monotonic()
        self._clock.enter(WEIGHT_SYNC)
        self._publish()
        if self._in_turn:
            self._publisher.wait_until_applied()
        metrics["update"] = float(self._update.version)
        metrics["wait_s"] = waited
        metrics["update_s"] = updated - started
        metrics["publish_s"] = time.monotonic() - updated
        self._history.append(metrics)

    def _publish(self) -> None:
        """Hand over the weights of now."""
        with self._peers.gathering("gather_weights"):
            weights = self._update.adapter.view_trainable()
        fault_point("trainer.publish")
        self._publisher.publish(self._update.version, weights)

    def metrics(self) -> list[Metrics]:
        """One record per update since the last call."""
        self._clock.beat()
        return [self._history.popleft() for _ in range(len(self._history))]

    def set_schedule(self, schedule: Schedule) -> None:
        """Take turns with rollout workers from now on, unless the schedule is asynchronous."""
        self._in_turn = schedule != ASYNCHRONOUS

    def copy_state(self) -> tuple[int, list[Metrics]]:
        """Copies all that `write` is to save, as it is between two updates.

        Returns its version, and the records up to it, which `metrics` will not return again.
        """
        with self._lock:
            with self._peers.gathering("gather_state"):
                adapter = self._update.adapter
                self._copied = adapter.copy_weights(), adapter.export_trainable(), self._update.state()
            return self._update.version, self.metrics()

    def write(self, directory: Path) -> None:
        """Writes what `copy_state` has copied: ``pretrained_model`` and its part of ``training_state``."""
        weights, trained, state = self._copied
        self._copied = None
        fault_point("trainer.write")
        self._update.adapter.save(directory / PRETRAINED, weights)
        snapshot.save(directory / TRAINING_STATE / WEIGHTS, trained)
        snapshot.save(directory / TRAINING_STATE / "trainer", state)


class WeightPublisher:
    """Keeps the newest weights for the replicas, which ask from other threads.

    The trainer puts each set into Ray's object store once. A replica asks for the newest set whenever it has
    applied the one before, so a slow replica skips versions and the trainer waits for none.

    Args:
        readers: names of the replicas that `wait_until_applied` waits for.
        put: copies tensors into the store; returns the reference that replicas get.
    """

    def __init__(self, readers: Iterable[str], put: Callable[[Tensors], Any]) -> None:
        self._put = put
        self._changed = threading.Condition()
        self._applied = dict.fromkeys(readers, -1)
        self.version = -1
        self._reference = None

    def publish(self, version: int, tensors: Tensors) -> None:
        """Copy a set; the tensors may change afterwards."""
        reference = self._put(tensors)
        with self._changed:
            self.version = version
            self._reference = reference
            self._changed.notify_all()

    def next_weights(self, reader: str, applied: int) -> tuple[int, list[Any]]:
        """Note that a replica has applied this version, and wait for a newer one: it and its reference.

        The list is empty if there was none within `ASK_S`. Ray would replace a reference outside of a list by
        the tensors.
        """
        with self._changed:
            self._applied[reader] = applied
            self._changed.notify_all()
            if not self._changed.wait_for(lambda: self.version > applied, ASK_S):
                return applied, []
            return self.version, [self._reference]

    def wait_until_applied(self, timeout_s: float = APPLIED_S) -> None:
        """Wait until every replica has applied the newest set."""

        def late() -> list[str]:
            return [name for name, version in self._applied.items() if version < self.version]

        with self._changed:
            if not self._changed.wait_for(lambda: not late(), timeout_s):
                raise TimeoutError(f"weights not applied within {timeout_s:g} s by {', '.join(late())}")


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
        try:
            yield
        except Exception:
            if calls:  # it may have waited in vain for one that failed, whose error says more
                ray.get(ray.wait(calls, num_returns=len(calls), timeout=0)[0])
            raise
        if calls:
            ray.get(calls, timeout=self._timeout_s)

    def gathering(self, method: str) -> AbstractContextManager[None]:
        """As `joining`, where each rank keeps a part of the weights; else the first rank works alone."""
        if self._config.zero:
            return self.joining(method)
        return nullcontext()


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
        """Takes part in what the first rank calls to collect the trainable weights."""
        self._adapter.export_trainable()

    def gather_state(self) -> None:
        """Takes part in what the first rank calls to collect all that is saved, in its order."""
        self._adapter.copy_weights()
        self._adapter.export_trainable()
        self._update.state()
