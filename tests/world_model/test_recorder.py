# SPDX-License-Identifier: Apache-2.0
"""Rollouts on disk, and as a LeRobotDataset."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.cli import main
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import IMAGINED, Origin, Segment
from accerl_lerobot.world_model.imagination.recorder import FOLDER, Recorder, read_imagined
from tests.runs import replacing

CAMERA = "observation.images.top"


def a_rollout(number: int, length: int = 3, success: bool = False, **changes: Any) -> Segment:
    rng = np.random.default_rng(number)
    fields: dict[str, Any] = {
        "observations": {
            CAMERA: rng.integers(0, 256, (length + 1, 6, 8, 3), np.uint8),
            "observation.state": rng.standard_normal((length + 1, 4)).astype(np.float32),
        },
        "task": "open the door",
        "latent": {},
        "log_prob": np.zeros((length, 1), np.float32),
        "value": np.zeros(length, np.float32),
        "actions": rng.standard_normal((length, 5, 2)).astype(np.float32),
        "reward": np.arange(length, dtype=np.float32),
        "version": np.arange(length) + number,
        "steps": np.full(length, 5),
        "terminated": success,
        "truncated": False,
        "success": success,
        "key": f"imagination.{number}",
        "source": IMAGINED,
        "origin": Origin("door", 17, 2),
        "world_version": 40 + number,
    }
    return Segment(**fields | changes)


def recorded(folder: Path, numbers: range, most: int = 100, pace: float = 16.0) -> None:
    recorder = Recorder(folder, most, pace)
    for number in numbers:
        recorder.write(a_rollout(number, success=number % 2 == 0))


def test_what_was_recorded_is_read_again(tmp_path: Path):
    recorded(tmp_path, range(1, 4))
    found = list(read_imagined(tmp_path))
    assert [rollout.number for rollout in found] == [1, 2, 3]
    for rollout in found:
        was = a_rollout(rollout.number)
        for name, rows in was.observations.items():
            np.testing.assert_array_equal(rollout.observations[name], rows)
        np.testing.assert_array_equal(rollout.actions, was.actions)
        np.testing.assert_array_equal(rollout.rewards, was.reward)
        np.testing.assert_array_equal(rollout.versions, was.version)
        assert (rollout.task, rollout.origin, rollout.world_version) == (
            was.task,
            was.origin,
            was.world_version,
        )
        assert (rollout.success, rollout.terminated) == ((rollout.number % 2 == 0,) * 2)
        assert rollout.decisions_per_s == 16.0 and len(rollout) == 3


def test_only_the_newest_are_kept_and_what_was_after_a_checkpoint_gives_way(tmp_path: Path):
    recorded(tmp_path, range(1, 9), most=5)
    assert [rollout.number for rollout in read_imagined(tmp_path)] == [4, 5, 6, 7, 8]
    again = Recorder(tmp_path, 5, 16.0)  # the run goes on from where six had been imagined
    again.write(a_rollout(7, length=1))
    found = list(read_imagined(tmp_path))
    assert [(rollout.number, len(rollout)) for rollout in found] == [(4, 3), (5, 3), (6, 3), (7, 1)]
    fewer = Recorder(tmp_path, 2, 16.0)
    fewer.write(a_rollout(8))
    assert [rollout.number for rollout in read_imagined(tmp_path)] == [7, 8]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["00000007.safetensors", "00000008.safetensors"]


def test_broken_files_are_refused(tmp_path: Path):
    with pytest.raises(InputError, match=r"run it with --imagination\.record=1000"):
        list(read_imagined(tmp_path / FOLDER))
    recorded(tmp_path, range(1, 2))
    file = tmp_path / "00000001.safetensors"
    whole = file.read_bytes()
    file.write_bytes(whole[:-10])
    with pytest.raises(InputError, match=r"00000001\.safetensors"):
        list(read_imagined(tmp_path))
    file.write_bytes(whole.replace(b'\\"origin\\"', b'\\"0rigin\\"'))
    with pytest.raises(InputError, match=r"not an imagined rollout .*remove it"):
        list(read_imagined(tmp_path))


@pytest.fixture
def run(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    recorded(folder / FOLDER, range(1, 7))
    (folder / "config.yaml").write_text("env:\n  type: simulated\n")
    return folder


def exported(run: Path, root: Path, *options: str) -> int:
    return main(replacing(["export", "--source=imagined", f"--path={run}", f"--root={root}"], *options))


def test_a_dataset_of_rollouts_loads_in_stock_lerobot(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    assert exported(run, tmp_path / "set") == 0
    tally = json.loads(capsys.readouterr().out)
    assert (tally["episodes"], tally["frames"], tally["successes"]) == (6, 18, 3)
    assert (tally["decisions_per_s"], tally["actions_per_frame"]) == (16.0, 5)
    dataset = LeRobotDataset("accerl/rollouts", root=tmp_path / "set")
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (6, 18, 16)
    for episode, number in enumerate(range(1, 7)):
        was = a_rollout(number)
        for t in range(3):
            row = dataset[3 * episode + t]
            np.testing.assert_array_equal(row["action"].numpy(), was.actions[t].reshape(-1))
            shown = (row[CAMERA].numpy().transpose(1, 2, 0) * 255).round().astype(np.uint8)
            np.testing.assert_array_equal(shown, was.observations[CAMERA][t])
            np.testing.assert_array_equal(row["observation.state"], was.observations["observation.state"][t])
            assert int(row["policy_version"]) == number + t and int(row["world_model_version"]) == 40 + number
            assert (int(row["imagined_depth"]), bool(row["imagined"])) == (t, t > 0)
            assert (int(row["origin_seed"]), int(row["origin_decision"])) == (17, 2)
            succeeded = t == 2 and number % 2 == 0
            assert bool(row["next.success"]) is succeeded and bool(row["next.done"]) is succeeded
            assert float(row["next.reward"]) == t and row["task"] == "open the door"
            assert float(row["timestamp"]) == pytest.approx(t / 16)
    about = json.loads((tmp_path / "set" / "meta" / "accerl_rollouts.json").read_text())
    assert about["export"]["source"] == "imagined" and about["episodes"] == 6


def test_some_of_them_and_none(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert exported(run, tmp_path / "set", "--pick=successes", "--last=2") == 0
    assert json.loads(capsys.readouterr().out)["successes"] == 2
    for path in (run / FOLDER).iterdir():
        if int(path.stem) % 2:
            path.unlink()
    assert exported(run, tmp_path / "none", "--pick=failures") == 2
    assert "no imagined rollout in its imagined/ of those asked for (failures)" in capsys.readouterr().err
    assert exported(run, tmp_path / "none", "--source=both") == 2
    assert "source='both': use real or imagined" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_worlds_are_not_mixed(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    Recorder(run / FOLDER, 100, 16.0).write(a_rollout(7, actions=np.zeros((3, 4, 2), np.float32)))
    assert exported(run, tmp_path / "set") == 2
    assert "rollout 7 is of another world than 1" in capsys.readouterr().err
    assert not (tmp_path / "set").exists()
