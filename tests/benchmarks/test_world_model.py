# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

import json

import pytest

from benchmarks.__main__ import main
from benchmarks.world_model import table


def test_it_measures(capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--batches=1,3", "--repeats=1", "--device=cpu", "--cameras=2", "--world_model.image_size=16"]
    small = ["--world_model.model.channels=8,8", "--world_model.learn.batch=2"]
    assert main(["world_model", *options, *small]) == 0
    result = json.loads(capsys.readouterr().out)
    assert set(result["seconds"]) == {"predict", "classify", "learn"}
    for times in (*result["seconds"]["predict"].values(), *result["seconds"]["classify"].values()):
        assert 0 < times["min"] <= times["median"] <= times["max"]
    assert list(result["seconds"]["predict"]) == ["1", "3"] and result["seconds"]["learn"]["median"] > 0
    assert result["parameters"]["world"] > 1000 < result["parameters"]["success"]
    assert list(result["memory_gb"]) == ["predicted", "learnt"]
    assert [*table(result).columns[0].cells][:2] == ["predict (1)", "predict (3)"]
