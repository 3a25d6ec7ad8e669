# SPDX-License-Identifier: Apache-2.0
"""A Gymnasium environment of somebody else's package is named on the command line, and trained in."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from accerl_lerobot.config.parsing import parse
from accerl_lerobot.engines.config import RunConfig
from accerl_lerobot.envs import EnvConfig, GymConfig, make_environment
from accerl_lerobot.errors import InputError
from accerl_lerobot.run.preflight import check_environment
from tests.runs import replacing

PACKAGE = Path(__file__).parents[1] / "packages" / "lerobot_env_reach"
GYM = [
    "--env.type=gym", "--env.id=reach/Reach-v0", "--env.discover_packages_path=lerobot_env_reach",
    "--env.images={front: pixels}", "--env.state=[agent_pos, goal]", "--env.task=Reach the goal",
    "--env.max_steps=16",
]  # fmt: skip


@pytest.fixture(autouse=True)
def importable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(PACKAGE))


def config(*more: str) -> EnvConfig:
    return parse(RunConfig, replacing(GYM, *more)).env


def test_observations_are_mapped():
    environment = make_environment(config("--env.environment_state=[goal]", "--env.image_size=16"))
    seen = environment.reset(3, "reach/Reach-v0")
    raw = environment.environments["reach/Reach-v0"].unwrapped.observation()
    assert seen["observation.state"].tolist() == [*raw["agent_pos"], *raw["goal"]]
    assert seen["observation.environment_state"].tolist() == [*raw["goal"], 0.0]
    assert seen["observation.images.front"].shape == (16, 16, 3) and seen["task"] == "Reach the goal"
    later = environment.step_chunk(np.zeros((4, 2), np.float32)).observation
    assert later["observation.environment_state"][-1] == 4 / 16


def test_a_rendered_picture_and_the_whole_observation():
    drawn = {"images": {"side": "render"}, "image_size": 64, "environment_state": ("state",)}
    environment = make_environment(GymConfig(id="Pendulum-v1", reward="env", max_steps=6, **drawn))
    seen = environment.reset(1, "Pendulum-v1")
    assert seen["observation.images.side"].shape == (64, 64, 3) and seen["observation.images.side"].std() > 5
    assert seen["observation.environment_state"].tolist() == [*seen["observation.state"], 0.0]
    result = environment.step_chunk(np.full((9, 1), 3, np.float32))
    assert result.truncated and result.steps == 6 and (result.rewards < 0).all()


def halved(**options: Any) -> gymnasium.Env:
    """An environment that is registered with a wrapper."""
    pendulum = gymnasium.make("Pendulum-v1", max_episode_steps=-1, **options)
    return gymnasium.wrappers.TransformReward(pendulum, lambda reward: reward / 2)


gymnasium.register("Halved-v0", halved, max_episode_steps=2)


def test_the_environment_keeps_its_wrappers_but_not_its_time_limit():
    earned = []
    for name in ("Halved-v0", "Pendulum-v1"):
        environment = make_environment(GymConfig(id=name, images={}, reward="env", max_steps=6))
        for _ in range(2):
            environment.reset(1, name)
            result = environment.step_chunk(np.ones((6, 1), np.float32))
            assert result.truncated and result.steps == 6
        earned.append(result.rewards)
    np.testing.assert_allclose(2 * earned[0], earned[1], rtol=1e-6)


def test_the_environment_has_its_own_limit():
    assert make_environment(odd()).spec.max_steps == 7
    assert make_environment(odd(max_steps=3)).spec.max_steps == 3
    assert make_environment(odd(kwargs={"max_episode_steps": 9})).spec.max_steps == 9
    assert make_environment(config("--env.max_steps=0")).spec.max_steps == 500


class Odd(gymnasium.Env):
    """A point that says more than is read of it, reward and end as arrays of one number."""

    action_space = spaces.Box(-1, 1, (1,), np.float32)
    observation_space = spaces.Dict(agent_pos=spaces.Box(-1, 1, (2,), np.float32))

    def __init__(self, seeds="follow", told=(), fails=None, render_mode=None) -> None:
        if fails is not None:
            raise fails
        self.seeds, self.told, self.render_mode = seeds, dict(told), render_mode

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self.steps = 0
        start = {"follow": seed, "ignore": None, "same": 1}[self.seeds]
        self.position = np.random.default_rng(start).uniform(size=2).astype(np.float32)
        return self.seen(), {}

    def step(self, action: np.ndarray) -> Any:
        self.steps += 1
        info = {key: value(self.steps) for key, value in self.told.items()}
        return self.seen(), np.array([np.nan]), np.array([self.steps == 5]), False, info

    def seen(self) -> dict[str, Any]:
        depth, ragged = np.full((4, 4), np.inf, np.float32), [[1.0], [1.0, 2.0]]
        return {"agent_pos": self.position, "depth": depth, "label": "a point", "ragged": ragged}


gymnasium.register("Odd-v0", Odd, max_episode_steps=7)


def odd(**fields: Any) -> GymConfig:
    return GymConfig(**({"id": "Odd-v0", "images": {}, "state": ("agent_pos",)} | fields))


def ended(steps: int = 9, **fields: Any) -> Any:
    environment = make_environment(odd(**fields))
    environment.reset(0, "Odd-v0")
    return environment.step_chunk(np.zeros((steps, 1), np.float32))


@pytest.mark.parametrize(
    ("key", "told"),
    [
        ("succeed", {"succeed": lambda step: np.array([step >= 3])}),
        ("metrics.success", {"metrics": lambda step: {"success": step >= 3}}),
    ],
)
def test_success_is_read_by_its_key_and_ends_the_episode(key: str, told: dict[str, Any]):
    result = ended(success=key, kwargs={"told": told})
    assert result.success and result.terminated and result.note == ""
    assert result.rewards.tolist() == [0, 0, 1], "the first success ends the episode, which would go on"
    missed = ended(kwargs={"told": told})
    assert not missed.success and missed.terminated and missed.steps == 5
    assert missed.note.startswith("env.success='is_success': the environment's info has no such key")
    assert key in missed.note and "--env.success= to take terminated for success" in missed.note
    assert ended(2, kwargs={"told": told}).note == "", "the episode goes on"
    assert np.isnan(ended(reward="env").rewards).all(), "the reward is read"
    assert "it has no keys" in ended().note


@pytest.mark.parametrize(
    ("seeds", "warning"),
    [
        ("follow", ""),
        ("same", "all episodes have the same start"),
        ("ignore", "the environment's reset ignores its seed"),
    ],
)
def test_starts_that_do_not_follow_from_the_seed_are_told(seeds: str, warning: str, caplog: Any):
    check_environment(odd(kwargs={"seeds": seeds}))
    assert len(caplog.messages) == bool(warning) and "".join(caplog.messages).startswith(warning)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("--env.id=reach/Nothing-v0", r"env\.id='reach/Nothing-v0': .*env\.discover_packages_path"),
        ("--env.id=CartPole-v1", r"env\.id='CartPole-v1': actions must be a bounded vector"),
        ("--env.images={front: frames}", r"env\.images='frames': the observation has agent_pos"),
        ("--env.images={front: goal}", r"env\.images=.*uint8 \(H, W, 3\)"),
        ("--env.state=[]", r"env\.state='': the observation has agent_pos"),
        ({"fails": ValueError("broken")}, r"env\.id='Odd-v0': the environment fails \(ValueError: broken\)"),
        ({"fails": RuntimeError("gladLoadGL error")}, r"MUJOCO_GL='.*': the environment cannot draw"),
        ({"fails": ModuleNotFoundError("x", name="arms.left")}, r"env\.id=.*: the package arms is not"),
        ({"fast": True}, r"env\.id='Odd-v0': the environment fails \(TypeError: .*'fast'"),
    ],
)
def test_bad_values_and_failures_are_one_line(given: Any, message: str):
    with pytest.raises(InputError, match=message):
        make_environment(config(given) if isinstance(given, str) else odd(kwargs=given))
