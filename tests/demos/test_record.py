# SPDX-License-Identifier: Apache-2.0
"""Recording is deterministic, complete and readable by LeRobot; a run's episodes are replayed, exported."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from accerl_lerobot.cli import main
from accerl_lerobot.demos import record
from accerl_lerobot.demos.record import DemosConfig, Episode, disturbed, make_expert, played, record_demos
from accerl_lerobot.engines.config import LaunchConfig, encode
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
    return record_demos(MetaWorldConfig(task=TASKS, max_steps=100), DemosConfig(episodes=2), str(root))


def test_lerobot_reads_it_and_the_expert_succeeds_at_the_last_frame_of_each_episode(recorded: Path):
    data = rows(recorded)
    assert data[0]["observation.images.corner2"].shape == (3, 64, 64)
    assert data[0]["observation.state"].shape == data[0]["action"].shape == (4,)
    texts = {row["episode_index"].item(): str(row["task"]) for row in data}
    assert texts == {0: "Press a handle down", 1: "Reach a goal position"}
    info = json.loads((recorded / "meta" / "info.json").read_text())
    dtypes = {name: feature["dtype"] for name, feature in info["features"].items()}
    assert info["fps"] == 80 and dtypes["observation.images.corner2"] == "image"
    assert dtypes["next.success"] == "bool"
    last = [i for i, row in enumerate(data) if i + 1 == len(data) or data[i + 1]["frame_index"] == 0]
    assert len(last) == 2
    for name in ("next.reward", "next.done", "next.success"):
        assert [i for i, row in enumerate(data) if row[name]] == last, name


def test_the_content_does_not_depend_on_the_processes(recorded: Path, tmp_path: Path):
    record_dataset(tmp_path / "one", MetaWorldConfig(task=TASKS, max_steps=100), episodes=2)
    np.testing.assert_equal(rows(tmp_path / "one"), rows(recorded))


def test_failures_are_recorded_on_request_spread_over_tasks(tmp_path: Path):
    env = SimulatedConfig(task="match,mirror", max_steps=60, hold=25)
    record_dataset(tmp_path / "mixed", env, episodes=8, failure_share=0.5, seed=3)
    ends = [row for row in rows(tmp_path / "mixed") if row["next.done"]]
    for task in ("Match the target", "Mirror the target"):
        outcomes = [bool(row["next.success"]) for row in ends if str(row["task"]) == task]
        assert sorted(outcomes) == [False, False, True, True]


def match(seed: int = 5, noise: float = 0.0, push: float = 0.0) -> Episode:
    environment = make_environment(SimulatedConfig(tolerance=0.01, max_steps=20))
    expert = make_expert(SimulatedConfig(), environment, "match")
    actions = disturbed(expert, environment.spec, seed, noise=noise, push=push, fail=False)
    return played(environment, "match", seed, actions)


def test_noise_is_in_the_recorded_action_and_seeded():
    one, again, clean = match(noise=0.1), match(noise=0.1), match()
    assert np.array_equal(one.actions, again.actions) and one.actions.dtype == np.float32
    assert clean.successes.tolist() == [False] * 3 + [True] and np.ptp(clean.actions, axis=0).max() == 0
    assert 0.05 < (one.actions - clean.actions[0]).std() < 0.2
    assert np.abs(one.actions).max() <= 1


def test_an_expert_that_is_pushed_misses_by_more_the_more_it_is_pushed():
    clean, pushed, further, other = match(), match(push=0.1), match(push=0.2), match(seed=6, push=0.2)
    assert np.ptp(pushed.actions, axis=0).max() == 0, "the same all the way"
    aside = pushed.actions[0] - clean.actions[0]
    assert 0 < np.linalg.norm(aside) <= 0.1
    assert_close(further.actions[0] - clean.actions[0], 2 * aside)
    assert not np.allclose(other.actions[0], further.actions[0], atol=1e-3)


def test_an_expert_that_cannot_succeed_is_reported_and_leaves_nothing(tmp_path: Path):
    config = DemosConfig(episodes=1, action_noise=1.0)
    with pytest.raises(InputError, match="demos.action_noise=1.0: .*match"):
        record_demos(SimulatedConfig(tolerance=1e-6, max_steps=8), config, str(tmp_path / "none"))
    assert list(tmp_path.iterdir()) == []


def test_replaying_its_actions_gives_its_frames():
    pytest.importorskip("metaworld")
    environment = make_environment(MetaWorldConfig(task="drawer-open-v3"))
    seen = environment.reset(0, "drawer-open-v3")
    for row in (row for row in rows(TINY) if row["episode_index"] == 0):
        # Bit-equal on the machine that recorded it; another processor or OpenGL may round differently.
        assert np.allclose(row["observation.state"], seen["observation.state"], atol=1e-3)
        picture = seen["observation.images.corner2"].transpose(2, 0, 1) / 255
        assert np.abs(row["observation.images.corner2"] - picture).mean() < 2 / 255
        result = environment.step_chunk(row["action"][None])
        assert result.rewards[0] == row["next.reward"]
        seen = result.observation
    assert result.terminated and result.rewards[0] == 1.0
    environment.close()


def test_an_instruction_is_asked_for_where_the_environment_has_none():
    """`export` calls it as well, before an episode is repeated."""
    spec = replace(make_environment(SimulatedConfig()).spec, instructions=())
    with pytest.raises(InputError, match="^env.task='': each frame of a dataset has an .*--env.task="):
        record.check_instruction(spec, GymConfig(id="reach/Reach-v0"))


WORLD = SimulatedConfig(max_steps=10, tolerance=0.45)


@pytest.fixture(scope="module")
def run(tiny_checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export")
    config = tiny_run(
        tiny_checkpoint,
        env=WORLD,
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
    written = dataset_features(dataset.meta)
    check_features(written, env_features(make_environment(WORLD).spec), {}, "dataset.repo_id", "")


def test_a_run_with_types_of_other_packages(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    other = Path(shutil.copytree(run, tmp_path / "run"))
    config = yaml.safe_load((run / "config.yaml").read_text())
    config |= {"algorithm": {"type": "theirs", "discover_packages_path": "a_package"}}
    config["env"]["discover_packages_path"] = "accerl_lerobot.envs"
    config["rollout"]["reward_model"]["trust_remote_code"] = "0" * 40  # not needed to repeat episodes
    (other / "config.yaml").write_text(yaml.safe_dump(config))
    allowed = "--env.discover_packages_path=accerl_lerobot.envs"
    assert exported(other, tmp_path / "set") == 2
    assert f"if you trust it, add {allowed}" in capsys.readouterr().err
    assert exported(other, tmp_path / "set", allowed) == 0
    config["rollout"]["reward_model"]["path"] = "outputs/classifier"
    (other / "config.yaml").write_text(yaml.safe_dump(config))
    assert exported(other, tmp_path / "judged", allowed) == 2
    assert "rollout.reward_model told its successes" in capsys.readouterr().err


def test_episodes_that_cannot_be_repeated_are_left_out(run, tmp_path, capsys):
    other = Path(shutil.copytree(run, tmp_path / "run"))
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
    (tmp_path / "config.yaml").write_text("device: auto\n")  # as in a run of a world model
    (tmp_path / "empty").mkdir()
    for path, root, message in (
        (run, tmp_path, "the folder exists; choose another or remove it"),
        (tmp_path / "empty", tmp_path / "new", "no accerl train run in it: there is no config.yaml"),
        (tmp_path, tmp_path / "new", "no accerl train run in it: there is no episodes.jsonl"),
    ):
        assert exported(path, root) == 2
        assert message in capsys.readouterr().err
    assert main(["export"]) == 2
    assert "path=None: name the folder" in capsys.readouterr().err
