# SPDX-License-Identifier: Apache-2.0
"""MetaWorld: same environment as LeRobot's, cheaper; success, termination, divergence, tasks."""

import sys

import numpy as np
import pytest

from accerl_lerobot.envs import LiberoConfig, MetaWorldConfig, graphics, make_environment
from accerl_lerobot.envs.base import SuiteConfig
from accerl_lerobot.envs.metaworld import MetaWorld, ShiftConfig, description, expert_name, groups
from accerl_lerobot.errors import InputError

pytest.importorskip("metaworld")
TASK = "handle-press-v3"
IMAGE = "observation.images.corner2"


def test_worlds_that_share_simulators_do_not_disturb_each_other():
    config = MetaWorldConfig(task=f"{TASK},door-open-v3", max_steps=20)
    a, b = MetaWorld(config), MetaWorld(config)
    first = a.reset(0, TASK)
    b.reset(0, "door-open-v3")
    a.reset(1, "door-open-v3")
    again = b.reset(0, TASK)
    assert all(np.array_equal(first[name], again[name]) for name in first)
    assert a.simulator is not b.simulator
    a.close()
    b.close()


def test_same_states_and_frames_as_lerobot():
    graphics.import_mujoco()
    stock_module = pytest.importorskip("lerobot.envs.metaworld")
    stock = stock_module.MetaworldEnv("push-v3", obs_type="pixels_agent_pos")
    actions = np.random.default_rng(0).uniform(-1, 1, (3, 4)).astype(np.float32)
    # LeRobot's pictures first: once ours has an OpenGL context, theirs would be drawn into it.
    theirs = [stock.reset(seed=11)[0], *(stock.step(action)[0] for action in actions)]
    environment = make_environment(MetaWorldConfig(task="push-v3", image_size=480, rendering="stock"))
    ours = environment.reset(11, "push-v3")
    assert np.array_equal(theirs[0]["agent_pos"].astype(np.float32), ours["observation.state"])
    for action, raw in zip(actions, theirs[1:], strict=True):
        result = environment.step_chunk(action[None])
        assert np.array_equal(raw["agent_pos"].astype(np.float32), result.observation["observation.state"])
        assert np.array_equal(raw["pixels"], result.observation[IMAGE])
    assert result.observation["task"] == stock.task_description
    stock.close()
    environment.close()


def test_a_diverged_simulator_ends_the_episode_and_says_so(tmp_path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its log into the working directory
    environment = MetaWorld(MetaWorldConfig(task=TASK))
    environment.reset(0, TASK)
    environment.simulator.env.data.qpos[:] = np.nan
    result = environment.step_chunk(np.zeros((5, 4), np.float32))
    assert not result.finite and result.truncated and result.steps == 1
    healthy = environment.reset(0, TASK)
    assert np.isfinite(healthy["observation.state"]).all()
    assert environment.step_chunk(np.zeros((5, 4), np.float32)).finite


def test_tables_know_all_fifty_tasks_and_groups_resolve_in_order():
    assert len(groups()["all"]) == 50
    assert sum(len(groups()[name]) for name in ("easy", "medium", "hard", "very_hard")) == 50
    policies = pytest.importorskip("metaworld.policies")
    assert all(hasattr(policies, expert_name(task)) and description(task) for task in groups()["all"])
    assert len(MetaWorldConfig(task="easy").tasks) == 28
    assert MetaWorldConfig(task="reach-v3, hard,reach-v3").tasks == ("reach-v3", *groups()["hard"])


@pytest.mark.parametrize(
    ("config", "values", "message"),
    [
        (MetaWorldConfig, {"task": "metaworld-push-v2"}, "push-v3"),
        (MetaWorldConfig, {"task": ""}, "task=''"),
        (MetaWorldConfig, {"camera": "front"}, "corner2"),
        (MetaWorldConfig, {"camera": "corner,corner"}, "once"),
        (LiberoConfig, {"task": "libero_objects"}, "'libero_objects' is no task; did you mean libero_object"),
    ],
)
def test_bad_values_name_field_and_remedy(config: type[SuiteConfig], values: dict[str, str], message: str):
    pytest.importorskip("libero" if config is LiberoConfig else "metaworld")
    with pytest.raises(InputError, match=f"^env.*{message}"):
        config(**values)


@pytest.mark.parametrize(
    ("backend", "message"),
    [("glfw", "MUJOCO_GL='glfw': without a display"), ("", "MUJOCO_GL='': .*apt-get install -y libosmesa6")],
)
def test_what_cannot_draw_is_refused(backend: str, message: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("MUJOCO_GL", backend)
    monkeypatch.setattr(graphics, "_LIBRARIES", {"egl": ("libNoEGL.so",), "osmesa": ("libNoMesa.so",)})
    with pytest.raises(InputError, match=message):
        make_environment(MetaWorldConfig(task=TASK)).reset(0, TASK)


def test_pictures_change_with_a_moved_camera_and_physics_does_not():
    actions = np.random.default_rng(0).uniform(-1, 1, (30, 4)).astype(np.float32)
    frames, states = [], []
    for move in (0.0, 0.1):
        environment = MetaWorld(MetaWorldConfig(task=TASK, shift=ShiftConfig(camera=(0.0, move, 0.0))))
        environment.reset(5, TASK)
        frames.append(environment.step_chunk(actions).observation[IMAGE].astype(int))
        states.append(environment.simulator.everything())
    np.testing.assert_array_equal(*states)
    assert np.abs(frames[1] - frames[0]).mean() > 3
    nominal = environment.config.nominal()
    assert nominal == MetaWorldConfig(task=TASK), "demonstrations show the world without shift"
