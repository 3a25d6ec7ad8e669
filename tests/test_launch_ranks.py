# SPDX-License-Identifier: Apache-2.0
"""The asynchronous engine with a trainer of two ranks, everything real: LeRobot's SmolVLA, Ray, gloo, FSDP2.

The run is saved, and loses a rank that hangs.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import PRETRAINED, TRAINING_STATE, WEIGHTS
from accerl_lerobot.engines.config import LaunchConfig
from accerl_lerobot.engines.ray_engine import RayEngine
from accerl_lerobot.engines.stopping import WorkerError
from tests.runs import drive, polls, tiny_run
from tests.test_ray_session import LOOPBACK, listening

pytestmark = pytest.mark.slow

UPDATES = 6
TWO = TrainerConfig(
    updates=1000, batch_decisions=16, warmup_updates=0, value_warmup_updates=1, probe_every=3,
    ranks=2, sharding="zero3",
)  # fmt: skip


@dataclass
class Story:
    """Events of the run with two ranks."""

    saved: Path
    version: int
    updates: list[dict[str, float]]
    served: int  # version of the weights that inference had
    error: str
    addresses: set[str]  # at which its processes accepted connections


def probes(updates: list[dict[str, float]]) -> list[float]:
    """Differences between acting and learning, where they were measured."""
    return [u["logprob/mismatch_max"] for u in updates if "logprob/mismatch_max" in u]


@pytest.fixture(scope="module")
def story(tiny_checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Story]:
    config = tiny_run(tiny_checkpoint, trainer=TWO, launch=LaunchConfig(stall_s=25.0))
    directory = tmp_path_factory.mktemp("saved")
    engine = RayEngine(config, ("match",))
    try:
        pids = engine.pids()
        engine.train()
        updates: list[dict[str, float]] = []
        for progress in polls(engine):
            updates += progress.updates
            heard = progress.inference.get("version", 0.0) > 0
            if progress.version >= UPDATES and heard and len(probes(updates)) >= 2:
                break
        saved, addresses = engine.save(directory), set(listening())
        served = int(progress.inference["version"])
        os.kill(pids["trainer rank 1"], signal.SIGSTOP)
        with pytest.raises(WorkerError) as lost:
            drive(engine)
        updates += saved.updates
        yield Story(directory, saved.version, updates, served, str(lost.value), addresses)
    finally:
        engine.close()


def test_two_ranks_train_and_publish(story: Story):
    assert [u["update"] for u in story.updates[: story.version]] == [i + 1.0 for i in range(story.version)]
    assert 0 < story.served <= story.version
    assert all(
        np.isfinite(u["loss"]) and u["value_grad_norm"] > 0 and u["skipped"] == 0 for u in story.updates
    )
    assert [u["grad_norm"] > 0 for u in story.updates] == [False] + [True] * (len(story.updates) - 1)


def test_acting_and_learning_in_parts_agree(story: Story):
    """Decisions were made by whole weights that had been in parts when they were published."""
    assert max(probes(story.updates)) <= 1e-4


def test_the_checkpoint_is_whole_and_has_moved(story: Story, tiny_checkpoint: Path):
    before = load_file(tiny_checkpoint / "model.safetensors")
    after = load_file(story.saved / PRETRAINED / "model.safetensors")
    assert {k: t.shape for k, t in after.items()} == {k: t.shape for k, t in before.items()}
    assert any(not torch.equal(after[k], before[k]) for k in before)
    trained = snapshot.load(story.saved / TRAINING_STATE / WEIGHTS)
    named = {k.removeprefix("policy."): v for k, v in trained.items() if k.startswith("policy.")}
    assert all(np.array_equal(after[k].numpy(), named[k]) for k in after if k in named) and len(named) > 20


def test_ranks_listen_on_the_loopback_interface_only(story: Story):
    assert story.addresses and story.addresses <= LOOPBACK


def test_a_rank_that_hangs_ends_the_trainer(story: Story):
    assert story.error.startswith("trainer worker failed for good:")
