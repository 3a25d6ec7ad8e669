# SPDX-License-Identifier: Apache-2.0
"""The trainer process's loop, with replay and the readers played by the test."""

import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.algorithms import GIPOConfig
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import PRETRAINED, TRAINING_STATE
from accerl_lerobot.experience import Segment
from accerl_lerobot.policies import loading
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.trainer import worker as module
from accerl_lerobot.trainer.worker import LearnerSettings, TrainerWorker, WeightPublisher
from tests.algorithms.linear import LinearAdapter, make_segments


def copied(tensors: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Copies as a store would have made them."""
    return {name: tensor.copy() for name, tensor in tensors.items()}


def handle(**methods: Callable[..., Any]) -> Any:
    """An actor handle made of functions; where there is no Ray, a reference is the answer itself."""
    return SimpleNamespace(**{name: SimpleNamespace(remote=method) for name, method in methods.items()})


class NotingPublisher(WeightPublisher):
    """Keeps all that was published."""

    def __init__(self, readers: Sequence[str], put: Callable[..., Any]) -> None:
        super().__init__(readers, put)
        self.received: list[tuple[int, dict[str, np.ndarray]]] = []

    def publish(self, version: int, tensors: dict[str, np.ndarray]) -> None:
        super().publish(version, tensors)
        self.received.append((version, copied(tensors)))


class Stage:
    """A trainer, a replay that counts what it is asked for, and a publisher that keeps what it is given."""

    def __init__(self, batches: int = 1000, **config: Any) -> None:
        self.asked: list[tuple[int, int]] = []
        self.replay = handle(sample=self._sample, learnt=lambda: None)
        self._batches = batches
        defaults = {"updates": 6, "batch_decisions": 7, "warmup_updates": 0, "value_warmup_updates": 0}
        trainer = TrainerConfig(**{**defaults, **config})
        settings = LearnerSettings(PolicyConfig(path="nowhere"), GIPOConfig(), trainer, 0)
        self.worker = TrainerWorker(settings)
        self.received = self.worker._publisher.received  # type: ignore[attr-defined]

    def run(self) -> int:
        return self.worker.run(self.replay)

    def _sample(self, decisions: int, version: int) -> list[Segment]:
        self.asked.append((decisions, version))
        return make_segments((4, 3), seed=len(self.asked)) if len(self.asked) <= self._batches else []


@pytest.fixture(autouse=True)
def _without_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    local = SimpleNamespace(
        get=lambda reference: reference, put=copied, wait=lambda references, timeout: (references, [])
    )
    monkeypatch.setattr(module, "ray", local)
    monkeypatch.setattr(module, "WeightPublisher", NotingPublisher)
    monkeypatch.setattr(loading, "load_adapter", lambda policy: LinearAdapter())


def test_it_makes_its_updates_publishes_each_and_draws_no_batch_more():
    stage = Stage(updates=6)
    assert stage.run() == 6
    # Each batch is drawn ahead, for the version that will be current when it is used.
    assert stage.asked == [(7, version) for version in range(6)]
    records = stage.worker.metrics()
    assert [r["update"] for r in records] == [1, 2, 3, 4, 5, 6] and stage.worker.metrics() == []
    assert all(r["wait_s"] >= 0 and r["update_s"] > 0 and r["publish_s"] >= 0 for r in records)
    assert [version for version, _ in stage.received] == [0, 1, 2, 3, 4, 5, 6]
    last = stage.worker._update.adapter.export_trainable()
    version, (newest,) = stage.worker.newer_than("inference", -1)
    assert version == 6 and any(not np.array_equal(stage.received[0][1][name], last[name]) for name in last)
    assert all(np.array_equal(newest[name], last[name]) for name in last)


def test_a_closed_replay_ends_it_early():
    stage = Stage(batches=2, updates=6)
    assert stage.run() == 2 and len(stage.worker.metrics()) == 2


def test_what_is_saved_is_a_whole_version(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Saving waits for an update to end, and the next one for the saving."""
    stage = Stage(batches=1_000_000, updates=1_000_000)
    seen: list[tuple[int, int]] = []

    copied = LinearAdapter.copy_weights

    def copy_weights(adapter: LinearAdapter) -> dict[str, Any]:
        before = copied(adapter)
        version = stage.worker._update.version
        threading.Event().wait(0.01)
        assert all(bool((p == before[k]).all()) for k, p in copied(adapter).items())
        seen.append((version, stage.worker._update.version))
        return before

    monkeypatch.setattr(LinearAdapter, "copy_weights", copy_weights)
    runner = threading.Thread(target=stage.run)
    runner.start()
    while stage.worker._update.version < 3:
        threading.Event().wait(0.001)
    saved = []
    for i in range(8):
        saved.append(stage.worker.hold())
        stage.worker.write(tmp_path / str(i))
    stage._batches = 0
    runner.join()
    assert [version for version, _ in saved] == [before for before, _ in seen] == [after for _, after in seen]
    told = [record["update"] for _, records in saved for record in records]
    assert told == [float(i + 1) for i in range(saved[-1][0])], "all records up to what was saved, once"
    for i, (version, _) in enumerate(saved):
        state = tmp_path / str(i) / TRAINING_STATE
        assert snapshot.load(state / "trainer")["version"] == version
        weights = snapshot.load(state / "weights")
        written = snapshot.load(tmp_path / str(i) / PRETRAINED / "linear")
        assert written.keys() == weights.keys()
        assert all(np.array_equal(weights[k], written[k].numpy()) for k in written)


def test_in_turn_the_wait_for_a_batch_does_not_hold_that_for_the_readers(monkeypatch: pytest.MonkeyPatch):
    flushed: list[int] = []
    stage = Stage(updates=3)
    monkeypatch.setattr(WeightPublisher, "flush", lambda self: flushed.append(len(stage.worker._history)))
    stage.worker.set_schedule("synchronous")
    stage.run()
    assert flushed == [0, 1, 2, 3], "each version before its record is complete, and the last once more"
