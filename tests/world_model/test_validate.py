# SPDX-License-Identifier: Apache-2.0
"""Validation: models whose quality is known must get the numbers they deserve; its statistics by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.world_model.config import SuccessLearnConfig, ValidationConfig, WorldModelConfig
from accerl_lerobot.world_model.contract import Context, Prediction, State, WorldModel
from accerl_lerobot.world_model.data import Episode, shuffle_actions
from accerl_lerobot.world_model.learners import Examples, SuccessLearner, new_success_model
from accerl_lerobot.world_model.rollout_eval import auroc, bootstrap, match_cut_lengths, predict
from accerl_lerobot.world_model.validation import (
    mean_error,
    sensitivity,
    skill,
    squared_errors,
    validate,
    validation_windows,
)
from tests.world_model.test_pixels import SIZE, SPEC, K, dots

CONFIG = ValidationConfig(depth=3, stride=2)


class Deterministic(WorldModel):
    """The dot's own environment: exact, or not listening, or standing still."""

    def __init__(self, kind: str) -> None:
        self.spec, self.kind = SPEC, kind
        self.calls: list[int] = []

    def begin(self, context: Context, tasks: Sequence[str]) -> State:
        assert len(tasks) == len(context.frames)
        return {"frames": context.frames[:, -1], "robot": context.robot[:, -1]}

    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Prediction:
        assert len(set(seeds)) == len(actions)
        self.calls.append(len(actions))
        if self.kind == "copy":
            moved, frames = state["robot"], state["frames"]
        else:
            made = 2 * actions if self.kind == "exact" else torch.full_like(actions, 0.4)
            at = state["robot"]
            for k in range(K):
                at = (at + made[:, k]).clamp(0, SIZE - 4)
            moved, frames = at, torch.stack([drawn(x) for x in at])
        doubt = torch.zeros(len(actions))
        return Prediction(
            state={"frames": frames, "robot": moved}, frames=frames, robot=moved, uncertainty=doubt
        )


def drawn(at: Tensor) -> Tensor:
    frame = torch.full((1, SIZE, SIZE, 3), 60, dtype=torch.uint8)
    y, x = (int(v) for v in at.round())
    frame[:, y : y + 4, x : x + 4] = 220
    return frame


def with_successes(episodes: list[Episode]) -> list[Episode]:
    """An episode ends when the dot reaches the right; the picture shows it by then."""
    made = []
    for episode in episodes:
        there = np.flatnonzero(episode.state[:, 1] > SIZE / 2)
        if not len(there):
            made.append(episode)
        if not len(there) or there[0] < 2:
            continue
        t = int(there[0]) + 1
        cut = {name: getattr(episode, name)[:t] for name in ("frames", "times", "state", "actions")}
        made.append(replace(episode, success_at=t - 1, **cut))
    return made


def found_of(kind: str) -> dict[str, Any]:
    return validate(Deterministic(kind), dots(12, seed=3), CONFIG, new_success_model(K).eval())


FRAMES = ("skill", "sensitivity")


def test_the_exact_world_passes():
    found = found_of("exact")
    assert all(found["checks"][name]["holds"] for name in FRAMES)
    for depth, row in enumerate(found["depths"]):
        assert row["depth"] == depth + 1 and row["windows"] == 12 * (5 - depth)
        assert row["skill_changed"]["value"] > 0.99 and row["state_error"] < 1e-4
        assert row["sensitivity"]["low"] > 10
    assert set(found["checks"]) == {*FRAMES, "auroc"}
    assert found["episodes"] == 12


def test_a_copy_of_the_last_frame_fails():
    found = found_of("copy")
    assert not found["passed"] and not any(found["checks"][name]["holds"] for name in FRAMES)
    assert [row["skill"]["value"] for row in found["depths"]] == [0, 0, 0]
    assert found["depths"][0]["sensitivity"]["value"] == 1


def test_a_world_that_does_not_listen_fails_by_its_sensitivity():
    assert found_of("deaf")["checks"]["sensitivity"] == {"value": 1.0, "above": 1.2, "holds": False}


def test_validations_are_the_same_for_the_same_seed_and_batched():
    episodes = dots(30, seed=3)
    model = Deterministic("exact")
    windows = validation_windows(episodes, model, replace(CONFIG, max_windows=100), seed=1)
    assert len(windows) == 100 and len(np.unique(windows.episode)) > 20
    again = validation_windows(episodes, model, replace(CONFIG, max_windows=100), seed=1)
    assert np.array_equal(windows.frames, again.frames)
    other = validation_windows(episodes, model, replace(CONFIG, max_windows=100), seed=2)
    assert not np.array_equal(windows.frames, other.frames)
    rollouts = predict(model, windows, windows.actions)
    assert model.calls == [64] * 3 + [36] * 3
    assert rollouts.frames.shape == (100, 4, 1, SIZE, SIZE, 3) and rollouts.uncertainty.shape == (100, 3)


