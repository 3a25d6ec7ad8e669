# SPDX-License-Identifier: Apache-2.0
"""Situations of docs/reported_elsewhere.md: what other projects' users reported, tried here."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pyarrow as pa
import pytest
from gymnasium import spaces

from accerl_lerobot.cli import main
from accerl_lerobot.demos.dataset_files import open_metadata, opened
from accerl_lerobot.engines.config import RunConfig, parse
from accerl_lerobot.envs import GymConfig, make_environment
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.features import check_features, env_features, policy_features
from accerl_lerobot.policies.loading import load_lerobot_config
from accerl_lerobot.seeds import eval_seed
from tests.policies.checkpoints import edit_config, write_smolvla
from tests.policies.tiny import adapter_at, requests
from tests.runs import replacing
from tests.test_offline import arguments
from tests.tiny_datasets import ACTION, FPS, FRONT, IMAGE, STATE, labels, rewrite, write_dataset


class Arm(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):
    """Two joints and a camera; succeeds after two steps."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012
    observation_space = spaces.Dict(
        {"pixels": spaces.Box(0, 255, (16, 16, 3), np.uint8), "joints": spaces.Box(-1, 1, (2,), np.float32)}
    )
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        np.random.seed(seed)  # noqa: NPY002 as many environments do; it refuses seeds of 2**32 and above
        self.steps = 0
        return self.observation_space.sample(), {}

    def step(self, action: np.ndarray) -> Any:
        self.steps += 1
        success = {"is_success": np.array([self.steps == 2])}
        return self.observation_space.sample(), np.array([0.0]), np.array([False]), False, success


@pytest.fixture
def registered() -> Iterator[Callable[[type[Arm]], GymConfig]]:
    def register(kind: type[Arm]) -> GymConfig:
        gymnasium.register("reported/Arm-v0", kind, disable_env_checker=True)
        return GymConfig(id="reported/Arm-v0", images={"front": "pixels"}, state=("joints",), task="Reach")

    yield register
    gymnasium.registry.pop("reported/Arm-v0", None)


def test_success_reward_and_end_may_be_arrays_of_one(registered: Any):
    environment = make_environment(registered(Arm))
    environment.reset(eval_seed(0, 0), "reported/Arm-v0")
    result = environment.step_chunk(np.zeros((4, 2), np.float32))
    assert (result.success, result.done, result.steps) == (True, True, 2)
    assert result.rewards.sum() == 1.0


@pytest.mark.parametrize(
    ("method", "given", "message"),
    [
        ("reset", lambda full: full[0], r"let its reset return \(observation, info\)"),
        ("step", lambda full: (*full[:3], full[4]), r"let its step return \(observation, reward"),
    ],
)
def test_an_environment_of_the_older_interface_is_told_what_to_return(method, given, message, registered):
    full = getattr(Arm, method)
    older = type("Older", (Arm,), {method: lambda *args, **kw: given(full(*args, **kw))})
    with pytest.raises(InputError, match=f"^env.id='reported/Arm-v0': {message}"):
        environment = make_environment(registered(older))
        environment.reset(0, "reported/Arm-v0")
        environment.step_chunk(np.zeros((4, 2), np.float32))


def test_a_recipe_from_windows_names_a_policy(tiny_checkpoint: Path, tmp_path: Path):
    recipe = tmp_path / "recipe.yaml"
    text = f"\ufeffenv:\r\n  type: simulated\r\npolicy:\r\n  path: {tiny_checkpoint}\r\n"
    recipe.write_bytes(text.encode())
    config = parse(RunConfig, [f"--config_path={recipe}"])
    assert config.policy.path == str(tiny_checkpoint) and config.env.tasks == ("match",)


def test_a_run_is_not_resumed_from_lerobot_s_own_file(tiny_checkpoint: Path):
    with pytest.raises(InputError, match="^config_path='.*config.json': LeRobot wrote it; resume a run with"):
        parse(RunConfig, [f"--config_path={tiny_checkpoint / 'config.json'}", "--resume=true"])


@pytest.mark.parametrize(
    "changes", [{"device": "cuda:0"}, {"device": "mps", "use_amp": True}], ids=["another GPU", "a Mac's"]
)
def test_the_device_in_the_checkpoint_is_replaced(changes: dict, tiny_checkpoint: Path, tmp_path: Path):
    copied = Path(shutil.copytree(tiny_checkpoint, tmp_path / "policy"))
    edit_config(copied, **changes)
    asked = requests(1, explore=False)
    chunks = [adapter_at(path).decide(asked, 0)[0].chunk for path in (tiny_checkpoint, copied)]
    np.testing.assert_array_equal(*chunks)


