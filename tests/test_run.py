# SPDX-License-Identifier: Apache-2.0
"""A run from its command to its summary, in one process."""

import json
import re
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from accerl_lerobot.console import Console
from accerl_lerobot.engines import Progress
from accerl_lerobot.engines.config import RunConfig
from accerl_lerobot.engines.local import LocalEngine
from accerl_lerobot.engines.stopping import WorkerError
from accerl_lerobot.errors import warn_once
from accerl_lerobot.run import train as run
from tests.runs import changed, records, tiny_run


def local_run(checkpoint: Path, output_dir: Path, **sections: Any) -> RunConfig:
    config = tiny_run(
        checkpoint,
        env={"max_steps": 12, "tolerance": 0.4},
        evaluation={"episodes": 8, "every_updates": 4, "episodes_during": 4},
        launch={"engine": "local"},
        output_dir=str(output_dir),
        save_every_updates=5,
    )
    return changed(config, **sections)


def executed(config: RunConfig) -> tuple[Path, dict[str, Any]]:
    """A run that has been done: its folder and its summary."""
    directory = Path(config.output_dir or "")
    directory.mkdir(exist_ok=True)
    return directory, run.Run(config, directory, Console()).execute()


@pytest.fixture(scope="module")
def finished(tiny_checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    return executed(local_run(tiny_checkpoint, tmp_path_factory.mktemp("outputs") / "run"))


def test_the_summary_has_what_is_promised(finished):
    directory, summary = finished
    assert summary == json.loads((directory / "summary.json").read_text())
    assert {path.name for path in directory.iterdir()} == {
        "config.yaml", "metrics.jsonl", "tensorboard", "checkpoints", "success_curve.png", "summary.json",
        "before_after.mp4", "episodes.jsonl", "timeline",
    }  # fmt: skip
    for when in ("before", "after"):
        low, high = summary[f"ci95_{when}"]
        assert 0.0 <= low <= summary[f"success_{when}"] <= high <= 1.0 and low < high
        assert summary[f"n_{when}"] == 8
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
        env={"tolerance": 1e-6, "task": "match,mirror"},
        evaluation={"episodes": 4, "before": False, "every_updates": 0, "videos": 0},
    )
    directory, summary = executed(config)
    assert [r["group"] for r in records(directory, "evaluation")] == ["after"]
    assert summary["success_before"] is summary["ci95_before"] is None and summary["n_after"] == 4
    (told,) = [m for m in caplog.messages if "exploring episodes has succeeded" in m]
    assert "see env.success" in told
    assert (directory / "success_curve.png").is_file() and not (directory / "before_after.mp4").exists()


def test_a_run_without_updates_measures_its_start(tiny_checkpoint: Path, tmp_path: Path, caplog):
    _, summary = executed(local_run(tiny_checkpoint, tmp_path / "run", trainer={"updates": 0}))
    assert summary["updates"] == summary["episodes_explored"] == 0
    assert summary["success_before"] == summary["success_after"]
    assert "exploring episodes has succeeded" not in caplog.text


def test_every_update_is_logged_once_and_episodes_are_averaged_as_they_end(
    finished: tuple[Path, dict[str, Any]],
):
    directory, summary = finished
    train = records(directory, "train")
    assert [r["update"] for r in train] == list(range(1, 13))
    assert max(r["lag_max"] for r in train) == summary["lag_max"]
    ended = [r for r in records(directory, "rollout") if "episode_return" in r]
    assert ended and all(0 < r["episode_decisions"] <= r["episode_steps"] <= 12 for r in ended)


def test_evaluations_are_logged_in_order_with_the_weights_they_used(finished):
    found = records(finished[0], "evaluation")
    # Three were planned while training, after 4 and 8 updates; the one after 12 is the one after training.
    assert [r["group"] for r in found] == ["before", "during-1", "during-2", "after"]
    assert [r["n"] for r in found] == [8, 4, 4, 8]
    assert (found[0]["version_min"], found[0]["version_max"]) == (0, 0)
    assert (found[-1]["version_min"], found[-1]["version_max"]) == (12, 12)
    assert all(0 < r["version_min"] <= r["version_max"] <= 12 for r in found[1:3])
    steps = [r["env_steps"] for r in found]
    assert steps == sorted(steps) and steps[-1] == finished[1]["env_steps"]


