# SPDX-License-Identifier: Apache-2.0
"""A run's episodes as a LeRobotDataset, replayed from its journal."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from accerl_lerobot.cli import main
from accerl_lerobot.demos.dataset_files import open_metadata
from accerl_lerobot.engines.config import DatasetConfig, LaunchConfig, RunConfig, encode, parse
from accerl_lerobot.envs import SimulatedConfig, make_environment
from accerl_lerobot.evaluation import EvaluationConfig
from accerl_lerobot.policies.features import check_features, dataset_features, env_features
from accerl_lerobot.replay.journal import read_journal, whole_episodes
from tests.runs import tiny_run
from tests.tiny_datasets import one_process


@pytest.fixture(scope="module")
def run(tiny_checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export")
    config = tiny_run(
        tiny_checkpoint,
        env=SimulatedConfig(max_steps=10, tolerance=0.45),
        evaluation=EvaluationConfig(episodes=2, before=False, videos=0),
        launch=LaunchConfig(engine="local"),
    )
    (folder / "recipe.yaml").write_text(yaml.safe_dump(encode(config)))
    assert main(["train", str(folder / "recipe.yaml"), f"--output_dir={folder / 'run'}"]) == 0
    return folder / "run"


def exported(run: Path, root: Path, *options: str) -> int:
    with one_process():
        return main(["export", f"--path={run}", f"--root={root}", *options])


def test_every_whole_episode_is_in_the_dataset_step_by_step(run, tmp_path, capsys):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    capsys.readouterr()
    assert main(["export", f"--path={run}", f"--root={tmp_path / 'set'}"]) == 0  # in processes of its own
    found = json.loads(capsys.readouterr().out)
    episodes = list(whole_episodes(read_journal(run / "episodes.jsonl")))
    assert found["episodes"] == len(episodes) > 8 and found["left_out"] == 0
    assert found["successes"] == sum(e[-1].success for e in episodes)
    assert 0 < found["successes"] < len(episodes), "there is something to tell apart"
    dataset = LeRobotDataset("accerl/rollouts", root=tmp_path / "set")
    assert dataset.num_episodes == len(episodes) and dataset.num_frames == found["frames"]
    for index, parts in enumerate(episodes[:6]):
        actions = np.concatenate([part.actions for part in parts])
        start = dataset.meta.episodes[index]["dataset_from_index"]
        rows = [dataset[start + i] for i in range(len(actions))]
        np.testing.assert_array_equal([row["action"].numpy() for row in rows], actions)
        versions = [v for p in parts for v, n in zip(p.versions, p.steps, strict=True) for _ in range(n)]
        assert [int(row["policy_version"]) for row in rows] == versions
        assert [bool(row["next.done"]) for row in rows] == [False] * (len(rows) - 1) + [True]
        assert bool(rows[-1]["next.success"]) is parts[-1].success
    about = json.loads((tmp_path / "set" / "meta" / "accerl_rollouts.json").read_text())
    assert about["episodes"] == len(episodes) and about["export"]["path"] == run.name
    settings: RunConfig = parse(RunConfig, [f"--config_path={run / 'config.yaml'}"])
    written = dataset_features(
        open_metadata(DatasetConfig(repo_id="accerl/rollouts", root=str(tmp_path / "set")))
    )
    check_features(written, env_features(make_environment(settings.env).spec), {}, "dataset.repo_id", "")


def test_a_run_with_types_of_other_packages(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    other = tmp_path / "run"
    other.mkdir()
    (other / "episodes.jsonl").write_bytes((run / "episodes.jsonl").read_bytes())
    config = yaml.safe_load((run / "config.yaml").read_text())
    config |= {"algorithm": {"type": "theirs", "discover_packages_path": "a_package"}}
    config["env"]["discover_packages_path"] = "accerl_lerobot.envs"
    config["rollout"]["reward_model"]["trust_remote_code"] = "0" * 40  # not needed to repeat episodes
    (other / "config.yaml").write_text(yaml.safe_dump(config))
    capsys.readouterr()
    assert exported(other, tmp_path / "set") == 2
    assert "if you trust it, add --env.discover_packages_path=accerl_lerobot.envs" in capsys.readouterr().err
    assert exported(other, tmp_path / "set", "--env.discover_packages_path=accerl_lerobot.envs") == 0
    config["rollout"]["reward_model"]["path"] = "outputs/classifier"
    (other / "config.yaml").write_text(yaml.safe_dump(config))
    assert exported(other, tmp_path / "judged", "--env.discover_packages_path=accerl_lerobot.envs") == 2
    assert "rollout.reward_model told its successes" in capsys.readouterr().err


def test_episodes_that_cannot_be_repeated_are_left_out(run, tmp_path, capsys):
    other = tmp_path / "run"
    other.mkdir()
    (other / "config.yaml").write_bytes((run / "config.yaml").read_bytes())
    lines = (run / "episodes.jsonl").read_text().splitlines()
    changed = json.loads(lines[0])
    changed["rewards"][0] += 0.5
    (other / "episodes.jsonl").write_text("\n".join([json.dumps(changed), *lines[1:]]) + "\n")
    capsys.readouterr()
    assert exported(other, tmp_path / "set") == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["left_out"] == 1 and "differed from the run and are left out" in err
    (other / "episodes.jsonl").write_text(json.dumps(changed | {"ended": True}) + "\n")
    assert exported(other, tmp_path / "second") == 2
    assert "none of its episodes could be repeated" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run", "set"], "nothing half made is left"


def test_bad_input(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    other = tmp_path / "world_model_run"
    other.mkdir()
    (other / "config.yaml").write_text("device: auto\n")
    new = f"--root={tmp_path / 'new'}"
    for options, message in (
        ([f"--path={run}", f"--root={tmp_path}"], "the folder exists; choose another or remove it"),
        ([f"--path={tmp_path}", new], "no accerl train run in it: there is no config.yaml"),
        ([f"--path={other}", new], "no accerl train run in it: there is no episodes.jsonl"),
        ([], "path=None: name the folder"),
    ):
        assert main(["export", *options]) == 2
        assert message in capsys.readouterr().err
