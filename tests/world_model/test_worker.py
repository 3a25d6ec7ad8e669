# SPDX-License-Identifier: Apache-2.0
"""The world-model process in the asynchronous engine: it learns, is resumed, and is missed when it dies."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest
import torch

from accerl_lerobot.algorithms import ChunkCriticConfig
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import CHECKPOINTS, TRAINING_STATE, save_checkpoint, saved_version
from accerl_lerobot.engines.contract import Engine
from accerl_lerobot.engines.stopping import WorkerError
from accerl_lerobot.replay.buffer import ReplayConfig
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.run.train import make_engine
from accerl_lerobot.world_model import worker as module
from accerl_lerobot.world_model.state_learner import BATCH, StateLearner
from accerl_lerobot.world_model.worker import Learned, RemoteStateLearner, WorldModelWorker
from tests.runs import polls, tiny_run, until
from tests.world_model.small_latent import SmallLatentConfig
from tests.world_model.test_latent import NUMBERS, model, transitions


class Calls:
    """Ray in this process: a call is made when its answer is asked for; so many answers are `due`."""

    def __init__(self) -> None:
        self.due = 10**6

    def wait(self, references: list[Any], timeout: float) -> tuple[list[Any], list[Any]]:
        self.due -= 1
        return (references, []) if self.due >= 0 else ([], references)

    def get(self, reference: Any, timeout: float | None = None) -> Any:
        return reference()


class Handle:
    def __init__(self, worker: Any) -> None:
        self._worker = worker

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._worker, name)
        return type("Method", (), {"remote": staticmethod(lambda *a: lambda: method(*a))})


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Calls:
    fake = Calls()
    monkeypatch.setattr(module, "ray", fake)
    return fake


def learners(timeout_s: float = 60.0) -> tuple[StateLearner, RemoteStateLearner]:
    """A learner in this process, and one that goes on from the same weights elsewhere."""
    here = StateLearner(model())
    worker = WorldModelWorker(0, torch.get_num_threads())
    return here, RemoteStateLearner(Handle(worker), StateLearner(model()), timeout_s)


def test_steps_elsewhere_are_the_steps_that_would_be_made_here(calls: Calls):
    here, there = learners()
    for learner in (here, there):
        torch.manual_seed(3)
        learner.submit(transitions(3 * BATCH, seed=1), NUMBERS)
        assert learner.behind == 1000 - 3 and not learner.ready
        made = learner.collect()
        assert len(made) == 3 and learner.collect() == []
        if learner is here:
            expected = made
    assert made == expected
    one, other = model(), model()
    here.publish(one)
    there.publish(other)
    assert all(torch.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))
    assert there.state()["count"] == 3


def test_nobody_waits_while_steps_are_under_way(calls: Calls, monkeypatch: pytest.MonkeyPatch):
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    _, there = learners(timeout_s=10.0)
    calls.due = 0
    there.submit(transitions(BATCH, seed=1), NUMBERS)
    assert there.busy and there.collect() == []
    now[0] = 11.0
    with pytest.raises(TimeoutError, match="the world-model worker has not answered for 10 s"):
        there.collect()
    there.wait()
    assert len(there.collect()) == 1 and not there.busy


def test_calls_in_a_queue_have_a_timeout_each(calls: Calls, monkeypatch: pytest.MonkeyPatch):
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    _, there = learners(timeout_s=10.0)
    for _ in range(2):
        there.submit(transitions(BATCH, seed=1), NUMBERS)
    now[0], calls.due = 9.0, 1
    assert there.busy and len(there.collect()) == 1
    now[0] = 18.0
    assert there.busy, "the second one began when the first had ended"
    now[0] = 20.0
    with pytest.raises(TimeoutError):
        there.collect()


def test_what_is_learned_is_read_with_its_weights():
    learned = Learned([{}], 1, {})
    assert learned.steps == 1  # `count` would be the tuple's own method


def engine(checkpoint: Path, folder: Path, state: Path | None = None) -> Engine:
    config = tiny_run(
        checkpoint,
        output_dir=str(folder),
        rollout=RolloutConfig(environments=4, segment_length=4),
        replay=ReplayConfig(
            capacity=64, min_decisions=16, max_unlearned_decisions=32, samples_per_insert=1, max_lag=200
        ),
        algorithm=ChunkCriticConfig(),
        world_model=SmallLatentConfig(),
        trainer=TrainerConfig(updates=400, batch_decisions=16, value_warmup_updates=4),
    )
    return make_engine(config, ("match",), history=1, state=state)


@pytest.mark.slow
def test_a_run_on_a_state_that_another_process_learns(tiny_checkpoint: Path, tmp_path: Path):
    first = engine(tiny_checkpoint, tmp_path)
    try:
        first.train()
        for progress in polls(first):  # a teacher acts once critic and teacher have learned on the state
            if any("distance" in update for update in progress.updates):
                break
        saving = save_checkpoint(tmp_path / CHECKPOINTS, lambda folder: first.save(folder).version)
    finally:
        first.close()
    state = saving / TRAINING_STATE
    version = saved_version(state)
    saved = snapshot.load(state / "trainer")["state_learner"]["count"]
    assert saved >= 20
    second = engine(tiny_checkpoint, tmp_path, state)
    try:
        second.train()
        until(second, version + 3)
        second.save(tmp_path / "later")
        later = snapshot.load(tmp_path / "later" / TRAINING_STATE / "trainer")
        assert later["state_learner"]["count"] > saved
        os.kill(second.pids()["world model"], signal.SIGKILL)
        with pytest.raises(WorkerError, match="worker failed"):
            for _ in polls(second):
                pass
    finally:
        second.close()
