# SPDX-License-Identifier: Apache-2.0
"""Situations of docs/reported_elsewhere.md: what other projects' users reported, tried here."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from accerl_lerobot.engine.config import RunConfig, parse
from accerl_lerobot.envs import GymConfig, make_world
from accerl_lerobot.errors import InputError
from accerl_lerobot.seeds import demo_seed, eval_seed, train_seed
from tests.policies.checkpoints import edit_config
from tests.policies.tiny import adapter_at, requests


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
        return self.seen(), {}

    def seen(self) -> dict[str, np.ndarray]:
        return {"pixels": np.zeros((16, 16, 3), np.uint8), "joints": np.zeros(2, np.float32)}

    def step(self, action: np.ndarray) -> Any:
        self.steps += 1
        success = np.array([self.steps == 2])
        return self.seen(), np.array([0.0]), np.array([False]), False, {"is_success": success}


@pytest.fixture
def registered() -> Iterator[Callable[[type[Arm]], GymConfig]]:
    """Registers an environment for one test."""

    def register(kind: type[Arm]) -> GymConfig:
        gymnasium.register("reported/Arm-v0", kind, disable_env_checker=True)
        return GymConfig(id="reported/Arm-v0", images={"front": "pixels"}, state=("joints",), task="Reach")

    yield register
    gymnasium.registry.pop("reported/Arm-v0", None)


def test_success_reward_and_end_may_be_arrays_of_one(registered: Any):
    world = make_world(registered(Arm))
    world.reset(eval_seed(0, 0), "reported/Arm-v0")
    result = world.step_chunk(np.zeros((4, 2), np.float32))
    assert (result.success, result.done, result.steps) == (True, True, 2)
    assert result.rewards.sum() == 1.0


@pytest.mark.parametrize(
    ("method", "given", "message"),
    [
        ("reset", lambda full: full[0], r"its reset returns a dict; let it return \(observation, info\)"),
        ("step", lambda full: (*full[:3], full[4]), "its step returns 4 values; let it return"),
    ],
)
def test_an_environment_of_the_older_interface_is_told_what_to_return(
    method: str, given: Any, message: str, registered: Any
):
    full = getattr(Arm, method)
    older = type("Older", (Arm,), {method: lambda *args, **kw: given(full(*args, **kw))})
    with pytest.raises(InputError, match=f"^env.id='reported/Arm-v0': {message}"):
        world = make_world(registered(older))
        world.reset(0, "reported/Arm-v0")
        world.step_chunk(np.zeros((4, 2), np.float32))


@pytest.mark.parametrize("run_seed", [0, 2**32 - 1, 2**63 - 1])
def test_every_seed_of_an_episode_is_one_that_numpy_s_old_generator_takes(registered: Any, run_seed: int):
    world = make_world(registered(Arm))
    for seed in (demo_seed(run_seed, 7), train_seed(run_seed, 999, 10**6), eval_seed(run_seed, 9_999)):
        world.reset(seed, "reported/Arm-v0")


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
