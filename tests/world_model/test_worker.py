# SPDX-License-Identifier: Apache-2.0
"""The world-model process in the asynchronous engine: it learns, and is missed when it dies."""

import os
import signal
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from accerl_lerobot.algorithms import chunk_critic
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import TRAINING_STATE
from accerl_lerobot.engines.stopping import WorkerError
from accerl_lerobot.envs import make_environment
from accerl_lerobot.run.train import make_engine
from accerl_lerobot.trainer import worker as trainer_worker
from accerl_lerobot.trainer.worker import TrainerWorker
from accerl_lerobot.world_model import worker as module
from accerl_lerobot.world_model.config import LatentConfig, StateModelConfig
from accerl_lerobot.world_model.latent import LatentModel
from accerl_lerobot.world_model.states import BATCH, StateLearner, Transitions
from accerl_lerobot.world_model.worker import RemoteStateLearner, WorldModelWorker
from tests.runs import off_policy_run, polls
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
        return SimpleNamespace(remote=lambda *arguments: lambda: method(*arguments))


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Calls:
    fake = Calls()
    monkeypatch.setattr(module, "ray", fake)
    return fake


def learners(timeout_s: float = 60.0) -> tuple[StateLearner, RemoteStateLearner]:
    """A learner in this process, and one that goes on from the same weights elsewhere."""
    here = StateLearner(model())
    worker = WorldModelWorker(0, torch.get_num_threads(), "auto")
    return here, RemoteStateLearner(Handle(worker), StateLearner(model()), timeout_s)


def test_steps_elsewhere_are_the_steps_that_would_be_made_here(calls: Calls):
    here, there = learners()
    made: list[Any] = []
    for learner in (here, there):
        torch.manual_seed(3)
        learner.submit(transitions(3 * BATCH, seed=1), NUMBERS)
        assert learner.behind == 1000 - 3 and not learner.ready
        made.append(learner.collect())
        assert len(made[-1]) == 3 and learner.collect() == []
    assert made[0] == made[1]
    one, other = model(), model()
    here.publish(one)
    there.publish(other)
    assert all(torch.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))
    assert there.state()["count"] == 3


class Elsewhere(Transitions):
    """Transitions whose tensors are on a GPU that this machine does not have."""

    def to(self, device: torch.device | str) -> Transitions:
        assert torch.device(device).type == "cpu"
        return Transitions(*self)

    def rows(self, chosen: np.ndarray) -> Transitions:
        raise AssertionError("its tensors are not where the model is")


def test_the_trainer_and_the_worker_may_be_on_different_devices(calls: Calls):
    for learner in learners():
        learner.submit(Elsewhere(*transitions(BATCH, seed=1)), NUMBERS)
        learner.wait()
        assert len(learner.collect()) == 1


def test_nobody_waits_for_steps_but_each_call_has_a_timeout(calls: Calls, monkeypatch: pytest.MonkeyPatch):
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    _, there = learners(timeout_s=10.0)
    for _ in range(2):
        there.submit(transitions(BATCH, seed=1), NUMBERS)
    now[0], calls.due = 9.0, 1
    assert there.busy and len(there.collect()) == 1
    now[0] = 18.0
    assert there.busy and there.collect() == [], "the second one began when the first had ended"
    now[0] = 20.0
    with pytest.raises(TimeoutError, match="the world-model worker has not answered for 10 s"):
        there.collect()
    there.wait()
    assert len(there.collect()) == 1 and not there.busy


@StateModelConfig.register_subclass("small_latent")
@dataclass(frozen=True, kw_only=True)
class SmallLatentConfig(LatentConfig):
    make = "tests.world_model.test_worker:SmallLatent"

    latents: int = 8


class SmallLatent(LatentModel):
    first_steps = 20


class HastyTrainer(TrainerWorker):
    """Its teacher soon acts."""

    def __init__(self, *arguments: Any) -> None:
        chunk_critic.FIRST_STEPS = 20
        super().__init__(*arguments)


@pytest.mark.slow
def test_a_run_on_a_state_that_another_process_learns(
    tiny_checkpoint: Path, tmp_path: Path, monkeypatch: Any
):
    monkeypatch.setattr(trainer_worker, "TrainerWorker", HastyTrainer)
    config = off_policy_run(
        tiny_checkpoint,
        output_dir=str(tmp_path),
        world_model=SmallLatentConfig(),
        trainer=TrainerConfig(updates=400, batch_decisions=16, value_warmup_updates=4),
    )
    config = replace(config, replay=replace(config.replay, max_lag=200))
    engine = make_engine(config, make_environment(config.env).spec, history=1)
    try:
        engine.train()
        for progress in polls(engine):  # a teacher acts once critic and teacher have learned on the state
            if any("distance" in update for update in progress.updates):
                break
        engine.save(tmp_path / "saved")
        saved = snapshot.load(tmp_path / "saved" / TRAINING_STATE / "trainer")
        assert saved["state_learner"]["count"] >= 20
        os.kill(engine.pids()["world model"], signal.SIGKILL)
        with pytest.raises(WorkerError, match="worker failed"):
            for _ in polls(engine):
                pass
    finally:
        engine.close()
