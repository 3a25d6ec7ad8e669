# SPDX-License-Identifier: Apache-2.0
"""Weights that a study holds back."""

from pathlib import Path

import pytest

from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.checkpoint.layout import TRAINING_STATE
from accerl_lerobot.engines import local
from accerl_lerobot.engines.config import LaunchConfig
from accerl_lerobot.errors import InputError
from benchmarks.study import BenchStudyConfig, HeldBackEngine, bench_study
from tests.runs import drive, tiny_run, until, updates


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("--trainer.hold_back=50 --replay.max_lag=50", "replay.max_lag=50: use more than trainer.hold_back"),
        ("--trainer.hold_back=-1", "trainer.hold_back='-1': use a number of updates"),
    ],
)
def test_weights_to_hold_back_are_checked(setting: str, message: str, tmp_path: Path):
    config = BenchStudyConfig(recipe="recipes/gipo.yaml", settings=(setting,), output_dir=str(tmp_path))
    with pytest.raises(InputError, match=message):
        bench_study(config)


def test_weights_held_back_act_so_many_updates_late_and_a_run_resumes(tiny_checkpoint: Path, tmp_path: Path):
    trainer = TrainerConfig(updates=14, batch_decisions=16, lr=1e-3, value_warmup_updates=0, probe_every=4)
    config = tiny_run(tiny_checkpoint, trainer=trainer, launch=LaunchConfig(engine="local"))

    def begin(state: Path | None = None) -> HeldBackEngine:
        engine = HeldBackEngine(4, config, ("match",), state=state)
        engine.train()
        return engine

    late = drive(begin())
    lags = [update["lag_mean"] for update in updates(late)]
    assert lags[0] == 0 and all(lag >= 4 for lag in lags[5:])
    assert max(update.get("logprob/mismatch_max", 0.0) for update in updates(late)) < 1e-4
    assert late[-1].inference["version"] == late[-1].version, "the last weights act at once"
    left = begin()
    before = until(left, 6)
    left.save(tmp_path)
    after = drive(begin(tmp_path / TRAINING_STATE))
    assert updates(before + after) == updates(late)
    with pytest.raises(InputError, match="not a state that accerl has saved"):  # it would lose its lag
        local.LocalEngine(config, ("match",), state=tmp_path / TRAINING_STATE)