@pytest.mark.parametrize(("seconds", "versions"), [(1e-9, ["000002"]), (1e9, ["000000"])])
def test_checkpoints_by_time(seconds: float, versions: list[str], tiny_checkpoint, tmp_path):
    saves = {"save_every_updates": 0, "save_every_s": seconds}
    executed(local_run(tiny_checkpoint, tmp_path, trainer={"updates": 3}, **saves))
    found = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    assert found == [*versions, "000003", "last"]


def test_an_evaluation_that_ends_after_training_is_not_lost(tiny_checkpoint: Path, tmp_path: Path):
    """And what is stepped for it after training is no experience that was learned from."""
    env = {"max_steps": 200, "tolerance": 1e-6}
    directory, summary = executed(local_run(tiny_checkpoint, tmp_path, env=env, trainer={"updates": 9}))
    found = records(directory, "evaluation")
    assert [r["group"] for r in found] == ["before", "during-1", "during-2", "after"]
    assert [r["n"] for r in found] == [8, 4, 4, 8] and found[-2]["version_max"] == 9
    assert summary["env_steps"] == found[-1]["env_steps"] == found[-2]["env_steps"]


def losing(lost_at: list[int]) -> Any:
    """Workers are lost when so many updates have been made, one after the other."""
    left, poll = list(lost_at), LocalEngine.poll

    def watched(engine: LocalEngine) -> Progress:
        progress = poll(engine)
        if left and progress.version == left[0]:
            del left[0]
            raise WorkerError("replay worker failed for good:\nKilled")
        return progress

    return patch.object(LocalEngine, "poll", watched)


def closings() -> Any:
    return patch.object(LocalEngine, "close", autospec=True, side_effect=LocalEngine.close)


@pytest.mark.parametrize(
    ("lost_at", "most", "every", "times"),
    [
        ([7, 11, 11], 3, 5, ["1", "1", "2"]),  # from the checkpoint of update 5 once, from that of 10 twice
        ([6, 7, 8, 9], 1, 5, ["1"] * 4),  # a run that gets further each time is not stuck
        ([7, 7, 7], 2, 5, None),  # a worker that is lost again and again ends the run
        ([7], 2, 0, None),  # without a checkpoint there is nothing to go on from
    ],
)
def test_after_the_loss_of_a_worker_the_run_goes_on_from_its_last_checkpoint(
    lost_at: list[int], most: int, every: int, times: list[str] | None, tiny_checkpoint, tmp_path, capsys
):
    saves: dict[str, Any] = {"save_every_updates": every, "save_every_s": 0.0}
    evaluation = {"episodes": 2, "every_updates": 0, "videos": 0}
    launch = {"max_restarts": most}
    config = local_run(tiny_checkpoint, tmp_path, launch=launch, evaluation=evaluation, **saves)
    with losing(lost_at), closings() as closed:
        if times is None:
            with pytest.raises(WorkerError, match="Killed"):
                executed(config)
            assert closed.call_count == len(lost_at)
            return
        _, summary = executed(config)
    assert closed.call_count == len(lost_at) + 1
    assert [r["update"] for r in records(tmp_path, "train")] == list(range(1, 13)), "none twice"
    said = capsys.readouterr().err
    assert said.count("replay worker failed for good:\nKilled\ngoing on from") == len(lost_at)
    assert re.findall(r"\((\d) of \d times\)", said) == times
    assert summary["updates"] == 12


@pytest.mark.parametrize("error", [RuntimeError("inference worker failed for good"), KeyboardInterrupt()])
def test_a_run_that_fails_closes_the_engine_and_keeps_its_error(error, tiny_checkpoint, tmp_path):
    fails = patch.object(LocalEngine, "train", side_effect=error)
    with fails, closings() as closed, pytest.raises(type(error)) as caught:
        executed(local_run(tiny_checkpoint, tmp_path))
    assert caught.value is error and closed.call_count == 1
    assert len(records(tmp_path, "evaluation")) == 1, "what was measured before is kept"
    assert not (tmp_path / "summary.json").exists()
