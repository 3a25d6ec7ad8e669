# SPDX-License-Identifier: Apache-2.0
"""The threshold by which dreams succeed as often as the episodes they begin in."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Decision, Request, Segment
from accerl_lerobot.world_model.calibration import Calibration
from accerl_lerobot.world_model.imagination_config import ImaginationConfig
from accerl_lerobot.world_model.imagine import Imagination
from accerl_lerobot.world_model.starts import StartPool
from tests.world_model.lived import K, decided, lived
from tests.world_model.test_imagine import Bright, Counting, bright, imagination, promotion
from tests.world_model.test_starts import pool

__all__ = ["bright"]  # a fixture


def test_it_lets_as_many_dreams_succeed_as_episodes_did():
    calibration = Calibration(4)
    for number, (achieved, highest) in enumerate([(True, 0.9), (False, 0.95), (False, 0.7), (False, 0.8)]):
        assert calibration.wants(True) and not calibration.complete(), number
        calibration.add(achieved, highest)
    assert calibration.complete() and calibration.threshold == pytest.approx((0.95 + 0.9) / 2)
    assert not calibration.wants(True) and not calibration.complete()
    calibration.reset()
    assert calibration.wants(True) and calibration.threshold is None
    for highest in (0.1, 0.2, 0.3, 0.4):
        calibration.add(highest > 0.1, highest)
    assert calibration.complete() and calibration.threshold == 0.5, "less than that says nothing"
    assert not Calibration(0).wants(True)


@pytest.mark.parametrize("outcome", [True, False])
def test_where_all_episodes_ended_alike_nothing_is_told(outcome: bool):
    calibration = Calibration(3)
    for highest in (0.1, 0.9, 0.5):
        calibration.add(outcome, highest)
    assert calibration.complete() and calibration.threshold is None and not calibration.wants(True)


def act(dreams: Imagination, requests: list[Request]) -> list[Decision]:
    """Actions that brighten dreams that begin where an episode succeeded by 0.2 a chunk, and others by
    0.18."""
    sizes = [1.0 if row.start.achieved else 0.9 for row in dreams._rows if row is not None]
    assert len(sizes) == len(requests)
    return [decided(np.full((K, 2), size), value=7.0, version=5) for size in sizes]


def calibrating(bright: Bright, episodes: int = 2) -> tuple[Imagination, list[Segment]]:
    dreams, made = imagination(Counting(), bright, horizon=None, calibrate=40, keyframes=0.0)
    for segment in (*lived(1, solve_at=2), *lived(3))[:episodes]:
        dreams.remember(segment)
    return dreams, made


def test_the_first_dreams_set_the_threshold_and_nothing_is_learnt_from_them(bright: Any):
    dreams, made = calibrating(bright)
    while bright.config.threshold == 0.55:
        assert all(row is None or row.start.origin.decision == 0 for row in dreams._rows)
        dreams.advance(act(dreams, dreams.requests()))
    assert made == [] and dreams.counters.dreams == dreams.counters.successes == 0
    assert dreams.counters.decisions == 40 * 4, (
        "whole dreams, though what they show would have been a success"
    )
    assert dreams.metrics()["threshold"] == bright.config.threshold == pytest.approx((0.8 + 0.72) / 2)
    assert dreams.switch.share != dreams.switch.share, "nothing is held against reality yet"
    for _ in range(4):
        dreams.advance(act(dreams, dreams.requests()))
    outcomes = {(s.origin.seed, len(s), s.success) for s in made if s.origin.decision == 0}
    assert outcomes <= {(1, 4, True), (3, 4, False)} and made


def test_an_episode_that_has_not_ended_is_no_measure(bright: Any):
    dreams, _ = imagination(Counting(), bright, horizon=None, calibrate=4)
    [*_, first, last] = lived(3, length=2)
    dreams.remember(first)
    assert dreams.requests() == [] and dreams.prepares and not dreams.on
    dreams.remember(last)
    assert len(dreams.requests()) == 4 and not dreams.prepares and dreams.on
    held: StartPool = pool(horizon=None)
    held.add(first)
    with pytest.raises(ValueError, match="no real experience"):
        held.draw(1, np.random.default_rng(0), told=True)


def test_it_waits_for_the_failures_which_end_last(bright: Any):
    """One of eight worlds succeeds at once: its episode alone would say that all do."""
    dreams, _ = imagination(Counting(), bright, horizon=None, calibrate=400, keyframes=0.0, ended=8)
    episodes = [*lived(1, solve_at=0), *(segment for seed in range(10, 17) for segment in lived(seed))]
    share = np.mean([episode.success for episode in episodes])
    assert len(episodes) == 8 and share < 0.3
    for episode in episodes:
        assert dreams.requests() == []
        dreams.remember(episode)
    while dreams._calibration.wants(True):
        dreams.advance(act(dreams, dreams.requests()))
    real = [achieved for achieved, _ in dreams._calibration._pairs]
    assert np.mean(real) == pytest.approx(share, abs=0.05)


def test_episodes_that_were_lost_are_not_waited_for(bright: Any):
    dreams, _ = imagination(Counting(), bright, horizon=None, calibrate=4, ended=8)
    for segment in (*lived(1, solve_at=2), *lived(3)):
        dreams.remember(segment)
    assert dreams.prepares and not dreams.requests()
    dreams.end_real()
    assert not dreams.prepares
    while dreams._calibration.wants(True):
        dreams.advance(act(dreams, dreams.requests()))
    assert bright.config.threshold != 0.55, "by the two that are known"


def test_where_no_beginning_is_known_and_none_will_come_it_dreams_as_it_is(bright: Any):
    dreams, made = imagination(Counting(), bright, horizon=None, calibrate=4, ended=8)
    dreams.remember(lived(3, length=2)[1])
    dreams.end_real()
    assert not dreams.prepares and dreams.on
    while not made:
        requests = dreams.requests()
        assert len(requests) == 4 and not any(row.calibrates for row in dreams._rows if row)
        dreams.advance([decided(np.full((K, 2), 0.1)) for _ in requests])
    dreams.swap(promotion(Counting(), bright, 7))
    assert dreams.on and dreams.requests() and bright.config.threshold == 0.55


def test_each_model_is_calibrated_anew(bright: Any):
    dreams, _ = calibrating(bright)
    while bright.config.threshold == 0.55:
        dreams.advance(act(dreams, dreams.requests()))
    other = Bright()
    other.config.threshold = 0.6
    dreams.swap(promotion(Counting(), other, 7))
    assert dreams.metrics()["threshold"] == 0.6
    dreams.requests()
    assert all(row is not None and row.calibrates for row in dreams._rows)


@pytest.mark.parametrize("rounds", [3, 30, 45])
def test_it_goes_on_where_it_was_left(bright: Any, rounds: int, tmp_path: Any):
    whole, made = calibrating(bright)
    for _ in range(rounds):
        whole.advance(act(whole, whole.requests()))
    snapshot.save(tmp_path / "state", whole.state())
    left = len(made)
    again, later = calibrating(Bright(), episodes=0)
    again.restore(snapshot.load(tmp_path / "state"))
    assert again.metrics()["threshold"] == whole.metrics()["threshold"]
    for _ in range(60):
        for dreams in (whole, again):
            dreams.advance(act(dreams, dreams.requests()))
    assert [(s.key, len(s), s.success) for s in made[left:]] == [(s.key, len(s), s.success) for s in later]
    assert again.metrics()["threshold"] == whole.metrics()["threshold"] and later


@pytest.mark.parametrize("other", [{"horizon": 4}, {"threshold": 0.9}])
def test_it_is_of_whole_dreams_and_finds_the_threshold_itself(other: dict[str, Any]):
    with pytest.raises(
        InputError, match="^imagination.calibrate=8: leave imagination.horizon and threshold out"
    ):
        ImaginationConfig(path="x", calibrate=8, **other)
    with pytest.raises(InputError, match="^imagination.calibrate=-1: use a whole number from 0"):
        ImaginationConfig(calibrate=-1)
