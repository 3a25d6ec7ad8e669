# SPDX-License-Identifier: Apache-2.0
"""The one-process engine: every algorithm trains in it, acting and learning agree, no time is left out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.algorithms import AlgorithmConfig
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.engines.config import LaunchConfig
from accerl_lerobot.engines.contract import Progress
from accerl_lerobot.timeline import read_timeline
from benchmarks.simulated_environment import LatencyConfig
from tests.runs import ALGORITHMS, drive, local_engine, tiny_run, trained, updates
from tests.timeline.folders import adds_up


@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm_trains(name: str, tiny_checkpoint: Path):
    algorithm = AlgorithmConfig.get_choice_class(name)(level="chunk", kl_coef=0.1)
    history, engine = trained(tiny_run(tiny_checkpoint, algorithm=algorithm))
    found = updates(history)
    assert len(found) == 12 and found[-1]["skipped"] == 0
    assert all(np.isfinite(value) for update in found for value in update.values())
    assert all(np.isfinite(tensor).all() for tensor in engine._adapter.export_trainable().values())


def test_acting_and_learning_agree_on_log_probs(tiny_checkpoint: Path):
    trainer = TrainerConfig(
        updates=16, batch_decisions=16, lr=1e-3, warmup_updates=2, value_warmup_updates=2,
        probe_every=3,
    )  # fmt: skip
    history, _ = trained(tiny_run(tiny_checkpoint, trainer=trainer))
    found = [u for u in updates(history) if "logprob/mismatch_max" in u]
    assert len(found) >= 3 and found[0]["update"] == 1
    assert max(u["logprob/mismatch_max"] for u in found) <= 1e-4
    assert all(u["logprob/mismatch_clip"] == 0.0 for u in found)
    assert max(u["ratio_max_dev"] for u in found[1:]) > 1e-3, "the weights should have moved"


@pytest.mark.slow
def test_weights_held_back_act_so_many_updates_late(tiny_checkpoint: Path):
    def lags(hold_back: int) -> tuple[list[float], Progress]:
        fields: dict[str, Any] = {"updates": 14, "batch_decisions": 16, "lr": 1e-3, "value_warmup_updates": 0}
        trainer = TrainerConfig(**fields, hold_back=hold_back, probe_every=4)
        launch = LaunchConfig(engine="local")
        history, _ = trained(tiny_run(tiny_checkpoint, trainer=trainer, launch=launch))
        assert max(u.get("logprob/mismatch_max", 0.0) for u in updates(history)) < 1e-4
        return [u["lag_mean"] for u in updates(history)], history[-1]

    (prompt, end), (late, other_end) = lags(0), lags(4)
    assert late[:1] == prompt[:1] == [0.0]
    assert all(lag >= 4 for lag in late[5:]) and max(prompt) < 4, "samples of an acting policy 4 updates old"
    assert end.inference["version"] == other_end.inference["version"] == 14, "the last weights act at once"


def test_a_nan_from_the_world_is_counted_and_the_run_goes_on(tiny_checkpoint: Path):
    config = tiny_run(tiny_checkpoint, env=LatencyConfig(max_steps=16, nan_after=21))
    history, _ = trained(config)
    assert history[-1].done and history[-1].rollout["dropped_nonfinite"] > 0
    assert history[-1].replay["dropped_nonfinite"] == 0, "the runner should have kept it from replay"


def test_it_is_one_row_of_the_timeline(tiny_checkpoint: Path, tmp_path: Path):
    engine = local_engine(tiny_run(tiny_checkpoint, output_dir=str(tmp_path)))
    engine.train()
    drive(engine)
    engine.save(tmp_path / "saved")
    engine.close()
    assert (tmp_path / "episodes.jsonl").stat().st_size
    timeline = read_timeline(tmp_path)
    adds_up(timeline)
    assert [row.worker for row in timeline.rows] == ["local"]
    assert timeline.shares()["local"].keys() == {"recovery", "compute", "wait_in", "checkpoint"}
