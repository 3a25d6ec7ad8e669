# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.world_model.config import ValidationConfig
from accerl_lerobot.world_model.data import Episode, WindowStart
from accerl_lerobot.world_model.learners import Examples, draw_pairs, imagine_pairs
from accerl_lerobot.world_model.rollout_eval import Scores, auroc, choose_threshold, score_episodes, subsample
from tests.world_model.test_pixels import SIZE, K, dots
from tests.world_model.test_validate import Deterministic

CONFIG = ValidationConfig(false_positives=0.0)


def ending_on_the_right(count: int) -> list[Episode]:
    """Episodes that end one step after the picture shows the dot there."""
    made = []
    for episode in dots(count, steps=30, seed=2):
        there = np.flatnonzero(episode.state[:, 1].round() > SIZE / 2)
        t = int(there[0]) + 1 if len(there) else 30
        cut = {k: getattr(episode, k)[:t] for k in ("frames", "times", "state", "actions")}
        if t > 2:
            made.append(replace(episode, **cut, success_at=t - 1 if len(there) else -1))
    return made


class OnTheRight:
    """A perfect success model of the dot."""

    def probabilities(self, before: np.ndarray, after: np.ndarray, task: np.ndarray) -> np.ndarray:
        x = (after[:, 0, :, :, 0] > 200).any(1).argmax(1)
        return np.asarray(0.1 + 0.8 * (x > SIZE / 2 + 0.5))


PERFECT: Any = OnTheRight()


def found(model: str, **options: Any) -> Scores:
    episodes = ending_on_the_right(60)
    return score_episodes(Deterministic(model), PERFECT, episodes, replace(CONFIG, **options), seed=0)


def test_an_exact_world_ends_as_reality_did():
    ended = found("exact")
    assert 10 < ended.achieved.sum() < len(ended.achieved) - 10
    counts = np.unique(ended.episode, return_counts=True)[1]
    assert set(counts) == {1, 2} and (counts == 2).mean() > 0.8, "from the beginning, and from later on"
    # A chunk that is held at its last action may go further than the episode did.
    assert ((ended.imagined > 0.5) == ended.achieved).mean() > 0.9


def test_where_nothing_moves_nothing_succeeds():
    still = found("copy")
    assert still.achieved.any() and still.imagined == pytest.approx(0.1)
    assert auroc(still.imagined, still.achieved) == 0.5


def test_what_follows_a_success_is_no_failure():
    [episode] = dots(1, steps=40)
    after = replace(episode, success_at=19)
    assert (after.starts, episode.starts, replace(episode, success_at=39).starts) == (20, 39, 39)
    model: Any = Deterministic("exact")
    for seed in range(20):
        assert score_episodes(model, PERFECT, [after], CONFIG, seed).achieved.all()
    chunks = Examples([after, episode], K).chunks(400, np.random.default_rng(0))
    assert max(p.frame for p in chunks if p.episode == 0) == 19


def made(imagined: list[float], achieved: list[int], own: Sequence[int] = ()) -> Scores:
    count = len(imagined)
    return Scores(
        imagined=np.array(imagined),
        achieved=np.array(achieved, bool), episode=np.arange(count), own=np.isin(np.arange(count), own),
    )  # fmt: skip


def test_the_threshold_lets_few_failures_through_those_of_the_policy_first():
    scores = ([0.95, 0.9, 0.6, 0.2, 0.92], [0, 0, 0, 0, 1])
    chosen = choose_threshold(made(*scores), CONFIG)
    assert chosen == pytest.approx(0.95) and chosen > 0.95
    assert choose_threshold(made(*scores), ValidationConfig(false_positives=0.25)) == pytest.approx(0.9)
    assert choose_threshold(made(*scores, own=[2, 3, 4]), CONFIG) == pytest.approx(0.6)
    assert choose_threshold(made([0.3, 0.2, 0.92], [0, 0, 1]), CONFIG) == 0.5, "never below one half"
    assert choose_threshold(made([0.9], [1], own=[0]), CONFIG) is None


def test_of_thresholds_that_are_strict_enough_the_one_that_tells_most_is_taken():
    # From 0.6 on three of four successes are told at the price of one failure of five; from 0.9 on only one.
    scores = ([0.55, 0.52, 0.3, 0.2, 0.8, 0.6, 0.7, 0.75, 0.95], [0, 0, 0, 0, 0, 1, 1, 1, 1])
    chosen = choose_threshold(made(*scores), ValidationConfig(false_positives=0.4))
    assert chosen == pytest.approx(0.55) and chosen > 0.55
    assert choose_threshold(made(*scores), CONFIG) == pytest.approx(0.8)
    # The policy's own: its failure is at 0.8, and its successes are above and below.
    theirs = made(*scores, own=[4, 7, 8])
    assert choose_threshold(theirs, ValidationConfig(false_positives=0.9)) == pytest.approx(0.8)


def test_a_success_model_learns_how_rollouts_end():
    """Pairs are of rollouts, the label is what really came of it, and near misses are drawn most."""
    episodes = ending_on_the_right(60)
    examples, rng = Examples(episodes, K), np.random.default_rng(0)
    imagined = imagine_pairs(examples, Deterministic("copy"), PERFECT, 20, 9, rng)
    before, after, _, achieved, progress = draw_pairs(*imagined, 8, rng)
    assert np.array_equal(before, after), "nothing moves in its rollouts"
    assert achieved.tolist() == [True] * 4 + [False] * 4 and before.shape == (8, 1, SIZE, SIZE, 3)
    assert (progress[:4] == 1).all()
    exact, weights = imagine_pairs(examples, Deterministic("exact"), PERFECT, 40, 9, rng)
    pairs = draw_pairs(exact, weights, 400, rng)
    assert PERFECT.probabilities(*pairs[:3])[pairs.success].mean() > 0.7
    assert set(np.round(np.unique(weights[~exact.success]), 6)) <= {0.2, 1.0}


def test_what_the_policy_itself_has_lived_through_is_tried_first():
    episodes = [replace(e, own=i in (4, 7)) for i, e in enumerate(dots(12))]
    at = [WindowStart(e, f) for e in range(12) for f in (0, 1)]
    for seed in range(5):
        chosen = subsample(episodes, at, 6, np.random.default_rng(seed))
        assert len(chosen) == 6 and chosen == sorted(chosen)
        assert {place for place in chosen if place.episode in (4, 7)} == {(4, 0), (4, 1), (7, 0), (7, 1)}
    assert subsample(episodes, at, 24, np.random.default_rng(0)) == at
    assert len(subsample(episodes, at, 3, np.random.default_rng(0))) == 3
