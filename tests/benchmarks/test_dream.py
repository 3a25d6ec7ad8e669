# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

import json

import pytest

from accerl_lerobot.errors import InputError
from benchmarks.__main__ import main
from benchmarks.dream import BenchDreamConfig, bench_dream, table


def test_it_measures(capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--batches=1,3", "--repeats=1", "--device=cpu", "--cameras=2", "--world_model.image_size=16"]
    small = ["--world_model.model.network.channels=8,8", "--world_model.learn.batch=2"]
    assert main(["dream", *options, *small]) == 0
    result = json.loads(capsys.readouterr().out)
    assert set(result["seconds"]) == {"dream", "judge", "learn"}
    for times in (*result["seconds"]["dream"].values(), *result["seconds"]["judge"].values()):
        assert 0 < times["min"] <= times["median"] <= times["max"]
    assert list(result["seconds"]["dream"]) == ["1", "3"] and result["seconds"]["learn"]["median"] > 0
    assert result["parameters"]["world"] > 1000 < result["parameters"]["success"]
    assert list(result["memory_gb"]) == ["dreamt", "learnt"]
    assert [*table(result).columns[0].cells][:2] == ["dream (1)", "dream (3)"]


def test_a_robot_without_a_state() -> None:
    small = BenchDreamConfig(batches=(2,), repeats=1, device="cpu", state_dim=0)
    assert bench_dream(small)["seconds"]["dream"]["2"]["median"] > 0


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("batches", ()),
        ("batches", (0,)),
        ("cameras", 0),
        ("action_dim", 0),
        ("state_dim", -1),
        ("repeats", 0),
    ],
)
def test_bad_values_name_their_field(name: str, value: object) -> None:
    with pytest.raises(InputError, match=f"^{name}="):
        BenchDreamConfig(**{name: value})  # type: ignore[arg-type]
