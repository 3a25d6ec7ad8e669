# SPDX-License-Identifier: Apache-2.0
"""Faults of a run's processes: failures, hangs and kills.

Which weights decide does not matter here, so inference and trainer are stand-ins that start at once; rollout
and replay are real. The run with everything real is in ``test_launch.py``.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import psutil
import pytest
import ray

from accerl_lerobot import errors
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.engines import supervision
from accerl_lerobot.engines.config import LaunchConfig
from accerl_lerobot.engines.contract import Progress
from accerl_lerobot.engines.ray_engine import RayEngine
from accerl_lerobot.engines.stopping import WorkerError, pause_s
from accerl_lerobot.engines.supervision import Worker, end_all
from accerl_lerobot.evaluation import evaluation_plans
from accerl_lerobot.inference import worker as inference_worker
from accerl_lerobot.inference.worker import InferenceConfig
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.rollout import worker as rollout_worker
from accerl_lerobot.rollout.runner import EpisodeResult, RolloutConfig
from benchmarks.simulated_environment import LatencyConfig
from benchmarks.victims import alive
from tests.light_workers import FULL, HANGS, NO_WEIGHTS, FalteringRollout, LightInference, WarningRollout
from tests.runs import collect, drive, polls, until

SLOW = LatencyConfig(max_steps=16, frame_ms=4.0)
HARD = LatencyConfig(max_steps=16, tolerance=0.02, frame_ms=20.0)
TWO = RolloutConfig(workers=2, environments=2, segment_length=3)
ENDLESS = TrainerConfig(updates=1_000_000, batch_decisions=16)


@pytest.fixture
def engine(light_engine: Callable[..., RayEngine]) -> Callable[..., RayEngine]:
    return lambda **sections: light_engine(**{"env": SLOW, **sections})


def until_failure(engine: RayEngine) -> str:
    """Polls until the run ends with an error; its text."""
    with pytest.raises(RuntimeError) as caught:
        drive(engine)
    return str(caught.value)


def until_training(engine: RayEngine) -> None:
    engine.train()
    until(engine, 2)


def gone(pid: int) -> bool:
    """True if a process ends within a minute."""
    deadline = time.monotonic() + 60
    while (there := alive(pid)) and time.monotonic() < deadline:
        time.sleep(0.1)
    return not there


def test_a_run_ends_by_itself_and_closing_leaves_no_process(engine):
    one = engine(rollout=TWO)
    pids = one.pids()
    assert set(pids) == {"inference", "replay", "trainer", "rollout 0", "rollout 1"}
    one.plan(evaluation_plans(("match",), 5, "before"))
    assert sorted(r.plan.index for r in collect(one, "before", 5)) == list(range(5))
    one.train()
    history = drive(one)
    assert [u["update"] for p in history for u in p.updates] == [float(i) for i in range(1, 13)]
    assert history[-1].version == 12 and history[-1].replay["trained_decisions"] >= 12 * 16
    one.plan(evaluation_plans(("match",), 5, "after"))
    assert {r.versions for r in collect(one, "after", 5)} == {(12, 12)}
    os.kill(pids["trainer"], signal.SIGKILL)  # it has done its work, but has not been asked to save it
    with pytest.raises(RuntimeError, match="trainer worker failed for good:"):
        collect(one, "nothing", 1)
    one.close()
    one.close()
    assert [name for name, pid in pids.items() if not gone(pid)] == []


def test_a_warning_of_workers_is_shown_once_also_in_a_short_evaluation(engine, monkeypatch, caplog):
    monkeypatch.setattr(rollout_worker, "RolloutWorker", WarningRollout)
    errors.warn_once.cache_clear()
    one = engine(rollout=TWO)
    one.plan(evaluation_plans(("match",), 2, "eval"))
    collect(one, "eval", 2)
    one.close()
    said = [(r.name, r.getMessage()) for r in caplog.records if r.levelname == "WARNING"]
    assert said == [("accerl_lerobot.envs", "info has no is_success")]


def test_a_full_disk_is_survived_and_an_exception_in_the_trainer_ends_the_run(engine, tmp_path: Path):
    one = engine(trainer=ENDLESS)
    one.plan(evaluation_plans(("match",), 2, "a"))
    with pytest.raises(RuntimeError, match=r"trainer worker failed in write(.|\n)*no space left"):
        one.save(tmp_path / FULL)
    assert len(collect(one, "a", 2)) == 2
    one._last_change -= 1e6  # as if nobody had polled for days: no reason to say that nothing moves
    one.plan(evaluation_plans(("match",), 1, "a"))
    assert len(collect(one, "a", 1)) == 1
    until_training(one)
    ray.get(one._trainer.actor.fail.remote())
    text = until_failure(one)
    assert text.startswith("trainer worker failed for good:")
    assert "the optimiser fell over" in text and "light_workers.py" in text


@pytest.mark.slow
def test_a_worker_that_does_not_start_is_an_error_and_the_others_are_ended(engine, monkeypatch):
    closed: list[RayEngine] = []
    close = RayEngine.close
    monkeypatch.setattr(RayEngine, "close", lambda self: (closed.append(self), close(self)))
    with pytest.raises(RuntimeError, match=r"trainer worker failed in ready(.|\n)*no weights there"):
        engine(policy=PolicyConfig(path=NO_WEIGHTS))
    assert len(closed) == 1
    for worker in closed[0]._everyone():
        with pytest.raises(ray.exceptions.RayActorError):
            for _ in range(600):  # an actor is told to end and not waited for
                ray.get(worker.actor.ready.remote(), timeout=60)
                time.sleep(0.1)


def test_a_world_that_keeps_crashing_ends_the_run_with_its_own_traceback(engine):
    one = engine(
        env=LatencyConfig(crash_after=30),
        rollout=RolloutConfig(environments=2),
        launch=LaunchConfig(max_restarts=2),
    )
    one.train()
    restarts: list[float] = []
    with pytest.raises(RuntimeError, match="rollout 0 worker failed for good after 2 restarts") as caught:
        for progress in polls(one):
            restarts.append(progress.rollout["restarts"])
    assert max(restarts) == 2.0
    text = str(caught.value)
    assert "simulated crash after 30 env steps" in text and "simulated_environment.py" in text


def lose_a_rollout_worker(one: RayEngine, how: signal.Signals) -> None:
    """Two workers, so that one goes on; every planned episode has one result, whoever runs it."""
    until_training(one)
    pid = one.pids()["rollout 1"]
    one.plan(evaluation_plans(("match",), 24, "during"))
    results: list[EpisodeResult] = list(one.poll().episodes)
    os.kill(pid, how)
    left = 5  # polls after everything has come: nothing comes twice later on
    for progress in polls(one):
        results += progress.episodes
        if sum(r.plan.group == "during" for r in results) >= 24 and progress.rollout["restarts"] >= 1:
            left -= 1
        if not left:
            break
    assert sorted(r.plan.index for r in results if r.plan.group == "during") == list(range(24))
    assert progress.rollout["restarts"] == 1.0 or how is signal.SIGSTOP  # a busy machine may seem to hang
    explored = [r.plan.seed for r in results if r.plan.explore]
    assert len(set(explored)) == len(explored)
    assert one.pids()["rollout 1"] != pid and gone(pid)


def test_a_rollout_worker_that_is_killed_is_replaced_and_a_replay_that_is_killed_ends_the_run(engine):
    one = engine(env=HARD, rollout=TWO, trainer=ENDLESS)
    lose_a_rollout_worker(one, signal.SIGKILL)
    os.kill(one.pids()["replay"], signal.SIGKILL)
    assert until_failure(one).startswith("replay worker failed for good:")


@pytest.mark.slow
def test_a_rollout_worker_that_hangs_is_replaced_and_a_replay_that_hangs_ends_the_run(engine):
    one = engine(env=HARD, rollout=TWO, trainer=ENDLESS, launch=LaunchConfig(stall_s=7.0))
    lose_a_rollout_worker(one, signal.SIGSTOP)
    pid = one.pids()["replay"]
    os.kill(pid, signal.SIGSTOP)
    assert "replay worker has not answered for" in until_failure(one)
    one.close()
    assert not alive(pid), "one that was stopped does not hear that it is to go"


@pytest.mark.slow
def test_a_rollout_worker_that_fails_to_report_is_replaced(engine, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(rollout_worker, "RolloutWorker", FalteringRollout)
    one = engine(rollout=TWO, trainer=ENDLESS)
    one.plan(evaluation_plans(("match",), 12, "before"))
    assert sorted(r.plan.index for r in collect(one, "before", 12)) == list(range(12))
    one.train()
    for progress in polls(one):
        if progress.rollout["restarts"] >= 1 and progress.version >= 3:
            break
    assert progress.rollout["restarts"] == 1


def lose_inference(one: RayEngine, how: Callable[[str], object], name: str = "inference") -> list[Progress]:
    """Nothing is lost or doubled, nobody else is to blame, and no version is older than one before; what was
    reported while the service was away."""
    one.train()
    updates: list[float] = []
    results: list[EpisodeResult] = []
    history: list[Progress] = []
    away: list[Progress] = []
    died = back = None
    for progress in polls(one):
        history.append(progress)
        updates += [update["update"] for update in progress.updates]
        results += progress.episodes
        if died is None and progress.version >= 2:
            pid = one.pids()[name]
            one.plan(evaluation_plans(("match",), 24, "during"))
            how(name)
            died = progress.version
        elif died is not None and not progress.inference["restarts"]:
            away.append(progress)
        elif back is None and died is not None:
            back = progress.version
            one.plan(evaluation_plans(("match",), 8, "later"))
        elif (
            back is not None
            and progress.version > back
            and sum(r.plan.group == "later" for r in results) == 8
        ):
            break
    assert back is not None and died is not None
    assert updates == [float(i + 1) for i in range(len(updates))]
    versions = [progress.version for progress in history]
    assert versions == sorted(versions) and versions[-1] > back
    for group, count in (("during", 24), ("later", 8)):
        assert sorted(r.plan.index for r in results if r.plan.group == group) == list(range(count))
    later = [r.versions for r in results if r.plan.group == "later"]
    assert min(old for old, _ in later) >= died, "it came back with weights of its time"
    assert all(r.versions[0] <= r.versions[1] for r in results)
    explored = [r.plan.seed for r in results if r.plan.explore]
    assert len(set(explored)) == len(explored)
    assert progress.rollout["restarts"] == 0.0
    assert progress.inference["restarts"] == 1.0
    assert one.pids()[name] != pid and gone(pid)
    return away


def hit(one: RayEngine, number: signal.Signals) -> Callable[[str], None]:
    return lambda name: os.kill(one.pids()[name], number)


def test_an_inference_that_is_killed_is_replaced_alone(engine):
    launched = LaunchConfig(stall_s=120.0)
    one = engine(env=HARD, rollout=TWO, trainer=ENDLESS, launch=launched)
    lose_inference(one, hit(one, signal.SIGKILL))


@pytest.mark.slow
def test_while_one_of_two_hangs_the_other_goes_on(engine):
    one = engine(
        env=HARD, rollout=TWO, trainer=ENDLESS, launch=LaunchConfig(stall_s=7.0),
        inference=InferenceConfig(workers=2),
    )  # fmt: skip
    away = lose_inference(one, hit(one, signal.SIGSTOP), "inference 1")
    assert away[-1].rollout["decisions"] > away[0].rollout["decisions"]


@pytest.mark.slow
def test_an_exception_in_the_inference_service_is_survived_as_often_as_it_may_be_and_then_its_own(engine):
    one = engine(env=HARD, rollout=TWO, trainer=ENDLESS, launch=LaunchConfig(max_restarts=1))
    lose_inference(one, lambda name: ray.get(one._inference[0].actor.fail.remote()))
    ray.get(one._inference[0].actor.fail.remote())
    text = until_failure(one)
    assert text.startswith("inference worker failed for good after 1 restarts:")
    assert "the forward pass fell over" in text and "serve" in text


def test_a_trainer_that_hangs_while_it_is_saved_is_found_as_soon_as_any(engine, tmp_path: Path):
    one = engine(trainer=ENDLESS, launch=LaunchConfig(stall_s=5.0))
    until_training(one)
    with pytest.raises(WorkerError, match="trainer worker did not answer write within 5 s"):
        one.save(tmp_path / HANGS)


def test_the_pause_before_another_start_grows_and_has_an_end():
    assert [pause_s(restarts) for restarts in (0, 1, 2, 3, 4, 5, 1000)] == [0, 1, 2, 4, 8, 8, 8]


@pytest.mark.slow
def test_an_inference_that_does_not_start_again_ends_the_engine(engine, monkeypatch, tmp_path: Path):
    note = tmp_path / "started"

    class StartsOnce(LightInference):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            if note.exists():
                raise MemoryError("no room for the policy")
            note.touch()

    monkeypatch.setattr(inference_worker, "InferenceWorker", StartsOnce)
    one = engine(trainer=ENDLESS)
    until_training(one)
    os.kill(one.pids()["inference"], signal.SIGKILL)
    text = until_failure(one)
    assert text.startswith("inference worker did not start again:")
    assert "no room for the policy" in text


@pytest.mark.slow
def test_an_inference_is_replaced_before_there_are_weights_and_after_the_last_ones(engine):
    one = engine(rollout=TWO)
    one.plan(evaluation_plans(("match",), 4, "before"))
    os.kill(one.pids()["inference"], signal.SIGKILL)
    assert {r.versions for r in collect(one, "before", 4)} == {(0, 0)}
    one.train()
    assert drive(one)[-1].version == 12
    os.kill(one.pids()["inference"], signal.SIGKILL)
    one.plan(evaluation_plans(("match",), 4, "after"))
    assert {r.versions for r in collect(one, "after", 4)} == {(12, 12)}
    assert one.poll().inference["restarts"] == 2.0


@pytest.mark.slow
def test_a_world_that_does_not_return_is_no_reason_to_wait_for_ever(engine):
    endless = LatencyConfig(max_steps=16, frame_ms=4e6)
    one = engine(
        env=endless, rollout=RolloutConfig(environments=1), launch=LaunchConfig(stall_s=5.0, max_restarts=0)
    )
    one.train()
    text = until_failure(one)
    assert (
        text.startswith("rollout 0 worker failed for good:")
        and "its environment has not returned for" in text
    )


@pytest.mark.slow
def test_eight_slow_resets_one_after_another_are_progress(engine):
    slow = LatencyConfig(max_steps=4, frame_ms=600.0)
    one = engine(
        env=slow, rollout=RolloutConfig(environments=8), launch=LaunchConfig(stall_s=3.0, max_restarts=0)
    )
    one.plan(evaluation_plans(("match",), 8, "before"))
    assert len(collect(one, "before", 8)) == 8


@pytest.mark.slow
def test_a_run_in_which_nothing_moves_ends(engine):
    one = engine(launch=LaunchConfig(stall_s=5.0), trainer=ENDLESS)
    until_training(one)
    ray.get(one._trainer.actor.idle.remote())  # rollouts fill replay up, then wait at the door
    text = until_failure(one)
    assert text.startswith("nothing moved for 5 s") and "raise launch.stall_s" in text


class Stand:
    """Stands in for `ray`: there are no warnings, and nobody is killed."""

    def wait(self, references: list[Any], **_: Any) -> tuple[list[Any], list[Any]]:
        return [], references

    def kill(self, actor: Any) -> None:
        pass


@pytest.mark.parametrize("here", [True, False])
def test_only_a_process_of_this_node_is_ended_by_its_number(here: bool, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(supervision, "ray", Stand())
    monkeypatch.setattr(supervision, "GONE_S", 0.2)
    with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"]) as process:
        actor = type("Actor", (), {"__ray_call__": MagicMock()})()
        worker = Worker("somebody", actor, here)
        worker.started(process.pid)
        assert (worker.process == psutil.Process(process.pid)) is here
        end_all([worker])
        assert (process.poll() is not None) is here
        process.kill()
