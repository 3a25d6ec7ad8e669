# SPDX-License-Identifier: Apache-2.0
"""Faults of a run's processes: failures, hangs and kills. Inference and trainer are stand-ins."""

import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import ray

from accerl_lerobot import errors
from accerl_lerobot.engines.ray_engine import RayEngine
from accerl_lerobot.engines.stopping import WorkerError
from accerl_lerobot.evaluation import evaluation_plans
from accerl_lerobot.inference import worker as inference_worker
from accerl_lerobot.rollout import worker as rollout_worker
from accerl_lerobot.rollout.runner import EpisodeResult
from benchmarks.simulated_environment import LatencyConfig
from benchmarks.victims import alive
from tests.light_workers import FULL, HANGS, LightInference, WarningRollout
from tests.runs import collect, drive, eventually, polls, until, updates

SLOW = LatencyConfig(max_steps=16, frame_ms=4.0)
HARD = LatencyConfig(max_steps=16, tolerance=0.02, frame_ms=20.0)


@pytest.fixture
def engine(light_engine: Callable[..., RayEngine]) -> Callable[..., RayEngine]:
    two: Any = {"rollout": {"workers": 2, "environments": 2}, "trainer": {"updates": 1_000_000}}
    return lambda **sections: light_engine(**{"env": SLOW, **two, **sections})


def until_failure(engine: RayEngine) -> str:
    with pytest.raises(RuntimeError) as caught:
        drive(engine)
    return str(caught.value)


def until_training(engine: RayEngine) -> None:
    engine.train()
    until(engine, 2)


def gone(pid: int) -> bool:
    return eventually(lambda: not alive(pid))


def indices(results: list[EpisodeResult], group: str) -> list[int]:
    """Of the group's episodes; and none that explored was reported twice."""
    seeds = [r.plan.seed for r in results if r.plan.explore]
    assert len(set(seeds)) == len(seeds)
    return sorted(r.plan.index for r in results if r.plan.group == group)


def test_a_run_ends_by_itself_and_closing_leaves_no_process(engine, monkeypatch, caplog):
    """Warnings of workers are shown once, those of their last moments too."""
    monkeypatch.setattr(rollout_worker, "RolloutWorker", WarningRollout)
    errors.warn_once.cache_clear()
    one = engine(trainer={"updates": 12})
    pids = one.pids()
    assert set(pids) == {"inference", "replay", "trainer", "rollout 0", "rollout 1"}
    one.plan(evaluation_plans(("match",), 5, "before"))
    assert indices(collect(one, "before", 5), "before") == list(range(5))
    one.train()
    history = drive(one)
    assert [u["update"] for u in updates(history)] == [float(i) for i in range(1, 13)]
    assert history[-1].version == 12 and history[-1].replay["trained_decisions"] >= 12 * 16
    one.plan(evaluation_plans(("match",), 5, "after"))
    assert {r.versions for r in collect(one, "after", 5)} == {(12, 12)}
    os.kill(pids["trainer"], signal.SIGKILL)  # it has done its work, but has not been asked to save it
    with pytest.raises(RuntimeError, match="trainer worker failed for good:"):
        collect(one, "nothing", 1)
    one.close()
    one.close()
    assert [name for name, pid in pids.items() if not gone(pid)] == []
    warnings = [(r.name, r.getMessage()) for r in caplog.records if r.levelname == "WARNING"]
    assert warnings == [("accerl_lerobot.envs", "info has no is_success")]


def test_an_evaluation_has_no_trainer(engine):
    one = engine(learns=False)
    assert set(one.pids()) == {"inference", "replay", "rollout 0", "rollout 1"}
    one.plan(evaluation_plans(("match",), 5, "eval"))
    assert len(collect(one, "eval", 5)) == 5


def test_a_world_that_keeps_crashing_ends_the_run_with_its_own_traceback(engine):
    one = engine(env=LatencyConfig(crash_after=30), rollout={"environments": 2}, launch={"max_restarts": 2})
    one.train()
    text = until_failure(one)
    assert text.startswith("rollout 0 worker failed for good after 2 restarts")
    assert "simulated crash after 30 env steps" in text and "simulated_environment.py" in text


@pytest.mark.slow  # `test_launch` kills a rollout worker
def test_a_rollout_worker_that_hangs_is_replaced_and_a_lost_replay_ends_the_run(engine):
    one = engine(env=HARD, launch={"stall_s": 7.0})
    until_training(one)
    pid = one.pids()["rollout 1"]
    one.plan(evaluation_plans(("match",), 24, "during"))
    results: list[EpisodeResult] = list(one.poll().episodes)
    os.kill(pid, signal.SIGSTOP)
    for progress in polls(one):
        results += progress.episodes
        if len(indices(results, "during")) >= 24 and progress.rollout["restarts"] >= 1:
            break
    assert indices(results, "during") == list(range(24))
    pids = one.pids()
    assert pids["rollout 1"] != pid and gone(pid)
    os.kill(pids["replay"], signal.SIGSTOP)
    with pytest.raises(WorkerError):
        drive(one)


