# SPDX-License-Identifier: Apache-2.0
"""Recording is deterministic, complete and readable by LeRobot; a run's episodes are replayed, exported."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from accerl_lerobot.cli import main
from accerl_lerobot.demos.dataset_files import open_metadata
from accerl_lerobot.demos.record import (
    DemosConfig,
    Episode,
    check_instruction,
    disturbed,
    make_expert,
    played,
    record_demos,
)
from accerl_lerobot.engines.config import DatasetConfig, LaunchConfig, RunConfig, encode, parse
from accerl_lerobot.envs import MetaWorldConfig, SimulatedConfig, make_environment
from accerl_lerobot.envs.gym_env import GymConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.evaluation import EvaluationConfig
from accerl_lerobot.policies.features import check_features, dataset_features, env_features
from accerl_lerobot.replay.journal import read_journal, whole_episodes
from tests.rounding import assert_close
from tests.runs import tiny_run
from tests.tiny_datasets import one_process, record_dataset

TINY = Path(__file__).parents[2] / "datasets" / "metaworld_tiny"
TASKS = "handle-press-v3,reach-v3"


def rows(root: Path) -> list[dict]:
    dataset = LeRobotDataset("accerl/demos", root=root, video_backend="pyav")
    return [{key: np.asarray(value) for key, value in dataset[i].items()} for i in range(len(dataset))]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("metaworld")
    root = tmp_path_factory.mktemp("demos") / "two"
    config = DemosConfig(episodes=2)
    assert record_demos(MetaWorldConfig(task=TASKS, max_steps=100), config, str(root)) == root
    return root


def test_lerobot_reads_it_and_the_expert_succeeds_at_the_last_frame_of_each_episode(recorded: Path):
    data = rows(recorded)
    frame = data[0]
    assert frame["observation.images.corner2"].shape == (3, 64, 64)
    assert frame["observation.state"].shape == frame["action"].shape == (4,)
    texts = {row["episode_index"].item(): str(row["task"]) for row in data}
    assert texts == {0: "Press a handle down", 1: "Reach a goal position"}
    info = json.loads((recorded / "meta" / "info.json").read_text())
    features = info["features"]
    assert info["fps"] == 80 and features["observation.images.corner2"]["dtype"] == "image"
    assert (features["next.success"]["dtype"], features["next.success"]["shape"]) == ("bool", [1])
    last = [i for i, row in enumerate(data) if i + 1 == len(data) or data[i + 1]["frame_index"] == 0]
    assert len(last) == 2
    for name in ("next.reward", "next.done", "next.success"):
        assert [i for i, row in enumerate(data) if row[name]] == last, name


def test_the_content_does_not_depend_on_the_processes(recorded: Path, tmp_path: Path):
    record_dataset(tmp_path / "one", MetaWorldConfig(task=TASKS, max_steps=100), episodes=2)
    one, two = rows(tmp_path / "one"), rows(recorded)
    assert len(one) == len(two)
    assert all(np.array_equal(a[key], b[key]) for a, b in zip(one, two, strict=True) for key in a)


def test_failures_are_recorded_on_request_spread_over_tasks(tmp_path: Path):
    env = SimulatedConfig(task="match,mirror", max_steps=60, hold=25)
    record_dataset(tmp_path / "mixed", env, episodes=8, failure_share=0.5, seed=3)
    ends = [row for row in rows(tmp_path / "mixed") if row["next.done"]]
    for task in ("Match the target", "Mirror the target"):
        outcomes = [bool(row["next.success"]) for row in ends if str(row["task"]) == task]
        assert sorted(outcomes) == [False, False, True, True]


def match(seed: int = 5, noise: float = 0.0, push: float = 0.0) -> Episode:
    config = SimulatedConfig(tolerance=0.01, max_steps=20)
    environment = make_environment(config)
    expert = make_expert(config, environment, "match")
    actions = disturbed(expert, environment.spec, seed, noise=noise, push=push, fail=False)
    return played(environment, "match", seed, actions)


def test_noise_is_in_the_recorded_action_and_seeded():
    one, again, clean = match(noise=0.1), match(noise=0.1), match()
    assert np.array_equal(one.actions, again.actions) and one.actions.dtype == np.float32
    assert clean.successes.tolist() == [False] * 3 + [True] and np.ptp(clean.actions, axis=0).max() == 0
    assert 0.05 < (one.actions - clean.actions[0]).std() < 0.2
    assert np.abs(one.actions).max() <= 1


def test_an_expert_that_is_pushed_misses_by_more_the_more_it_is_pushed():
    clean, *pushed = (match(push=push) for push in (0.0, 0.1, 0.2))
    aside = [episode.actions[0] - clean.actions[0] for episode in pushed]
    assert all(np.ptp(episode.actions, axis=0).max() == 0 for episode in pushed), "the same all the way"
    assert 0 < np.linalg.norm(aside[0]) <= 0.1
    assert_close(aside[1], 2 * aside[0])
    other = match(seed=6, push=0.2)
    assert not np.allclose(other.actions[0] - clean.actions[0], aside[1], atol=1e-3)


def test_an_expert_that_cannot_succeed_is_reported_and_leaves_nothing(tmp_path: Path):
    config = DemosConfig(episodes=1, action_noise=1.0)
    with pytest.raises(InputError, match="demos.action_noise=1.0: .*match"):
        record_demos(SimulatedConfig(tolerance=1e-6, max_steps=8), config, str(tmp_path / "none"))
    assert list(tmp_path.iterdir()) == []


def test_replaying_its_actions_gives_its_frames():
    pytest.importorskip("metaworld")
    dataset = LeRobotDataset("accerl/metaworld_tiny", root=TINY, video_backend="pyav")
    assert (dataset.num_episodes, dataset.num_frames, dataset.fps) == (4, 365, 80)
    environment = make_environment(MetaWorldConfig(task="drawer-open-v3"))
    observation, reward = environment.reset(0, "drawer-open-v3"), 0.0
    for index in range(dataset.meta.episodes[0]["length"]):
        row = dataset[index]
        # Bit-equal on the machine that recorded it; another processor or OpenGL may round differently.
        assert np.allclose(row["observation.state"].numpy(), observation["observation.state"], atol=1e-3)
        if index % 10 == 0:
            stored = (row["observation.images.corner2"] * 255).round().byte().permute(1, 2, 0).numpy()
            assert np.abs(stored - observation["observation.images.corner2"].astype(int)).mean() < 2
        result = environment.step_chunk(row["action"].numpy()[None])
        observation, reward = result.observation, float(row["next.reward"])
        assert result.rewards[0] == reward
    assert result.terminated and reward == 1.0
    environment.close()


def test_an_instruction_is_asked_for_where_the_environment_has_none():
    """`export` calls it as well, before an episode is repeated."""
    spec = replace(make_environment(SimulatedConfig()).spec, instructions=())
    with pytest.raises(InputError, match="^env.task='': each frame of a dataset has an .*--env.task="):
        check_instruction(spec, GymConfig(id="reach/Reach-v0"))


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
    settings: RunConfig = parse(RunConfig, [f"--config_path={run / 'config.yaml'}"])
    exported_set = DatasetConfig(repo_id="accerl/rollouts", root=str(tmp_path / "set"))
    written = dataset_features(open_metadata(exported_set))
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
