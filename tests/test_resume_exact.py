# SPDX-License-Identifier: Apache-2.0
"""The engine in one process; a run that was left is the run that was never left, to the last bit."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.algorithms import PPOConfig, chunk_critic
from accerl_lerobot.checkpoint.layout import TRAINING_STATE
from accerl_lerobot.engines import Progress
from accerl_lerobot.engines.config import RunConfig
from accerl_lerobot.engines.local import LocalEngine
from accerl_lerobot.evaluation import evaluation_plans
from accerl_lerobot.timeline import read_timeline
from accerl_lerobot.world_model.latent import LatentModel
from tests.runs import changed, drive, local_engine, off_policy_run, tiny_run, until, updates
from tests.timeline.folders import adds_up

CASES = ("ratio", "counted episodes, several tasks", "chunk critic on a latent state")


def config_of(checkpoint: Path, case: str) -> RunConfig:
    learn = {"lr": 1e-3, "advantage_memory": 0.5}
    if "critic" in case:
        return off_policy_run(checkpoint, seed=3, trainer=learn | {"value_warmup_updates": 9})
    config = tiny_run(checkpoint, seed=3, trainer=learn | {"probe_every": 4})
    ppo: Any = {"algorithm": PPOConfig(level="chunk", kl_coef=0.1), "rollout": {"episodes": 30}}
    return changed(config, env={"task": "match,mirror"}, **ppo) if "tasks" in case else config


@pytest.fixture(autouse=True, scope="module")
def few_first_steps() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LatentModel, "first_steps", 5)
        patch.setattr(LatentModel, "steps_per_decision", 0.1)
        patch.setattr(chunk_critic, "LEAST_TRANSITIONS", 40)
        yield


def begin(checkpoint: Path, case: str, state: Path | None = None) -> LocalEngine:
    tasks = ("match", "mirror") if "tasks" in case else ("match",)
    engine = local_engine(config_of(checkpoint, case), tasks, state)
    if state is None:
        engine.plan(evaluation_plans(tasks, 9, "during"))  # some of them are under way when it is left
    engine.train()
    return engine


def told(history: list[Progress]) -> list[Any]:
    """All that a run says, and nothing of when it was asked."""
    episodes = [(e.plan, e.success, e.episode_return, e.versions) for p in history for e in p.episodes]
    return [updates(history), episodes, history[-1].rollout, history[-1].replay]


@pytest.mark.parametrize("case", CASES)
def test_a_run_that_was_left_twice_goes_on_as_if_it_had_not(case: str, tiny_checkpoint: Path, tmp_path: Path):
    whole = begin(tiny_checkpoint, case)
    begun = until(whole, 3)
    whole.save(tmp_path / "3")  # which changes nothing
    expected = told(begun + drive(whole))
    engine, history = begin(tiny_checkpoint, case), []
    for version in (1, 6):
        history += until(engine, version)
        saved = engine.save(tmp_path / str(version))
        assert (saved.version, saved.updates) == (history[-1].version, [])
        engine.close()
        engine = begin(tiny_checkpoint, case, tmp_path / str(version) / TRAINING_STATE)
    after = drive(engine)
    assert told(history + after) == expected and len(after) > 1
    for name, tensor in engine._adapter.export_trainable().items():
        np.testing.assert_array_equal(tensor, whole._adapter.export_trainable()[name])
    assert all(np.isfinite(value) for update in expected[0] for value in update.values())
    if "tasks" in case:
        probes = [u["logprob/mismatch_max"] for u in expected[0] if "logprob/mismatch_max" in u]
        assert len(probes) >= 3 and max(probes) <= 1e-4, "acting and learning agree"
        assert max(u["ratio_max_dev"] for u in expected[0]) > 1e-3, "although the weights moved"


def test_a_run_left_before_it_began_learning(tiny_checkpoint: Path, tmp_path: Path):
    """And what it did is one row of the timeline."""
    config = tiny_run(tiny_checkpoint, seed=3)
    first = local_engine(changed(config, output_dir=str(tmp_path)))
    first.save(tmp_path)
    first.train()
    again = local_engine(config, state=tmp_path / TRAINING_STATE)
    again.train()
    assert told(drive(first)) == told(drive(again))
    first.close()
    assert (tmp_path / "episodes.jsonl").stat().st_size
    timeline = read_timeline(tmp_path)
    adds_up(timeline)
    assert timeline.shares().keys() == {"local"}
    assert timeline.shares()["local"].keys() == {"recovery", "compute", "wait_in", "checkpoint"}