def fail(one: RayEngine) -> None:
    ray.get(one._inference[-1].actor.fail.remote())


@pytest.mark.parametrize("hangs", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_an_inference_replica_that_is_lost_is_replaced_alone(engine, hangs: bool):
    launch = {"stall_s": 7.0 if hangs else 120.0, "max_restarts": 1}
    one = engine(env=HARD, launch=launch, inference={"workers": 1 + hangs})
    name = "inference 1" if hangs else "inference"
    until_training(one)
    pid = one.pids()[name]
    one.plan(evaluation_plans(("match",), 24, "during"))
    os.kill(pid, signal.SIGSTOP) if hangs else fail(one)
    results: list[EpisodeResult] = []
    versions: list[int] = []
    back = None
    for progress in polls(one):
        versions.append(progress.version)
        results += progress.episodes
        if back is None and progress.inference["restarts"]:
            back = progress.version
            one.plan(evaluation_plans(("match",), 8, "later"))
        if back is not None and progress.version > back and len(indices(results, "later")) == 8:
            break
    assert versions == sorted(versions)
    assert indices(results, "during") == list(range(24)) and indices(results, "later") == list(range(8))
    oldest = min(r.versions[0] for r in results if r.plan.group == "later")
    assert oldest >= versions[0], "it came back with weights of its time"
    assert progress.rollout["restarts"] == 0.0 and progress.inference["restarts"] == 1.0
    assert one.pids()[name] != pid and gone(pid)
    if not hangs:
        fail(one)
        text = until_failure(one)
        assert text.startswith("inference worker failed for good after 1 restarts:")
        assert "the forward pass fell over" in text and "serve" in text


@pytest.mark.slow
def test_a_full_disk_is_survived_and_a_trainer_that_hangs_while_it_is_saved_is_not(engine, tmp_path: Path):
    one = engine(launch={"stall_s": 5.0})
    with pytest.raises(RuntimeError, match=r"trainer worker failed in write(.|\n)*no space left"):
        one.save(tmp_path / FULL)
    until_training(one)
    with pytest.raises(WorkerError, match="trainer worker did not answer write within 20 s; if it"):
        one.save(tmp_path / HANGS)


@pytest.mark.slow
def test_a_world_that_does_not_return_is_no_reason_to_wait_for_ever(engine):
    endless, launch = LatencyConfig(max_steps=16, frame_ms=4e6), {"stall_s": 5.0, "max_restarts": 0}
    one = engine(env=endless, rollout={"environments": 1}, launch=launch)
    one.train()
    text = until_failure(one)
    assert text.startswith("rollout 0 worker failed for good:")
    assert "its environment has not returned for" in text


@pytest.mark.slow
def test_a_run_in_which_nothing_moves_ends_but_not_while_resets_are_slow(engine):
    """A reset takes 0.45 s, and so does a decision, with which an episode ends: eight resets take 3.6 s."""
    one = engine(
        env=LatencyConfig(max_steps=4, frame_ms=450.0),
        rollout={"environments": 8, "segment_length": 1},
        replay={"capacity": 16, "min_decisions": 4, "max_unlearned_decisions": 4, "samples_per_insert": 1},
        trainer={"updates": 1_000_000, "batch_decisions": 4},
        launch={"stall_s": 3.0, "max_restarts": 0},
    )
    one.plan(evaluation_plans(("match",), 8, "before"))
    assert len(collect(one, "before", 8)) == 8
    until_training(one)
    ray.get(one._trainer.actor.idle.remote())  # rollouts fill replay up, then wait
    assert "raise launch.stall_s" in until_failure(one)


@pytest.mark.slow
def test_an_inference_is_replaced_before_there_are_weights_but_must_start(engine, monkeypatch, tmp_path):
    note = tmp_path / "started"

    class StartsTwice(LightInference):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            starts = note.read_text() if note.exists() else ""
            if len(starts) == 2:
                raise MemoryError("no room for the policy")
            note.write_text(starts + "x")

    monkeypatch.setattr(inference_worker, "InferenceWorker", StartsTwice)
    one = engine()
    one.plan(evaluation_plans(("match",), 4, "before"))
    os.kill(one.pids()["inference"], signal.SIGKILL)
    assert {r.versions for r in collect(one, "before", 4)} == {(0, 0)}
    until_training(one)
    os.kill(one.pids()["inference"], signal.SIGKILL)
    text = until_failure(one)
    assert text.startswith("inference worker did not start again:") and "no room for the policy" in text