def test_a_config_without_a_type_is_told_what_to_add(tiny_checkpoint: Path, tmp_path: Path):
    copied = Path(shutil.copytree(tiny_checkpoint, tmp_path / "policy"))
    path = copied / "config.json"
    path.write_text(json.dumps({k: v for k, v in json.loads(path.read_text()).items() if k != "type"}))
    with pytest.raises(InputError, match=r'^policy\.type=None: .*names no type; add "type": one of act, '):
        adapter_at(copied)


def test_a_policy_that_reads_an_instruction_warns_of_none(tiny_checkpoint: Path, registered: Any, caplog):
    policy = policy_features(load_lerobot_config(PolicyConfig(path=str(tiny_checkpoint), device="cpu")))
    spec = make_environment(registered(Arm)).spec
    for tasks in (("Reach",), ()):
        offered = env_features(replace(spec, instructions=tasks))
        check_features(replace(policy, shapes={}), offered, {}, "policy.path", "mine")
        assert ("name it in env.task" in caplog.text) is not bool(tasks)


def test_episodes_whose_borders_contradict_the_rows_are_refused(tmp_path: Path):
    dataset = write_dataset(tmp_path / "data")

    def move_border(table: pa.Table) -> pa.Table:
        for name, values in (("dataset_to_index", [8, 12]), ("dataset_from_index", [0, 8])):
            table = table.set_column(table.schema.get_field_index(name), name, pa.array(values))
        return table

    rewrite(tmp_path / "data/meta/episodes/chunk-000/file-000.parquet", move_border)
    message = "data: row 6: by meta/episodes it is of another episode"
    with pytest.raises(InputError, match=message), opened(dataset, open_metadata(dataset)):
        pass


def test_videos_in_several_files_and_timestamps_off_the_rate(tmp_path: Path):
    def grey(name: str, episode: int, step: int) -> Any:
        return np.full((32, 32, 3), 100 * episode + 15 * step + 10) if name == FRONT else None

    videos = {FRONT: IMAGE | {"dtype": "video"}}
    dataset = write_dataset(tmp_path / "data", more=videos, values=grey, video_files_size_in_mb=0.0001)
    assert len(list((tmp_path / "data/videos").rglob("*.mp4"))) == 2
    with opened(dataset, open_metadata(dataset)) as data:
        greys = [255 * float(data[row][FRONT].mean()) for row in range(12)]
    np.testing.assert_allclose(greys, [100 * (row // 6) + 15 * (row % 6) + 10 for row in range(12)], atol=6)

    def delay(table: pa.Table) -> pa.Table:
        stamps = table.column("timestamp").to_numpy().copy()
        stamps[2] += 1 / FPS  # where the video has a frame, another one
        column = table.schema.get_field_index("timestamp")
        return table.set_column(column, "timestamp", pa.array(stamps))

    rewrite(tmp_path / "data/data/chunk-000/file-000.parquet", delay)
    message = "data: row 2: its timestamp is not frame_index / 80"
    with pytest.raises(InputError, match=message), opened(dataset, open_metadata(dataset)):
        pass


@pytest.mark.parametrize("size", [1, 2], ids=["one joint", "one of two joints never moves"])
def test_a_policy_learns_from(size: int, tiny_checkpoint: Path, tmp_path: Path):
    one = size == 1
    small = {"state_dim": 1, "action_dim": 1, "padded_dim": 1}
    checkpoint = write_smolvla(tmp_path / "policy", **small) if one else tiny_checkpoint
    shapes = {STATE: (1 if one else 4,), ACTION: (size,)}
    more = {name: {"dtype": "float32", "shape": shape, "names": None} for name, shape in shapes.items()}

    def value(name: str, episode: int, step: int) -> Any:
        still = np.array([0.1 * step - 0.3, 0.25]) if name == ACTION and size == 2 else None
        return [step == 5] if name == "next.success" else still

    write_dataset(tmp_path / "data", more=more | {FRONT: IMAGE, "next.success": labels()}, values=value)
    given = arguments(checkpoint, tmp_path / "data", tmp_path / "out")
    assert main(replacing(given, "--trainer.updates=1", "--algorithm.type=self_imitation")) == 0
    loss = json.loads((tmp_path / "out/summary.json").read_text())["imitation_loss"]
    assert 0 < loss["after"]["successes"] < loss["before"]["successes"] < 10
