# SPDX-License-Identifier: Apache-2.0
"""Advantage-weighted regression from a memory: its weights by hand, and where it leads."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from accerl_lerobot.algorithms import AWRConfig, off_policy
from accerl_lerobot.algorithms.off_policy import weights
from tests.algorithms.test_chunk_critic import awr, episode, first_action, tried


def test_weights_by_hand():
    advantage = torch.tensor([-1.0, 0.0, 0.5, 2.0, 1e6])
    expected = [math.exp(-2), 1, math.exp(1), 20, 20]
    np.testing.assert_allclose(weights(advantage, beta=0.5), expected, rtol=1e-6)
    np.testing.assert_allclose(weights(advantage, beta=math.inf), 1)


def test_a_step_weighs_each_row_by_its_advantage(tiny_checkpoint: Path):
    """Two decisions with known returns, a critic that says 0, and imitation losses of 1 and 3."""
    update = awr(tiny_checkpoint, AWRConfig(policy_steps=1.0, beta=0.5), lr=0.0, value_lr=0.0)
    for value, reward in ((1.0, 0.0), (3.0, 1.0)):
        update.remember(episode([reward], actions=np.full((1, 4, 2), value, np.float32)))
    losses = update.adapter.processing.normalise(torch.tensor([1.0, 3.0])[:, None, None].expand(2, 4, 2))
    update.adapter.family.imitation_loss = lambda encoded, chunk: (
        chunk[:, 0, 0] + 0 * encoded.features.sum((1, 2))
    )
    rows = np.array([0, 1, 1])
    for _ in range(2):
        encoded = update.adapter.encode(*update.memory.observations(rows))
        found = update.losses(rows, encoded, torch.tensor([1.0, 2.0, 3.0]))
        square = 2 / 3  # the mean square of the returns 0, 1, 1 stays the same
        weight = np.minimum(np.exp(np.array([0.0, 1.0, 1.0]) / math.sqrt(square) / 0.5), 20.0)
        assert found["imitation_loss"].item() == pytest.approx(weight @ [1, 2, 3] / 3, rel=1e-5)
        assert found["value_loss"].item() == pytest.approx(2 / 3)
    metrics = update.learn(1)
    low, high = float(losses[0, 0, 0]), float(losses[1, 0, 0])
    assert min(low, 20 * high) < metrics["imitation_loss"] < max(low, 20 * high)


def test_the_critic_learns_returns_and_leaves_the_policy_alone(tiny_checkpoint: Path):
    update = awr(tiny_checkpoint, AWRConfig(policy_steps=1.0), lr=0.0, value_lr=3e-2)
    before = update.adapter.export_trainable()
    update.remember(episode([0.0, 0.0, 1.0]))
    for _ in range(60):
        metrics = update.learn(1)
        update.version += 1
    after = update.adapter.export_trainable()
    changed = {name.split(".")[0] for name in before if not np.array_equal(before[name], after[name])}
    assert changed == {"value_head"} and metrics["value_loss"] < 0.05


def test_it_goes_where_returns_are_high(tiny_checkpoint: Path, monkeypatch: pytest.MonkeyPatch):
    """The return is how far the first action goes up; nothing counts as a success."""
    monkeypatch.setattr(off_policy, "POLICY_BATCH", 32)
    update = awr(tiny_checkpoint, AWRConfig(policy_steps=0.5, beta=0.3), value_lr=1e-2)
    rng, before = np.random.default_rng(0), first_action(update)
    for _ in range(6):
        segments = tried(rng, lambda up: (1 + up) / 2)
        for segment in segments:
            segment.success = False
        update.step(segments)
    assert first_action(update) > before + 0.2
