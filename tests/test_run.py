# SPDX-License-Identifier: Apache-2.0
"""A run from its command to its summary, in one process."""

import json
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.checkpoint.layout import saved_version
from accerl_lerobot.console import Console
from accerl_lerobot.engines import Engine, Progress
from accerl_lerobot.engines.config import LaunchConfig, RunConfig
from accerl_lerobot.engines.stopping import WorkerError
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import warn_once
from accerl_lerobot.evaluation import EvaluationConfig
from accerl_lerobot.rollout.runner import EpisodePlan
from accerl_lerobot.run import train as run
from tests.rollout.environments import ended
from tests.runs import records, tiny_run


class Finished(NamedTuple):
    directory: Path
    summary: dict[str, Any]


def local_run(checkpoint: Path, output_dir: Path, **sections: Any) -> RunConfig:
    defaults: dict[str, Any] = {
        "env": SimulatedConfig(max_steps=12, tolerance=0.4),
        "evaluation": EvaluationConfig(episodes=8, every_updates=4, episodes_during=4, videos=1),
        "trainer": TrainerConfig(updates=12, batch_decisions=16, warmup_updates=2, value_warmup_updates=2),
        "launch": LaunchConfig(engine="local"),
        "output_dir": str(output_dir),
        "save_every_updates": 5,
    }
    return tiny_run(checkpoint, **{**defaults, **sections})


def executed(config: RunConfig) -> Finished:
    """A run that has been done."""
    directory = Path(config.output_dir or "")
    directory.mkdir(exist_ok=True)
    return Finished(directory, run.Run(config, directory, Console()).execute())


