# SPDX-License-Identifier: Apache-2.0
"""The kill switch."""

from __future__ import annotations

import math

from accerl_lerobot.world_model.guard import (
    KillSwitch,
)


def rollout(switch: KillSwitch, *outcomes: int) -> None:
    for outcome in outcomes:
        switch.add_imagined(bool(outcome))


def test_rollouts_that_succeed_too_often_trip_it():
    switch = KillSwitch(max_gap=0.3, window=4, outcomes=5)
    assert math.isnan(switch.share) and all(math.isnan(share) for share in switch.shares)
    rollout(switch, 1, 0, 1, 0)
    assert switch.share == 0.5
    for i in range(5):
        assert not switch.tripped, "not before there are so many real outcomes"
        switch.add_real(i < 0)
    assert switch.shares == (0.5, 0.0) and switch.tripped
    switch.reset()
    assert not switch.tripped and math.isnan(switch.share) and all(math.isnan(x) for x in switch.shares)


def test_promotions_do_not_make_it_forget():
    """Else a model that flatters would not be found out where its successors come before enough outcomes."""
    switch = KillSwitch(max_gap=0.3, window=2, outcomes=6)
    for _ in range(3):
        assert not switch.tripped
        rollout(switch, 1, 1)
        switch.add_real(False)
        switch.add_real(False)
        switch.reset() if not switch.tripped else None
    assert switch.tripped


def test_real_outcomes_before_the_window_is_full_do_not_count():
    switch = KillSwitch(max_gap=0.3, window=4, outcomes=2)
    rollout(switch, 1, 1, 1)
    for _ in range(5):
        switch.add_real(False)
    assert math.isnan(switch.shares[0]) and not switch.tripped
    rollout(switch, 1)
    switch.add_real(False)
    switch.add_real(True)
    assert switch.shares == (1.0, 0.5) and switch.tripped


def test_a_policy_that_learns_is_not_taken_for_a_world_model_that_flatters():
    """Reality is held against what was imagined when it happened, not against what is imagined now."""
    switch = KillSwitch(max_gap=0.3, window=2, outcomes=4)
    for promised, happened in ((0, 0), (0, 0), (1, 1), (1, 1)):
        rollout(switch, promised, promised)
        switch.add_real(bool(happened))
    assert switch.share == 1.0 and switch.shares == (0.5, 0.5) and not switch.tripped


def test_more_than_the_gap_not_as_much():
    exact = KillSwitch(max_gap=0.5, window=2, outcomes=1)
    rollout(exact, 1, 0)
    exact.add_real(False)
    assert exact.shares == (0.5, 0.0) and not exact.tripped
    better = KillSwitch(max_gap=0.1, window=1, outcomes=1)
    rollout(better, 0)
    better.add_real(True)
    assert not better.tripped, "reality may be as good as it likes"
