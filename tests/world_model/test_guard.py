# SPDX-License-Identifier: Apache-2.0
"""The kill switch, and several workers that imagine."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import TRAINING_STATE
from accerl_lerobot.engine.config import RunConfig, parse
from accerl_lerobot.engine.imagination_workers import ImaginationWorker
from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.config import ImaginationConfig
from accerl_lerobot.world_model.imagination.guard import (
    IMAGINATION,
    KillSwitch,
    check_workers,
    combine_metrics,
    worker_config,
)
from tests.test_imagination import imagining


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


@pytest.mark.parametrize(
    ("rollouts", "workers", "parts"), [(32, 1, [32]), (32, 3, [11, 11, 10]), (4, 4, [1] * 4)]
)
def test_every_rollout_has_a_worker(rollouts: int, workers: int, parts: list[int]):
    config = ImaginationConfig(share=0.5, model="oracle", rollouts=rollouts, workers=workers)
    assert [worker_config(config, i).rollouts for i in range(workers)] == parts
    assert all(
        worker_config(config, i).workers == 1 and worker_config(config, i).share == 0.5
        for i in range(workers)
    )


def test_what_they_report_is_told_as_one():
    one = {"rollouts": 10.0, "decisions": 40.0, "successes": 4.0, "uncertain": 1.0}
    other = {"rollouts": 30.0, "decisions": 90.0, "successes": 8.0, "uncertain": 0.0}
    shares = {"success": 0.4, "success_imagined": 0.5, "success_real": 0.25}
    found = combine_metrics(
        [one | shares | {"version": 60, "on": 1}, other | shares | {"version": 40, "on": 0}]
    )
    sums = {"rollouts": 40.0, "decisions": 130.0, "successes": 12.0, "uncertain": 1.0}
    assert found == sums | shares | {"version": 40, "on": 1}
    nothing_yet = dict.fromkeys(shares, math.nan)
    assert math.isnan(combine_metrics([one | nothing_yet | {"version": 0, "on": 1}] * 2)["success"])
    assert combine_metrics([one | {"on": 0.0}]) == one | {"on": 0.0}
    assert combine_metrics([]) == {} == combine_metrics([one, {}])


def test_going_on_with_another_number_is_refused(tmp_path: Path):
    for name in (IMAGINATION, f"{IMAGINATION}1"):
        snapshot.save(tmp_path / name, {"imagination": {}})
    check_workers(tmp_path, 2)
    for workers in (1, 3):
        with pytest.raises(InputError, match=rf"imagination\.workers={workers}: this run has 2; leave"):
            check_workers(tmp_path, workers)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        (["--imagination.workers=0"], r"imagination\.workers=0: use a whole number from 1"),
        (["--imagination.workers=33"], r"imagination\.workers=33: use at most imagination\.rollouts, 32"),
        (
            ["--imagination.workers=2", "--launch.engine=local"],
            r"imagination\.workers=2: launch\.engine=local is",
        ),
    ],
)
def test_numbers_that_mean_nothing_are_refused(options: list[str], match: str):
    with pytest.raises(InputError, match=match):
        parse(RunConfig, options)


def test_each_saves_its_own_and_goes_on_with_it(tiny_checkpoint: Path, tmp_path: Path):
    config = imagining(tiny_checkpoint, model="oracle", workers=2)
    state = tmp_path / TRAINING_STATE
    keys = set()
    for index in range(2):
        worker = ImaginationWorker(config, index=index)
        keys.add(worker._imagination._run.name)
        assert worker._imagination.config.rollouts == 2
        worker._cursor = 5 + index
        worker.save(tmp_path)
    assert keys == {"imagination0", "imagination1"}, "keys of segments tell them apart"
    again = [ImaginationWorker(config, state, index=index) for index in range(2)]
    assert [worker._cursor for worker in again] == [5, 6]
    drawn = [worker._imagination._rng.integers(2**62, size=4).tolist() for worker in again]
    alone = np.random.default_rng((config.seed, 3)).integers(2**62, size=4).tolist()
    assert drawn[0] == alone != drawn[1]
    with pytest.raises(InputError, match=r"imagination\.workers=1: this run has 2"):
        ImaginationWorker(imagining(tiny_checkpoint, model="oracle"), state)