@pytest.fixture(scope="module")
def finished(tiny_checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    return executed(local_run(tiny_checkpoint, tmp_path_factory.mktemp("outputs") / "run"))


def test_the_summary_has_what_is_promised(finished: Finished):
    summary = json.loads((finished.directory / "summary.json").read_text())
    assert summary == finished.summary
    assert {path.name for path in finished.directory.iterdir()} == {
        "config.yaml", "metrics.jsonl", "tensorboard", "checkpoints", "success_curve.png", "summary.json",
        "before_after.mp4", "episodes.jsonl", "timeline",
    }  # fmt: skip
    for when in ("before", "after"):
        assert 0.0 <= summary[f"success_{when}"] <= 1.0 and summary[f"n_{when}"] == 8
        low, high = summary[f"ci95_{when}"]
        assert 0.0 <= low <= summary[f"success_{when}"] <= high <= 1.0 and low < high
    assert summary["env_steps"] >= summary["decisions"] > 0 and summary["updates"] == 12
    assert summary["trained_decisions"] >= 12 * 16
    assert 0 <= summary["lag_mean"] <= summary["lag_max"]
    assert summary["wall_s"] >= summary["rl_s"] > 0 and summary["restarts"] == 0


def test_the_evaluation_before_can_be_left_out_and_a_run_without_success_says_so(
    tiny_checkpoint: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    warn_once.cache_clear()
    config = local_run(
        tiny_checkpoint,
        tmp_path / "run",
        env=SimulatedConfig(max_steps=12, tolerance=1e-6, task="match,mirror"),
        evaluation=EvaluationConfig(episodes=4, before=False, videos=0),
    )
    directory, summary = executed(config)
    assert [r["group"] for r in records(directory, "evaluation")] == ["after"]
    assert summary["success_before"] is summary["ci95_before"] is None and summary["n_after"] == 4
    (told,) = [m for m in caplog.messages if "exploring episodes has succeeded" in m]
    assert "see env.success" in told
    assert (directory / "success_curve.png").is_file() and not (directory / "before_after.mp4").exists()


def test_a_run_without_updates_measures_its_start(
    tiny_checkpoint: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    config = local_run(tiny_checkpoint, tmp_path / "run", trainer=TrainerConfig(updates=0))
    _, summary = executed(config)
    assert summary["updates"] == summary["episodes_explored"] == 0
    assert summary["success_before"] == summary["success_after"]
    assert "exploring episodes has succeeded" not in caplog.text


def test_every_update_is_logged_once_and_episodes_are_averaged_as_they_end(finished: Finished):
    train = records(finished.directory, "train")
    assert [r["update"] for r in train] == list(range(1, 13))
    assert {"loss", "approx_kl", "lag_mean", "lr", "ratio_max_dev", "skipped"} <= train[0].keys()
    assert max(r["lag_max"] for r in train) == finished.summary["lag_max"]
    ended = [r for r in records(finished.directory, "rollout") if "episode_return" in r]
    assert ended and all(0 < r["episode_decisions"] <= r["episode_steps"] <= 12 for r in ended)


def test_evaluations_are_logged_in_order_with_the_weights_they_used(finished: Finished):
    found = records(finished.directory, "evaluation")
    # Three were planned while training, after 4 and 8 updates; the one after 12 is the one after training.
    assert [r["group"] for r in found] == ["before", "during-1", "during-2", "after"]
    assert [r["n"] for r in found] == [8, 4, 4, 8]
    assert (found[0]["version_min"], found[0]["version_max"]) == (0, 0)
    assert (found[-1]["version_min"], found[-1]["version_max"]) == (12, 12)
    assert all(0 < r["version_min"] <= r["version_max"] <= 12 for r in found[1:3])
    steps = [r["env_steps"] for r in found]
    assert steps == sorted(steps) and steps[-1] == finished.summary["env_steps"]


class Scripted(Engine):
    """Answers every evaluation at once, except what is planned while training: that ends after it."""

    def __init__(self, config: RunConfig) -> None:
        self.config = config
        self.planned: list[EpisodePlan] = []
        self.late: list[EpisodePlan] = []
        self.version = 0
        self.steps = 0.0
        self.training = self.closed = False
        self.failure: Exception | None = None

    def plan(self, plans: list[EpisodePlan]) -> None:
        (self.late if self.training else self.planned).extend(plans)

    def train(self) -> None:
        self.training = True

    def poll(self) -> Progress:
        if self.failure is not None:
            raise self.failure
        updates = []
        if self.training:
            self.version += 1
            self.steps += 10
            updates = [{"update": float(self.version), "lag_mean": 0.0, "lag_max": 0.0, "ratio_max_dev": 0.0}]
            self.training = self.version < self.config.trainer.updates
        elif self.version and self.planned:
            self.planned, self.late = self.late + self.planned, []
            self.steps += 1000
        ready, self.planned = self.planned, []
        return Progress(
            version=self.version,
            done=self.version == self.config.trainer.updates,
            updates=updates,
            episodes=[ended(plan) for plan in ready],
            rollout={"env_steps": self.steps, "decisions": 1.0},
        )

    def save(self, directory: Path) -> Progress:
        return Progress(version=self.version)

    def close(self) -> None:
        self.closed = True


def scripted(monkeypatch: pytest.MonkeyPatch, config: RunConfig) -> Scripted:
    engine = Scripted(config)
    monkeypatch.setattr(run, "make_engine", lambda *_: engine)
    monkeypatch.setattr(run, "check_policy", lambda config, spec, **_: 1)
    return engine


@pytest.mark.parametrize(("seconds", "versions"), [(1e-9, {0, 1, 2, 3}), (1e9, {0, 3})])
def test_checkpoints_by_time(seconds: float, versions: set[int], tiny_checkpoint, tmp_path, monkeypatch):
    trainer = TrainerConfig(updates=3, batch_decisions=16)
    config = local_run(tiny_checkpoint, tmp_path, trainer=trainer, save_every_updates=0, save_every_s=seconds)
    scripted(monkeypatch, config)
    executed(config)
    found = (tmp_path / "checkpoints").iterdir()
    assert {int(path.name) for path in found if not path.is_symlink()} == versions


def test_an_evaluation_that_ends_after_training_is_not_lost(
    tiny_checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    config = local_run(tiny_checkpoint, tmp_path, save_every_updates=0)
    engine = scripted(monkeypatch, config)
    _, summary = executed(config)
    found = records(tmp_path, "evaluation")
    assert [r["group"] for r in found] == ["before", "during-1", "during-2", "after"]
    assert [r["n"] for r in found] == [8, 4, 4, 8]
    # What is stepped to evaluate after training is no experience that was learned from.
    assert summary["env_steps"] == found[-1]["env_steps"] == found[-2]["env_steps"] == 12 * 10
    assert engine.closed and (tmp_path / "checkpoints" / "last").is_symlink()


def losing(monkeypatch: pytest.MonkeyPatch, config: RunConfig, lost_at: list[int]) -> list[Scripted]:
    """Engines that lose a worker after so many updates, one after the other."""
    made: list[Scripted] = []

    def make(config: RunConfig, tasks: Any, history: int, state: Path | None, *_: Any) -> Scripted:
        engine = Scripted(config)
        engine.version = 0 if state is None else saved_version(state)
        engine.training = False
        at, poll = lost_at[len(made)] if len(made) < len(lost_at) else -1, engine.poll

        def watched() -> Progress:
            if engine.version == at:
                raise WorkerError("replay worker failed for good:\nKilled")
            return poll()

        monkeypatch.setattr(engine, "poll", watched)
        made.append(engine)
        return engine

    monkeypatch.setattr(run, "make_engine", make)
    monkeypatch.setattr(run, "check_policy", lambda config, spec, **_: 1)
    return made


@pytest.mark.parametrize(
    ("lost_at", "most", "every", "times"),
    [
        ([7, 11, 11], 3, 5, [1, 1, 2]),  # the checkpoints after updates 5 and 10; 10 is gone on from twice
        ([6, 7, 8, 9], 1, 5, [1, 1, 1, 1]),  # a run that gets further each time is not stuck
        ([7, 7, 7], 2, 5, None),  # a worker that is lost again and again ends the run
        ([7], 2, 0, None),  # without a checkpoint there is nothing to go on from
    ],
)
def test_after_the_loss_of_a_worker_the_run_goes_on_from_its_last_checkpoint(
    lost_at: list[int], most: int, every: int, times: list[int] | None, tiny_checkpoint: Path,
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
):  # fmt: skip
    launch = LaunchConfig(engine="local", max_restarts=most)
    saves: dict[str, Any] = {"save_every_updates": every, "save_every_s": 0.0}
    config = local_run(tiny_checkpoint, tmp_path, launch=launch, **saves)
    made = losing(monkeypatch, config, lost_at)
    if times is None:
        with pytest.raises(WorkerError, match="Killed"):
            executed(config)
        assert len(made) == len(lost_at) and all(engine.closed for engine in made)
        return
    _, summary = executed(config)
    assert len(made) == len(lost_at) + 1 and all(engine.closed for engine in made)
    assert [r["update"] for r in records(tmp_path, "train")] == list(range(1, 13)), "none twice"
    said = capsys.readouterr().err
    assert said.count("replay worker failed for good:\nKilled\ngoing on from") == len(lost_at)
    assert all(
        f"({n} of {most} times)" in line for n, line in zip(times, said.split("Killed")[1:], strict=True)
    )
    assert summary["updates"] == 12 and 0 < summary["wall_s"] < 60


@pytest.mark.parametrize("error", [RuntimeError("inference worker failed for good"), KeyboardInterrupt()])
def test_a_run_that_fails_closes_the_engine_and_keeps_its_own_error(
    error: BaseException, tiny_checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    config = local_run(tiny_checkpoint, tmp_path)
    engine = scripted(monkeypatch, config)
    monkeypatch.setattr(engine, "train", lambda: (_ for _ in ()).throw(error))
    with pytest.raises(type(error)) as caught:
        executed(config)
    assert caught.value is error and engine.closed
    assert len(records(tmp_path, "evaluation")) == 1, "what was measured before is kept"
    assert not (tmp_path / "summary.json").exists()
