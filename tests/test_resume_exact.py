# SPDX-License-Identifier: Apache-2.0
"""The engine in one process; a run that was left is the run that was never left, to the last bit."""

import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.algorithms import AlgorithmConfig, chunk_critic
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.checkpoint.layout import TRAINING_STATE
from accerl_lerobot.engines import Progress
from accerl_lerobot.engines.config import LaunchConfig, RunConfig
from accerl_lerobot.engines.local import LocalEngine
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.evaluation import evaluation_plans
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.timeline import read_timeline
from accerl_lerobot.world_model.latent import LatentModel
from tests.runs import ALGORITHMS, drive, local_engine, off_policy_run, tiny_run, trained, until, updates
from tests.timeline.folders import adds_up

CASES: dict[str, dict[str, Any]] = {
    "ratio": {},
    "counted episodes, several tasks": {
        "env": SimulatedConfig(max_steps=16, task="match,mirror"),
        "rollout": RolloutConfig(environments=4, segment_length=3, episodes=30),
        "trainer": {"probe_every": 4},
    },
    "chunk critic on a latent state": {},
}


def config_of(checkpoint: Path, case: str) -> RunConfig:
    sections = dict(CASES[case])
    trainer: dict[str, Any] = {"updates": 12, "batch_decisions": 16, "lr": 1e-3, "advantage_memory": 0.5}
    sections["trainer"] = TrainerConfig(**trainer | {"warmup_updates": 2} | sections.pop("trainer", {}))
    make = off_policy_run if "critic" in case else tiny_run
    return make(checkpoint, seed=3, launch=LaunchConfig(engine="local"), **sections)


@pytest.fixture(autouse=True, scope="module")
def few_first_steps() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LatentModel, "first_steps", 5)
        patch.setattr(LatentModel, "steps_per_decision", 0.1)
        patch.setattr(chunk_critic, "LEAST_TRANSITIONS", 40)
        yield


def begin(checkpoint: Path, case: str, state: Path | None = None) -> LocalEngine:
    """An engine that trains, from the beginning or from `state`."""
    tasks = ("match", "mirror") if "tasks" in case else ("match",)
    engine = local_engine(config_of(checkpoint, case), tasks, state)
    if state is None:
        engine.plan(evaluation_plans(tasks, 9, "during"))  # some of them are under way when it is left
    engine.train()
    return engine


def weights(engine: LocalEngine) -> dict[str, np.ndarray]:
    return {name: tensor.copy() for name, tensor in engine._adapter.export_trainable().items()}


def told(history: list[Progress]) -> list[Any]:
    """All that a run says, and nothing of when it was asked."""
    episodes = [(e.plan, e.success, e.episode_return, e.versions) for p in history for e in p.episodes]
    return [updates(history), episodes, history[-1].rollout, history[-1].replay]


Whole = Callable[[str], tuple[list[Any], dict[str, np.ndarray]]]


@pytest.fixture(scope="module")
def whole(tiny_checkpoint: Path) -> Whole:
    """Words of a case's run that was never left, and the weights that it ends with."""

    @functools.cache
    def made(case: str) -> tuple[list[Any], dict[str, np.ndarray]]:
        engine = begin(tiny_checkpoint, case)
        said = told(drive(engine))
        engine.close()
        return said, weights(engine)

    return made


@pytest.mark.parametrize(
    ("case", "left_at"),
    [*((case, 6) for case in CASES), pytest.param(list(CASES)[-1], 1, marks=pytest.mark.slow)],
)
def test_a_run_that_was_left_goes_on_as_if_it_had_not(
    case: str, left_at: int, whole: Whole, tiny_checkpoint: Path, tmp_path: Path
):
    expected, learnt = whole(case)
    first = begin(tiny_checkpoint, case)
    before = until(first, left_at)
    saved = first.save(tmp_path)
    assert (saved.version, saved.updates) == (before[-1].version, [])
    if case == "ratio":
        assert told(before + drive(first)) == expected, "saving changes nothing"
    first.close()
    again = begin(tiny_checkpoint, case, tmp_path / TRAINING_STATE)
    after = drive(again)
    assert told(before + after) == expected and len(after) > 1
    for name, tensor in weights(again).items():
        np.testing.assert_array_equal(tensor, learnt[name])
    again.close()


def test_a_run_left_before_it_began_learning(tiny_checkpoint: Path, tmp_path: Path):
    config = tiny_run(tiny_checkpoint, seed=3)
    first = LocalEngine(config, ("match",))
    first.save(tmp_path)
    first.train()
    again = LocalEngine(config, ("match",), state=tmp_path / TRAINING_STATE)
    again.train()
    assert told(drive(first)) == told(drive(again))


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
    assert max(u["ratio_max_dev"] for u in found[1:]) > 1e-3, "the weights should have moved"


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