def test_windows_are_spaced():
    times = np.array([0, 1, 4, 6, 7, 9])
    [episode] = dots(1, steps=9)
    episode = replace(episode, times=times, frames=episode.frames[:6], state=np.arange(12.0).reshape(6, 2))
    windows = validation_windows([episode], Deterministic("exact"), replace(CONFIG, stride=3), seed=0)
    assert windows.state[:, 1, 0].tolist() == [0, 4, 8], "frames 0, 2 and 4"


def test_shuffled_actions_are_another_episode_s():
    windows = validation_windows(dots(6, seed=3), Deterministic("exact"), CONFIG, seed=0)
    shuffled = shuffle_actions(windows, np.random.default_rng(0)).actions
    for i in range(len(windows)):
        from_ = [j for j in range(len(windows)) if np.array_equal(shuffled[i], windows.actions[j])]
        assert from_ and all(windows.episode[j] != windows.episode[i] for j in from_)


def test_the_success_model_is_classified_on_what_was_imagined():
    learn, held = with_successes(dots(120, seed=1)), with_successes(dots(120, seed=2))
    assert sum(e.success for e in held) > 10
    torch.manual_seed(0)
    success = new_success_model(K)
    learner = SuccessLearner(success, WorldModelConfig(success=SuccessLearnConfig(lr=2e-3)), seed=0)
    environment = Deterministic("exact")
    examples = Examples(learn, K)
    for _ in range(120):
        metrics = learner.step(examples, environment)
    assert set(metrics) == {"loss", "accuracy", "progress"}
    success.eval()
    config = replace(CONFIG, stride=1, max_windows=5000, auroc=0.7)
    exact = validate(environment, held, config, success)
    assert exact["passed"] and exact["checks"]["auroc"]["value"] > 0.7 and exact["threshold"] >= 0.5
    still = validate(Deterministic("copy"), held, config, success)
    assert still["checks"]["auroc"]["value"] < exact["checks"]["auroc"]["value"] - 0.1, "nothing moved"


def test_a_success_model_that_diverges_is_an_error_and_stays_as_it_was():
    examples, environment = Examples(with_successes(dots(30, seed=1)), K), Deterministic("exact")
    config = WorldModelConfig(success=SuccessLearnConfig(batch=8), longest=2)
    learner = SuccessLearner(new_success_model(K), config, seed=0)
    learner.step(examples, environment)
    with torch.no_grad():
        learner.model.out.bias.fill_(torch.nan)
    before = {k: v.clone() for k, v in learner.model.state_dict().items()}
    why = r"^the success model's .* not finite at step 2; lower world_model.success.lr"
    with pytest.raises(FloatingPointError, match=why):
        learner.step(examples, environment)
    now = learner.model.state_dict()
    assert all(torch.equal(v, now[k]) for k, v in before.items() if k != "out.bias")


def test_success_learning_needs_both_kinds():
    with pytest.raises(ValueError, match="0 frames show a success"):
        Examples(dots(3), K)


def test_half_of_what_is_drawn_are_successes():
    episodes, rng = with_successes(dots(20, seed=1)), np.random.default_rng(0)
    examples = Examples(episodes, K)
    at = examples.chunks(11, rng)
    hits = [
        episodes[p.episode].success_at - K < p.frame <= episodes[p.episode].success_at
        and episodes[p.episode].success
        for p in at
    ]
    assert hits == [True] * 5 + [False] * 6
    before, after, _, success, progress = examples.sample(11, rng)
    assert success.tolist() == hits and before.shape == after.shape == (11, 1, SIZE, SIZE, 3)
    assert (progress[:5] == 1).all() and not (progress[5:] == 1).any()


def test_pairs_that_were_seen_are_as_far_apart_in_successes_as_in_failures():
    """How far the dot's picture has moved tells nothing, when pairs are drawn alike."""
    times = np.arange(60)
    episode = replace(
        dots(1, steps=60)[0],
        frames=np.broadcast_to(times[:, None, None, None, None], (60, 1, 2, 2, 3)).astype(np.uint8),
        times=times, state=np.zeros((60, 2), np.float32), success_at=59,
    )  # fmt: skip
    before, after, _, success, _ = Examples([episode], K).sample(4000, np.random.default_rng(0))
    apart = (after.astype(int) - before)[:, 0, 0, 0, 0]
    assert set(apart.tolist()) == set(range(K + 1))
    assert apart[success].mean() == pytest.approx(apart[~success].mean(), abs=0.1)


