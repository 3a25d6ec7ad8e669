# SPDX-License-Identifier: Apache-2.0
"""The held-out loss while a world model learns: of what it says it is, and nothing learns from it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from accerl_lerobot.world_model.config import LearnConfig
from accerl_lerobot.world_model.episodes import Episode, Windows
from accerl_lerobot.world_model.learn import VALIDATED, pretrain
from accerl_lerobot.world_model.pixels import PixelWorldModel
from tests.world_model.test_pixels import K, awake, dots, model

CONFIG = LearnConfig(steps=12, batch=4, anchors=3, validate_every=5)


def darker(episodes: list[Episode]) -> list[Episode]:
    """As they are, but known by their frames, of which no pixel is as bright as before."""
    return [replace(episode, frames=episode.frames // 2) for episode in episodes]


Told = list[tuple[int, dict[str, float]]]


def learn(held_out: list[Episode], **changes: Any) -> tuple[dict[str, torch.Tensor], Told, Told]:
    """All weights and statistics in the end, and what was told of the steps and of what is held out."""
    steps: Told = []
    told: Told = []
    learner = pretrain(
        awake(model()), dots(6), replace(CONFIG, **changes), 3,
        on_step=lambda step, metrics: steps.append((step, metrics)),
        held_out=held_out, on_held_out=lambda step, metrics: told.append((step, metrics)),
    )  # fmt: skip
    weights = {f"{name}.{k}": v for name in ("model", "serving") for k, v in learner.state()[name].items()}
    return weights, steps, told


def test_what_is_learnt_is_the_same_with_it_and_without_it():
    held_out = darker(dots(3, seed=5))
    with_it, steps, told = learn(held_out)
    assert [step for step, _ in told] == [5, 10] and [step for step, _ in steps] == list(range(1, 13))
    for without, same, nothing in (learn(held_out, validate_every=0), learn([]), learn(dots(1, steps=1))):
        assert nothing == [] and same == steps
        assert (
            all(torch.equal(v, without[k]) for k, v in with_it.items()) and without.keys() == with_it.keys()
        )


def test_it_is_of_held_out_windows_alone_and_of_the_weights_that_serve(monkeypatch: pytest.MonkeyPatch):
    seen: list[tuple[bool, Windows, float, torch.Tensor]] = []
    real = PixelWorldModel.loss

    def loss(self: PixelWorldModel, windows: Windows, generator: torch.Generator) -> Any:
        made = real(self, windows, generator)
        weight = next(self.parameters())
        seen.append((torch.is_grad_enabled(), windows, made[0].item(), weight.detach().clone()))
        assert weight.requires_grad is torch.is_grad_enabled(), "only one of the two is trained"
        return made

    monkeypatch.setattr(PixelWorldModel, "loss", loss)
    held_out = darker(dots(12, seed=5))
    _, _, told = learn(held_out)
    trained, looked_at = ([one for one in seen if one[0] is kind] for kind in (True, False))
    assert len(trained) == 12 and len(looked_at) == len(told) == 2
    assert all(windows.frames.max() == 220 for _, windows, _, _ in trained)
    for (_, windows, value, _), (_, metrics) in zip(looked_at, told, strict=True):
        assert windows.frames.max() == windows.anchor.max() == 110 and len(windows) == VALIDATED
        assert set(metrics) == {"image", "image_dreamt", "state", "loss"} and metrics["loss"] == value
        assert metrics["loss"] == pytest.approx(metrics["image"] + metrics["state"], rel=1e-4)
    (_, first, _, weight), (_, second, _, later) = looked_at
    assert all(np.array_equal(getattr(first, k), getattr(second, k)) for k in ("frames", "anchor", "actions"))
    assert len({w.tobytes() for w in first.frames}) > VALIDATED / 2, "not one and the same window"
    assert not torch.equal(weight, later)


def test_equal_weights_have_equal_losses():
    """The noise is always the same: what changes is what was learnt."""
    frozen = {"lr": 1e-12, "average": 0.0, "weight_decay": 0.0}
    (_, first), (_, second) = learn(darker(dots(3, seed=5)), **frozen)[2]
    assert first == pytest.approx(second, rel=1e-6)


def test_a_placebo_is_looked_at_with_true_actions(monkeypatch: pytest.MonkeyPatch):
    seen: list[Windows] = []
    real = PixelWorldModel.loss

    def loss(self: PixelWorldModel, windows: Windows, generator: torch.Generator) -> Any:
        seen.append(windows)
        return real(self, windows, generator)

    monkeypatch.setattr(PixelWorldModel, "loss", loss)
    held_out = darker(dots(3, seed=5))
    pretrain(model(), dots(6), replace(CONFIG, steps=5), 3, shuffle=True, held_out=held_out)
    *_, windows = seen
    made = {e.state[t].tobytes(): e.actions[t : t + K] for e in held_out for t in range(len(e))}
    whole = np.flatnonzero(windows.steps[:, 0] == K)
    assert len(whole) > 20
    for row in whole:
        assert np.array_equal(windows.actions[row, 0], made[windows.state[row, 1].tobytes()])
