# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Several ranks make the updates that one makes, whatever each keeps; and go on from each other's checkpoints.

Ranks are processes that talk through gloo on the loopback, one group of 2 and one of 4 for the whole module;
PyTorch's collectives are real, so is FSDP2.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from accerl_lerobot import snapshot
from accerl_lerobot.algorithms import GIPOConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.trainer.batch import turns
from accerl_lerobot.trainer.config import TrainerConfig
from accerl_lerobot.trainer.ranks import Ranks
from accerl_lerobot.trainer.sharding import Watch, arrange
from accerl_lerobot.trainer.update import Update
from tests.trainer import sharded
from tests.trainer.linear import LinearAdapter

TOLERANCE = 1e-5
SHARDINGS = ("ddp", "zero2", "zero3")
NAMES = tuple(sharded.cases())
OF_A_PART = ("ess", "explained_variance", "log_ratio_p05", "log_ratio_p50", "log_ratio_p95")
"""No means over decisions: what is reported is the mean over parts of the batch, as with micro-batches."""
OF_RATIOS = ("approx_kl", "clip_fraction", "low_weight")
"""Means over ratios; the same where decisions have different numbers of them."""
GROUPS = {2: NAMES, 4: ("parts", "few", "layers")}
RUNS = [(size, how, name) for size, names in GROUPS.items() for how in SHARDINGS for name in names]


@pytest.fixture(scope="module")
def alone() -> dict[str, dict[str, Any]]:
    """What one rank makes of every case."""
    found = {}
    for name, case in sharded.cases().items():
        found[name] = sharded.run(case, sharded.config_of(case, "none", 1), Ranks())
    return found


@pytest.fixture(scope="module")
def folder(alone: dict[str, dict[str, Any]], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What groups of 2 and of 4 make of them, from the beginning and from one rank's checkpoint."""
    directory = tmp_path_factory.mktemp("ranks")
    for name, result in alone.items():
        snapshot.save(directory / "alone" / name, result["half"])
    for size, names in GROUPS.items():
        results = directory / str(size)
        results.mkdir()
        place = torch.multiprocessing.get_context("spawn").SimpleQueue()
        arguments = (size, place, names, directory / "alone", results)
        torch.multiprocessing.spawn(sharded.work, arguments, nprocs=size)
    return directory


@pytest.fixture(params=RUNS, ids=lambda run: f"{run[2]}-{run[1]}-{run[0]}")
def made(request: pytest.FixtureRequest, folder: Path) -> tuple[str, list[dict[str, Any]]]:
    """A case, and what every rank has made of it."""
    size, how, name = request.param
    return name, [snapshot.load(folder / str(size) / f"{name}.{how}.{rank}") for rank in range(size)]


def assert_same(found: dict[str, Any], expected: dict[str, Any], name: str) -> None:
    for key, tensor in expected["weights"].items():
        np.testing.assert_allclose(found["weights"][key], tensor, rtol=TOLERANCE, atol=TOLERANCE, err_msg=name)
    assert_same_metrics(found["metrics"], expected["metrics"], name)


def assert_same_metrics(found: list[dict[str, float]], expected: list[dict[str, float]], name: str) -> None:
    assert len(found) == len(expected)
    for update, (mine, theirs) in enumerate(zip(found, expected, strict=True)):
        assert mine.keys() == theirs.keys()
        uneven = OF_RATIOS if name == "counted" else ()
        for key in mine.keys() - {*OF_A_PART, *uneven}:
            close = pytest.approx(theirs[key], rel=TOLERANCE, abs=TOLERANCE, nan_ok=True)
            assert mine[key] == close, f"{name}, update {update}: {key}"


# ---- with other processes


def test_ranks_make_the_updates_of_one(made: Any, alone: dict[str, dict[str, Any]]):
    name, results = made
    before = sharded.cases()[name].adapter().export_trainable()
    expected = alone[name]
    moved = [np.abs(expected["weights"][key] - tensor).max() for key, tensor in before.items()]
    assert max(moved) > 1e-2, "the case teaches nothing"
    for result in results:
        assert_same(result, expected, name)


def test_ranks_know_the_same_to_the_last_bit(made: Any):
    """So that none of them skips an update that another makes."""
    first, *others = made[1]
    for other in others:
        assert [list(m) for m in first["metrics"]] == [list(m) for m in other["metrics"]]
        for mine, theirs in zip(first["metrics"], other["metrics"], strict=True):
            np.testing.assert_array_equal(list(mine.values()), list(theirs.values()))
        for key, tensor in first["weights"].items():
            np.testing.assert_array_equal(tensor, other["weights"][key])


def test_ranks_go_on_from_the_checkpoint_of_one(made: Any, alone: dict[str, dict[str, Any]]):
    name, results = made
    expected = alone[name]
    for result in results:
        resumed = result["resumed"]
        half = len(expected["metrics"]) - len(resumed["metrics"])
        assert half > 0
        assert_same(resumed, expected | {"metrics": expected["metrics"][half:]}, name)


def test_one_goes_on_from_the_checkpoint_of_ranks(made: Any, alone: dict[str, dict[str, Any]]):
    name, results = made
    case, expected = sharded.cases()[name], alone[name]
    saved = results[0]["half"]
    assert saved["update"].keys() == expected["half"]["update"].keys()
    resumed = sharded.run(case, sharded.config_of(case, "none", 1), Ranks(), saved)
    half = len(expected["metrics"]) - len(resumed["metrics"])
    assert_same(resumed, expected | {"metrics": expected["metrics"][half:]}, name)


def test_the_cases_meet_what_they_are_for(alone: dict[str, dict[str, Any]]):
    assert alone["broken"]["metrics"][-1]["skipped"] == 2
    assert any("logprob/mismatch_mean" in metrics for metrics in alone["whole"]["metrics"])
    assert all(metrics["kl_reference"] > 0 for metrics in alone["layers"]["metrics"][2:])
    assert min(metrics["decisions"] for metrics in alone["few"]["metrics"]) == 1, "four ranks, one decision"
    assert all(metrics["grad_norm"] > 0.05 for metrics in alone["whole"]["metrics"]), "clipped"
