# SPDX-License-Identifier: Apache-2.0
"""Several who dream beside each other: who dreams what, and what they say as one."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import TRAINING_STATE
from accerl_lerobot.engine.config import RunConfig, parse
from accerl_lerobot.engine.dream_workers import DreamWorker
from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.imagination_config import ImaginationConfig
from accerl_lerobot.world_model.pool import DREAMS, check_workers, part, together
from tests.test_imagining import dreaming


@pytest.mark.parametrize(
    ("dreams", "workers", "parts"), [(32, 1, [32]), (32, 3, [11, 11, 10]), (4, 4, [1] * 4)]
)
def test_all_dreams_are_somebody_s(dreams: int, workers: int, parts: list[int]):
    config = ImaginationConfig(share=0.5, model="oracle", dreams=dreams, workers=workers)
    assert [part(config, i).dreams for i in range(workers)] == parts
    assert all(part(config, i).workers == 1 and part(config, i).share == 0.5 for i in range(workers))


def test_what_they_report_is_told_as_one():
    one = {"dreams": 10.0, "decisions": 40.0, "successes": 4.0, "doubted": 1.0}
    other = {"dreams": 30.0, "decisions": 90.0, "successes": 8.0, "doubted": 0.0}
    shares = {"success": 0.4, "success_beside": 0.5, "success_real": 0.25}
    found = together([one | shares | {"version": 60, "on": 1}, other | shares | {"version": 40, "on": 0}])
    sums = {"dreams": 40.0, "decisions": 130.0, "successes": 12.0, "doubted": 1.0}
    assert found == sums | shares | {"version": 40, "on": 1}
    nothing_yet = dict.fromkeys(shares, math.nan)
    assert math.isnan(together([one | nothing_yet | {"version": 0, "on": 1}] * 2)["success"])
    assert together([one | {"on": 0.0}]) == one | {"on": 0.0}
    assert together([]) == {} == together([one, {}])


def test_going_on_with_another_number_is_refused(tmp_path: Path):
    for name in (DREAMS, f"{DREAMS}1"):
        snapshot.save(tmp_path / name, {"dreams": {}})
    check_workers(tmp_path, 2)
    for workers in (1, 3):
        with pytest.raises(InputError, match=rf"imagination\.workers={workers}: this run has 2; leave"):
            check_workers(tmp_path, workers)


@pytest.mark.parametrize(
    ("options", "match"),
    [
        (["--imagination.workers=0"], r"imagination\.workers=0: use a whole number from 1"),
        (["--imagination.workers=33"], r"imagination\.workers=33: use at most imagination\.dreams, 32"),
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
    config = dreaming(tiny_checkpoint, model="oracle", workers=2)
    state = tmp_path / TRAINING_STATE
    keys = set()
    for index in range(2):
        worker = DreamWorker(config, index=index)
        keys.add(worker._dreams._name)
        assert worker._dreams.config.dreams == 2
        worker._cursor = 5 + index
        worker.save(tmp_path)
    assert keys == {"dream0", "dream1"}, "keys of segments tell them apart"
    again = [DreamWorker(config, state, index=index) for index in range(2)]
    assert [worker._cursor for worker in again] == [5, 6]
    drawn = [worker._dreams._rng.integers(2**62, size=4).tolist() for worker in again]
    alone = np.random.default_rng((config.seed, 3)).integers(2**62, size=4).tolist()
    assert drawn[0] == alone != drawn[1]
    with pytest.raises(InputError, match=r"imagination\.workers=1: this run has 2"):
        DreamWorker(dreaming(tiny_checkpoint, model="oracle"), state)
