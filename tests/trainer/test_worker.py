# SPDX-License-Identifier: Apache-2.0
"""The trainer process's loop, with replay and the readers played by the test."""

import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from accerl_lerobot.algorithms import GIPOConfig
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import PRETRAINED, TRAINING_STATE
from accerl_lerobot.experience import Segment
from accerl_lerobot.policies import loading
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.trainer import worker as module
from accerl_lerobot.trainer.worker import LearnerSettings, TrainerWorker
from tests.algorithms.linear import LinearAdapter, make_segments


class Stage:
    """A trainer, a replay that notes what it is asked for, and all weights that were published."""

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        updates: int = 6,
        batches: int = 10**6,
        state: Path | None = None,
    ) -> None:
        self.asked: list[tuple[int, int]] = []
        self.published: list[dict[str, np.ndarray]] = []
        self.batches = batches
        # Without Ray a reference is the answer itself.
        local = SimpleNamespace(get=lambda reference: reference, put=self._put, wait=lambda *_, **__: None)
        monkeypatch.setattr(module, "ray", local)
        monkeypatch.setattr(loading, "load_adapter", lambda policy: LinearAdapter())
        trainer = TrainerConfig(updates=updates, batch_decisions=7, warmup_updates=0, value_warmup_updates=0)
        policy = PolicyConfig(path="nowhere")
        self.worker = TrainerWorker(LearnerSettings(policy, GIPOConfig(), trainer, 0, state))

    def run(self) -> int:
        remote = SimpleNamespace
        return self.worker.run(remote(sample=remote(remote=self._sample), learnt=remote(remote=lambda: None)))

    def _sample(self, decisions: int, version: int) -> list[Segment]:
        self.asked.append((decisions, version))
        return make_segments((4, 3), seed=len(self.asked)) if len(self.asked) <= self.batches else []

    def _put(self, tensors: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        self.published.append({name: tensor.copy() for name, tensor in tensors.items()})
        return self.published[-1]


def test_it_makes_its_updates_publishes_each_and_draws_no_batch_more(monkeypatch: pytest.MonkeyPatch):
    stage = Stage(monkeypatch)
    assert stage.run() == 6
    # Each batch is drawn ahead, for the version that will be current when it is used.
    assert stage.asked == [(7, version) for version in range(6)]
    records = stage.worker.metrics()
    assert [r["update"] for r in records] == [1, 2, 3, 4, 5, 6] and stage.worker.metrics() == []
    assert all(r["wait_s"] >= 0 and r["update_s"] > 0 and r["publish_s"] >= 0 for r in records)
    version, (newest,) = stage.worker.next_weights("inference", -1)
    assert version == 6 and newest is stage.published[-1] and len(stage.published) == 7
    last = stage.worker._update.adapter.export_trainable()
    assert any(not np.array_equal(stage.published[0][name], last[name]) for name in last)
    assert all(np.array_equal(newest[name], last[name]) for name in last)


def test_a_closed_replay_ends_it_early(monkeypatch: pytest.MonkeyPatch):
    stage = Stage(monkeypatch, batches=2)
    assert stage.run() == 2 and len(stage.worker.metrics()) == 2


def test_a_resumed_trainer_goes_on_with_other_random_numbers(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    first = Stage(monkeypatch)
    numbers = torch.rand(3)
    first.run()
    first.worker.copy_state()
    first.worker.write(tmp_path)
    again = Stage(monkeypatch, updates=8, state=tmp_path / "training_state")
    assert not torch.equal(torch.rand(3), numbers)
    assert again.run() == 8 and len(again.asked) == 2


def test_what_is_saved_is_a_whole_version(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Saving waits for an update to end, and the next one for the saving."""
    stage = Stage(monkeypatch, updates=10**6)
    copy_weights = LinearAdapter.copy_weights

    def slow_copy(adapter: LinearAdapter) -> dict[str, Any]:
        before = copy_weights(adapter)
        threading.Event().wait(0.01)
        assert all(torch.equal(p, before[k]) for k, p in copy_weights(adapter).items())
        return before

    monkeypatch.setattr(LinearAdapter, "copy_weights", slow_copy)
    runner = threading.Thread(target=stage.run)
    runner.start()
    while len(stage.published) < 3:
        threading.Event().wait(0.001)
    saved = []
    for i in range(8):
        saved.append(stage.worker.copy_state())
        stage.worker.write(tmp_path / str(i))
    stage.batches = 0
    runner.join()
    told = [record["update"] for _, records in saved for record in records]
    assert told == [float(i + 1) for i in range(saved[-1][0])], "all records up to what was saved, once"
    for i, (version, _) in enumerate(saved):
        state = tmp_path / str(i) / TRAINING_STATE
        assert snapshot.load(state / "trainer")["version"] == version
        weights = snapshot.load(state / "weights")
        written = snapshot.load(tmp_path / str(i) / PRETRAINED / "linear")
        assert written.keys() == weights.keys()
        assert all(np.array_equal(weights[k], written[k].numpy()) for k in written)
