# SPDX-License-Identifier: Apache-2.0
"""A Gymnasium environment of somebody else's package is named on the command line, and trained in."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from accerl_lerobot.config.parsing import parse
from accerl_lerobot.engine.config import LaunchConfig, RunConfig
from accerl_lerobot.envs import GymConfig, gym_env, make_world
from accerl_lerobot.envs.gym_env import GymWorld
from accerl_lerobot.errors import InputError
from tests.runs import pip_installed, replacing, tiny_run, trained

PACKAGE = Path(__file__).parents[1] / "packages" / "lerobot_env_reach"
GYM = [
    "--env.type=gym", "--env.id=reach/Reach-v0", "--env.discover_packages_path=lerobot_env_reach",
    "--env.images={front: pixels}", "--env.state=[agent_pos, goal]", "--env.task=Reach the goal",
    "--env.max_steps=16",
]  # fmt: skip


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.syspath_prepend(str(PACKAGE))
    yield


def config(*more: str) -> GymConfig:
    env = parse(RunConfig, replacing(GYM, *more)).env
    assert isinstance(env, GymConfig)
    return env


def test_observations_are_mapped():
    world = make_world(config("--env.environment_state=[goal]", "--env.image_size=16"))
    assert isinstance(world, GymWorld)
    seen, raw = world.reset(3, "reach/Reach-v0"), world._env.unwrapped.observation()
    assert seen["observation.state"].tolist() == [*raw["agent_pos"], *raw["goal"]]
    assert seen["observation.environment_state"].tolist() == [*raw["goal"], 0.0]
    assert seen["observation.images.front"].shape == (16, 16, 3) and seen["task"] == "Reach the goal"
    later = world.step_chunk(np.zeros((4, 2), np.float32)).observation
    assert later["observation.environment_state"][-1] == 4 / 16
    assert config("--env.environment_state=[goal]").state_size == 3 and config().state_size == 0


def test_a_rendered_picture_and_the_whole_observation():
    pendulum = GymConfig(
        id="Pendulum-v1", images={"side": "render"}, image_size=64, environment_state=("state",)
    )
    world = make_world(replace(pendulum, reward="env", max_steps=6))
    seen = world.reset(1, "Pendulum-v1")
    assert seen["observation.images.side"].shape == (64, 64, 3) and seen["observation.images.side"].std() > 5
    assert seen["observation.environment_state"].tolist() == [*seen["observation.state"], 0.0]
    result = world.step_chunk(np.full((9, 1), 3, np.float32))
    assert result.truncated and result.steps == 6 and (result.rewards < 0).all()
    assert world.render(20, 30).shape == (20, 30, 3)


def test_the_first_success_ends_the_episode():
    world = make_world(config())
    world.reset(0, "reach/Reach-v0")
    for _ in range(16):
        inner = world._env.unwrapped
        way = (inner.goal - inner.agent) / inner.speed
        result = world.step_chunk(way[None])
        if result.done:
            break
    assert result.terminated and result.success and result.rewards.tolist() == [1.0]


class Tilted(gymnasium.Wrapper):
    """Half the action, as a wrapper that the environment is registered with."""

    def step(self, action: Any) -> Any:
        return self.env.step(action / 2)


def test_the_environment_keeps_its_wrappers_but_not_its_time_limit(caplog: pytest.LogCaptureFixture):
    def tilted(**options: Any) -> gymnasium.Env:
        return Tilted(gymnasium.make("Pendulum-v1", max_episode_steps=3, **options))

    gym_env._warn_of_missing.cache_clear()
    gymnasium.register("Tilted-v0", tilted, max_episode_steps=2)
    observed = []
    for name, torque in (("Tilted-v0", 2.0), ("Pendulum-v1", 1.0)):
        world = make_world(GymConfig(id=name, images={}, reward="env", max_steps=6))
        for _ in range(2):
            world.reset(1, name)
            result = world.step_chunk(np.full((6, 1), torque, np.float32))
            assert result.truncated and result.steps == 6
        observed.append(result.observation["observation.state"].tolist())
    assert observed[0] == observed[1]
    (message,) = caplog.messages
    assert message.startswith("env.success='is_success': the environment's info had no such key")


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ("--env.id=reach/Nothing-v0", r"env\.id='reach/Nothing-v0': .*env\.discover_packages_path"),
        ("--env.id=os:reach/Reach-v0", r"env\.id='os:reach/Reach-v0': .*env\.discover_packages_path"),
        ("--env.id=CartPole-v1", r"env\.id='CartPole-v1': actions must be a bounded vector"),
        ("--env.kwargs={colour: 1}", r"env\.id=.*colour"),
        ("--env.images={front: frames}", r"env\.images='frames': the observation has agent_pos"),
        ("--env.images={front: goal}", r"env\.images=.*uint8 \(H, W, 3\)"),
        ("--env.state=[]", r"env\.state='': the observation has agent_pos"),
    ],
)
def test_bad_values_name_field_and_remedy(changed: str, message: str):
    with pytest.raises(InputError, match=message):
        make_world(config(changed))


def test_it_trains(tiny_checkpoint: Path):
    run = replace(tiny_run(tiny_checkpoint, env=config()), launch=LaunchConfig(engine="local"))
    made = trained(run, ("reach/Reach-v0",))
    assert len(made) == 12 and made[-1]["skipped"] == 0


@pytest.mark.slow
def test_the_installed_package_is_found_by_every_process(tiny_checkpoint: Path, tmp_path: Path):
    """As `env.type=gym` in a run on Ray, and as LeRobot's plugin ``reach``, which only pip has announced."""
    source = shutil.copytree(PACKAGE, tmp_path / "source")  # pip builds within it
    environment = pip_installed(source, tmp_path / "site")
    accerl = [sys.executable, "-m", "accerl_lerobot.cli"]
    run = [
        "train", *GYM, f"--policy.path={tiny_checkpoint}", "--policy.device=cpu", "--rollout.worlds=4",
        "--rollout.segment_length=3", "--replay.capacity=64", "--replay.min_decisions=16",
        "--replay.ahead=32",
        "--trainer.updates=4", "--trainer.batch_decisions=16", "--evaluation.episodes=4",
        f"--output_dir={tmp_path / 'run'}",
    ]  # fmt: skip
    subprocess.run([*accerl, *run], check=True, env=environment, cwd=tmp_path)
    assert (tmp_path / "run" / "summary.json").is_file()
    code = (
        "from accerl_lerobot.envs import LeRobotEnvConfig, make_world\n"
        "world = make_world(LeRobotEnvConfig(name='reach', task='Reach the goal'))\n"
        "print(world.reset(0, 'reach')['observation.state'].shape)\n"
    )
    shown = subprocess.run([sys.executable, "-c", code], check=True, env=environment, capture_output=True)
    assert shown.stdout.decode().splitlines()[-1] == "(2,)"