def test_failures_are_cut_short_as_successes_are():
    rng = np.random.default_rng(0)
    steps = np.array([[2, 5], [3, 5]] + [[5, 5]] * 500 + [[1, 5]])
    success = np.zeros(steps.shape, bool)
    success[:2, 0] = True
    cut = match_cut_lengths(steps, success, rng)
    assert cut[:2].tolist() == steps[:2].tolist() and cut[-1, 0] == 1, "never more than was executed"
    assert set(cut[2:-1, 0].tolist()) == {2, 3} and 2.4 < cut[2:-1, 0].mean() < 2.6
    assert (cut[:, 1] == 5).all(), "nothing to compare with"


def one_pixel(*values: int) -> np.ndarray:
    """One camera, 1×2 pixels, of one colour each."""
    return np.stack([np.full((1, 1, 2, 3), v, np.uint8) for v in values])


def test_errors_are_sums_over_counted_pixels():
    rng = np.random.default_rng(0)
    a, b = (rng.integers(0, 256, (3, 2, 4, 5, 3), dtype=np.uint8) for _ in range(2))
    mask = rng.random((3, 2, 4, 5)) < 0.3
    sums = squared_errors(a, b, mask)
    for m in range(3):
        errors = [
            np.mean([(int(x) - int(y)) ** 2 for x, y in zip(a[m, v, i, j], b[m, v, i, j], strict=True)])
            for v, i, j in zip(*np.nonzero(mask[m]), strict=True)
        ]
        assert sums[m].tolist() == pytest.approx([sum(errors), len(errors)])
    assert mean_error(sums) == pytest.approx(sums[:, 0].sum() / mask.sum())
    assert mean_error(squared_errors(a, b)) == pytest.approx(((a.astype(float) - b) ** 2).mean())


def test_skill_and_sensitivity_by_hand():
    wanted, of = one_pixel(100, 100), np.arange(2)
    model, copy = squared_errors(one_pixel(98, 96), wanted), squared_errors(one_pixel(90, 110), wanted)
    assert skill(model, copy, of)["value"] == pytest.approx(1 - 10 / 100)
    assert sensitivity(model, copy, of)["value"] == pytest.approx(100 / 10)
    assert [*skill(copy, copy, of).values()] == pytest.approx([0, 0, 0])
    assert [*sensitivity(copy, copy, of).values()] == pytest.approx([1, 1, 1])
    exact = squared_errors(wanted, wanted)
    assert {*sensitivity(exact, copy, of).values()} == {np.inf}
    assert {*sensitivity(exact, exact, of).values()} == {1.0}


def test_windows_of_one_episode_are_drawn_together():
    """A hundred copies of ten rows say no more than the ten do."""
    values = np.random.default_rng(0).standard_normal(10)
    ten = bootstrap(np.arange(10), lambda rows: float(values[rows].mean()))
    assert ten["low"] < ten["value"] < ten["high"]
    copies, groups = np.tile(values, 100), np.tile(np.arange(10), 100)
    assert bootstrap(groups, lambda rows: float(copies[rows].mean())) == pytest.approx(ten)
    alone = bootstrap(np.arange(1000), lambda rows: float(copies[rows].mean()))
    assert alone["high"] - alone["low"] < 0.2 * (ten["high"] - ten["low"])


def test_a_statistic_that_is_not_always_there():
    labels = np.array([True] + [False] * 9)
    scores = np.arange(10.0)
    estimate = bootstrap(np.arange(10), lambda rows: auroc(scores[rows], labels[rows]))
    assert estimate["value"] == 0.0 and estimate["low"] == 0.0 <= estimate["high"]
    never = bootstrap(np.arange(10), lambda rows: auroc(scores[rows], np.zeros(len(rows), bool)))
    assert all(np.isnan(value) for value in never.values())


def test_auroc_is_the_share_of_pairs_in_order():
    rng = np.random.default_rng(0)
    scores, labels = rng.integers(0, 6, 40).astype(float), rng.random(40) < 0.4
    pairs = [(a > b) + 0.5 * (a == b) for a in scores[labels] for b in scores[~labels]]
    assert auroc(scores, labels) == pytest.approx(np.mean(pairs))
    assert auroc(np.array([1.0, 2, 3, 4]), np.array([False, False, True, True])) == 1.0
