# SPDX-License-Identifier: Apache-2.0
"""Successive states of trainer, inference and replay while they do something that a test knows."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
import pytest

from accerl_lerobot.algorithms import GIPOConfig
from accerl_lerobot.experience import TASK, Decision, Request
from accerl_lerobot.inference.worker import InferenceConfig, InferenceWorker
from accerl_lerobot.policies import loading
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.replay.pacing import ReplayConfig
from accerl_lerobot.replay.worker import ReplayWorker
from accerl_lerobot.timeline import STATES, TIMELINE
from accerl_lerobot.timeline.read import read_timeline
from accerl_lerobot.trainer import worker as trainer
from accerl_lerobot.trainer.config import TrainerConfig
from accerl_lerobot.trainer.peers import LearnerSettings
from accerl_lerobot.transport.weights import WeightUpdate
from tests.local_ray import Handle, Local
from tests.replay.segments import make_segment
from tests.trainer.linear import LinearAdapter, make_segments
from tests.transport.played import played


def states(run: Path) -> list[str]:
    """Successive states of the only worker."""
    (row,) = read_timeline(run).rows
    return [STATES[state] for state in row.states]


def test_the_trainer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trainer, "ray", Local)
    monkeypatch.setattr(loading, "load_adapter", lambda policy: LinearAdapter())
    config = TrainerConfig(updates=2, batch_decisions=7, warmup_updates=0, value_warmup_updates=0)
    settings = LearnerSettings(PolicyConfig(path="nowhere"), GIPOConfig(), config, 0)
    worker = trainer.TrainerWorker(settings, timeline=tmp_path / TIMELINE)
    replay = Handle(
        sample=lambda decisions, version: make_segments((4, 3), seed=version), learnt=lambda: None
    )
    assert worker.run(replay, [played(lambda update: None)]) == 2
    worker.metrics()
    turn = ["wait_in", "transport", "checkpoint", "compute", "weights"]
    assert states(tmp_path) == ["recovery", "wait_in", "weights", *turn, *turn, "wait_in"]


def test_inference(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Adapter:
        def decide(self, requests: list[Request], version: int) -> list[Decision]:
            return [decision() for _ in requests]

        def load_trainable(self, tensors: dict[str, np.ndarray]) -> None:
            pass

    monkeypatch.setattr(loading, "load_adapter", lambda policy: Adapter())

    async def scene() -> None:
        worker = InferenceWorker(
            PolicyConfig(path="nowhere"), InferenceConfig(max_batch=1), timeline=tmp_path / TIMELINE
        )
        serving = asyncio.create_task(worker.serve())
        request = Request(observation={TASK: "push"}, noise_seed=0)
        await worker.decide([request])
        await worker.decide(WeightUpdate(1, 0.0, {}))
        await worker.decide([request])
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)
        await worker.metrics()

    asyncio.run(asyncio.wait_for(scene(), 30))
    batch = ["wait_in", "compute", "transport"]
    assert states(tmp_path) == ["recovery", *batch, "wait_in", "weights", *batch, "wait_in"]


def test_replay(tmp_path: Path) -> None:
    async def scene() -> None:
        config = ReplayConfig(capacity=64, min_decisions=8, ahead=8)
        worker = ReplayWorker(config, seed=0, timeline=tmp_path / TIMELINE)
        await worker.insert([make_segment("a", 8)])
        late = asyncio.ensure_future(worker.insert([make_segment("b", 8)]))  # the door is shut
        await worker.sample(8, 0)
        await late
        await worker.save(tmp_path, 0)
        await worker.metrics()

    asyncio.run(asyncio.wait_for(scene(), 30))
    once = ["wait_in", "compute"]
    assert states(tmp_path) == ["recovery", *once, *once, *once, "wait_in", "checkpoint", "wait_in"]


def decision() -> Decision:
    zeros = np.zeros((4, 2), np.float32)
    return Decision(chunk=zeros, latent={"x": zeros}, log_prob=np.zeros(4, np.float32), value=0.0, version=0)
