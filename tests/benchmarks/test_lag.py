# SPDX-License-Identifier: Apache-2.0
"""The lag study: what it compares, and a small one that is really run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import yaml

from accerl_lerobot.engine.config import RunConfig, encode
from accerl_lerobot.errors import InputError
from benchmarks import lag as bench
from benchmarks import study as studies
from benchmarks.lag import BenchLagConfig, cells
from benchmarks.study import Results
from tests.runs import tiny_run


def recipe(tmp_path: Path, checkpoint: Path) -> str:
    path = tmp_path / f"{checkpoint.name}.yaml"
    path.write_text(yaml.safe_dump(encode(tiny_run(checkpoint))))
    return str(path)


def small(tmp_path: Path, checkpoint: Path, **options: Any) -> BenchLagConfig:
    defaults = {
        "recipe": recipe(tmp_path, checkpoint),
        "output_dir": str(tmp_path / "study"),
        "algorithms": ("gipo", "ppo"),
        "lags": (0, 2),
        "seeds": (3, 4),
        "updates": 4,
        "episodes": 4,
    }
    return BenchLagConfig(**{**defaults, **options})


def a_summary(success: float, *, env_steps: int = 100, lag: float = 1.0) -> dict[str, Any]:
    return {
        "success_after": success, "n_after": 10, "env_steps": env_steps, "decisions": 10, "updates": 4,
        "lag_mean": lag, "lag_max": 5.0, "rl_s": 1.0,
    }  # fmt: skip


@pytest.fixture
def result(tmp_path: Path, tiny_checkpoint: Path) -> dict[str, Any]:
    config = small(tmp_path, tiny_checkpoint)
    success = {"gipo": {0: (0.9, 1.0), 2: (0.5, 0.6)}, "ppo": {0: (0.8, 0.7), 2: (0.0, 0.1)}}
    runs = []
    for cell in cells(config):
        seed, lag = cell.seed, cell.of["lag"]
        share = success[cell.of["algorithm"]][lag][seed - 3]
        runs.append((cell, a_summary(share, env_steps=97 + seed, lag=lag + seed - 3)))
    return bench.compare(config, Results({3: a_summary(0.4), 4: a_summary(0.5)}, runs))


def test_seeds_are_counted_together(result: dict[str, Any]):
    gipo = result["groups"][0]
    assert (gipo["algorithm"], gipo["lag"], gipo["successes"], gipo["n"]) == ("gipo", 0, 19, 20)
    assert gipo["by_seed"] == [0.9, 1.0] and gipo["env_steps"] == 100.5 and gipo["lag_mean"] == 0.5
    assert [(g["successes"]) for g in result["groups"]] == [19, 11, 15, 1]
    assert result["starts"] == {"3": 0.4, "4": 0.5} and len(result["cells"]) == 8
    json.dumps(result)


@pytest.mark.slow
def test_a_study_is_run_and_goes_on_where_it_was_stopped(tmp_path, tiny_checkpoint, monkeypatch):
    config = small(tmp_path, tiny_checkpoint, algorithms=("gipo",), lags=(2,), seeds=(3,))
    first = bench.bench_lag(config)
    (cell,) = first["cells"]
    assert (cell["algorithm"], cell["lag"], cell["seed"], cell["updates"], cell["n"]) == ("gipo", 2, 3, 4, 4)
    assert 0 < cell["lag_mean"] <= cell["lag_max"]
    study = tmp_path / "study"
    assert json.loads((study / "lag.json").read_text()) == json.loads(json.dumps(first))
    runs = ("start-seed3", "gipo-lag2-seed3")
    made = {run + end for run in runs for end in ("", ".log", ".yaml")} | {".lock"}
    assert {p.name for p in study.iterdir()} == made | {"lag.json", "lag.md", "lag.png"}

    (study / "gipo-lag2-seed3" / "summary.json").unlink()  # as if it had been stopped just before
    (cell_again,) = bench.bench_lag(config)["cells"]
    assert "going on from" in (study / "gipo-lag2-seed3.log").read_text()
    assert {**cell_again, "rl_s": 0} == {**cell, "rl_s": 0}
    cell = cell_again

    ran: list[str] = []

    def fake(self: Any, folder: Path, run: RunConfig) -> None:
        ran.append(folder.name)
        folder.mkdir()
        (folder / "config.yaml").write_text(yaml.safe_dump(encode(run)))
        (folder / "summary.json").write_text(json.dumps(a_summary(0.5)))

    monkeypatch.setattr(studies._Runner, "_one", fake)
    again = bench.bench_lag(small(tmp_path, tiny_checkpoint, lags=(2,), seeds=(3,)))
    assert ran == ["ppo-lag2-seed3"] and again["cells"][0] == cell
    with pytest.raises(InputError, match="gipo-lag2-seed3 in it was run with other settings; choose another"):
        bench.bench_lag(small(tmp_path, tiny_checkpoint, lags=(2,), seeds=(3,), updates=5))
    shutil.rmtree(study / "start-seed3")
    with pytest.raises(InputError, match="gipo-lag2-seed3 in it is older than start-seed3"):
        bench.bench_lag(small(tmp_path, tiny_checkpoint, lags=(2,), seeds=(3,)))
    assert ran == ["ppo-lag2-seed3", "start-seed3"]
