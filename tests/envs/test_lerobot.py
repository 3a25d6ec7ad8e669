# SPDX-License-Identifier: Apache-2.0
"""Both directions: LeRobot's environments as our environments, ours as LeRobot's."""

import importlib
import json
import shlex
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from huggingface_hub import constants

from accerl_lerobot.envs import GymConfig, LeRobotEnvConfig, MetaWorldConfig, make_environment
from accerl_lerobot.envs.base import lerobot_eval_arguments
from accerl_lerobot.envs.gym_env import LeRobotEnvironment
from accerl_lerobot.errors import InputError
from tests.hub_cache import cached_repo


def test_the_command_for_stock_lerobot():
    env = {"type": "lerobot", "name": "aloha", "task": "Push the T", "max_steps": 9}
    renames = {"observation.images.top": "observation.images.camera1"}
    command = lerobot_eval_arguments(env | {"discover_packages_path": "my_envs", "camera": "image"}, renames)
    values = dict(shlex.split(argument)[0].split("=", 1) for argument in command)
    assert values["--env.type"] == "accerl" and json.loads(values["--rename_map"]) == renames
    assert json.loads(values["--env.environment"]) == env | {"discover_packages_path": "my_envs"}
    assert values["--env.environment.discover_packages_path"] == "my_envs"
    assert lerobot_eval_arguments({"type": "theirs"}, {}) == []


def test_images_and_states_are_lerobot_s():
    pytest.importorskip("gym_pusht")
    pusht = LeRobotEnvironment(LeRobotEnvConfig(name="pusht", camera="top"))
    assert pusht.spec.max_steps == 300, "LeRobot's limit"
    ours = pusht.reset(7, "pusht")
    raw, _ = pusht.environments["pusht"].reset(seed=7)
    assert np.array_equal(ours["observation.images.top"], raw["pixels"])
    assert np.array_equal(ours["observation.state"], raw["agent_pos"].astype(np.float32))
    pusht.close()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"name": "nope"}, "env.name='nope': LeRobot has: .*pusht"),
        ({"kwargs": {"colour": 1}}, "env.kwargs=.*colour.*pusht has the fields .*obs_type"),
        ({"kwargs": {"obs_type": "environment_state_agent_pos"}}, "pixels_agent_pos"),
        ({"kwargs": {"episode_length": 20}, "max_steps": 12}, "episode_length=20: env.max_steps=12"),
    ],
)
def test_bad_values_name_field_and_remedy(values: dict, message: str):
    pytest.importorskip("gym_pusht")
    with pytest.raises(InputError, match=message):
        make_environment(LeRobotEnvConfig(**values))


@pytest.fixture
def plugin():
    pytest.importorskip("metaworld")
    from lerobot.configs.parser import load_plugin

    load_plugin("accerl_lerobot.envs.lerobot_plugin")
    from lerobot.envs.factory import make_env_config

    return lambda **values: make_env_config("accerl", environment={"type": "metaworld"} | values)


def test_stock_lerobot_sees_our_world(plugin):
    from lerobot.envs.factory import make_env
    from lerobot.envs.utils import NEW_ROLLOUT_OPTION, env_to_policy_features, preprocess_observation

    with pytest.raises(InputError, match="env.image_size"):
        plugin(image_size=10)
    config = plugin(task="handle-press-v3", max_steps=6)
    shapes = {key: tuple(feature.shape) for key, feature in env_to_policy_features(config).items()}
    camera = "observation.images.corner2"
    assert shapes == {"action": (4,), "observation.state": (4,), camera: (3, 64, 64)}
    vector = make_env(config, n_envs=2)["handle-press-v3"][0]
    seen = preprocess_observation(vector.reset(seed=[3, 4], options={NEW_ROLLOUT_OPTION: True})[0])
    environment = make_environment(MetaWorldConfig(task="handle-press-v3", max_steps=6))
    ours = environment.reset(3, "handle-press-v3")
    image = (seen[camera][0] * 255).round().byte().permute(1, 2, 0).numpy()
    assert np.array_equal(image, ours[camera])
    assert np.array_equal(seen["observation.state"][0].numpy(), ours["observation.state"])
    assert vector.call("task_description") == (ours["task"],) * 2
    assert vector.call("_max_episode_steps") == (6, 6)
    for _ in range(9):
        _, _, terminated, _, info = vector.step(np.zeros((2, 4), np.float32))
        assert not terminated.any() and not info["is_success"].any()
    assert all(env.is_frozen for env in vector.envs), "an episode that is over is not played again"
    assert vector.envs[0].render().shape == (256, 256, 3)
    vector.close()
    environment.close()


@pytest.mark.usefixtures("plugin")
@pytest.mark.parametrize("asynchronous", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_stock_lerobot_runs_a_gymnasium_environment(monkeypatch: pytest.MonkeyPatch, asynchronous: bool):
    from lerobot.envs.factory import make_env, make_env_config
    from lerobot.envs.utils import NEW_ROLLOUT_OPTION

    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "packages" / "lerobot_env_reach"))
    environment = {"type": "gym", "id": "reach/Reach-v0", "discover_packages_path": "lerobot_env_reach"}
    environment |= {"images": {"front": "pixels"}, "state": ["agent_pos", "goal"], "max_steps": 5, "fps": 10}
    said = "only the command line .* add --env.environment.discover_packages_path="
    with pytest.raises(InputError, match=said):
        make_env_config("accerl", environment=environment | {"discover_packages_path": "somebodys"})
    importlib.import_module("lerobot_env_reach")
    settings = make_env_config("accerl", environment=environment)
    assert settings.fps == 10 and settings.features["agent_pos"].shape == (4,)
    made = make_env(settings, n_envs=2, use_async_envs=asynchronous)
    with closing(made["reach/Reach-v0"][0]) as vector:
        seen, _ = vector.reset(seed=[3, 4], options={NEW_ROLLOUT_OPTION: True})
        ours = make_environment(GymConfig(**{k: v for k, v in environment.items() if k != "type"}))
        assert np.array_equal(seen["agent_pos"][1], ours.reset(4, "reach/Reach-v0")["observation.state"])
        ends = [vector.step(np.zeros((2, 2), np.float32))[3].all() for _ in range(5)]
        assert ends == [False] * 4 + [True]


COMMIT = "0123456789abcdef0123456789abcdef01234567"


@pytest.mark.parametrize(
    ("hub_path", "trust", "said"),
    [
        (f"them/arena@{COMMIT}", False, "env.trust_remote_code=False: isaaclab_arena is code of them/arena"),
        ("them/arena@main", True, "env.kwargs.hub_path='them/arena@main': name a commit"),
        (f"them/arena@{COMMIT}:../../env.py", True, "env.kwargs.hub_path="),
        (f"them/arena@{COMMIT}:env.py", True, r"env\.name='isaaclab_arena': .*\(OSError: ran\)"),
    ],
)
def test_environments_on_the_hub_are_not_run_unasked(hub_path, trust, said, tmp_path, monkeypatch):
    marker = tmp_path / "was-run"
    code = f"open({str(marker)!r}, 'w')\ndef make_env(**options): raise OSError('ran')\n"
    (cached_repo(tmp_path, "them/arena", COMMIT) / "env.py").write_text(code)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
    kwargs = {"hub_path": hub_path}
    with pytest.raises(InputError, match=f"^{said}"):
        make_environment(LeRobotEnvConfig(name="isaaclab_arena", kwargs=kwargs, trust_remote_code=trust))
    assert marker.exists() == said.endswith(r"ran\)")
