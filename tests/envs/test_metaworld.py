# SPDX-License-Identifier: Apache-2.0
"""MetaWorld: same environment as LeRobot's, cheaper; success, termination, divergence, tasks."""

import sys

import numpy as np
import pytest

from accerl_lerobot.demos.record import make_expert
from accerl_lerobot.envs import LiberoConfig, MetaWorldConfig, graphics, make_environment
from accerl_lerobot.envs import metaworld as gl
from accerl_lerobot.envs.base import SuiteConfig
from accerl_lerobot.envs.metaworld import MetaWorld, ShiftConfig, description, expert_name, groups
from accerl_lerobot.errors import InputError

pytest.importorskip("metaworld")
TASK = "handle-press-v3"
IMAGE = "observation.images.corner2"


def play(environment: MetaWorld, seed: int = 0, chunk: int = 1) -> list:
    environment.reset(seed, TASK)
    expert, results = make_expert(environment.config, environment, TASK), []
    while not results or not results[-1].done:
        action = np.clip(expert(), -1, 1).astype(np.float32)
        results.append(environment.step_chunk(np.repeat(action[None], chunk, 0)))
    return results


def test_success_terminates_with_one_reward_and_a_last_picture(monkeypatch: pytest.MonkeyPatch):
    environment, frames = MetaWorld(MetaWorldConfig(task=TASK)), []
    frame = gl.Simulator.render
    monkeypatch.setattr(gl.Simulator, "render", lambda *args: frames.append(1) or frame(*args))
    results = play(environment, chunk=3)
    assert results[-1].terminated and results[-1].success and not results[-1].truncated
    assert sum(float(r.rewards.sum()) for r in results) == 1.0 and results[-1].rewards[-1] == 1.0
    assert len(frames) == len(results) + 1, "one picture at the reset and one per chunk"


def test_worlds_share_simulators_in_turn(monkeypatch: pytest.MonkeyPatch):
    built, build = [], gl.Simulator
    monkeypatch.setattr(gl, "Simulator", lambda task, config: built.append(task) or build(task, config))
    config = MetaWorldConfig(task=f"{TASK},door-open-v3", max_steps=20)
    a, b = MetaWorld(config), MetaWorld(config)
    first = a.reset(0, TASK)
    b.reset(0, "door-open-v3")
    a.reset(1, "door-open-v3")
    again, held = b.reset(0, TASK), a.simulator
    assert built == [TASK, "door-open-v3", "door-open-v3"], "b has the one that a has put back"
    assert all(np.array_equal(first[name], again[name]) for name in first)
    b.reset(0, "door-open-v3")
    assert a.simulator is held is not b.simulator and len(built) == 3
    a.close()
    b.close()
    a.reset(0, TASK)
    assert built[3:] == [TASK], "all were closed"


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
    if config is LiberoConfig:
        pytest.importorskip("libero")
    with pytest.raises(InputError, match=f"^env.*{message}"):
        config(**values)


def test_touch_is_told_as_metaworld_tells_it(monkeypatch: pytest.MonkeyPatch):
    task, told = "push-v3", []
    environment = MetaWorld(MetaWorldConfig(task=task))
    environment.reset(0, task)
    expert, sim = make_expert(environment.config, environment, task), environment.simulator.env
    ours, theirs = sim.touching_object, type(sim).touching_object

    def both(geom: int) -> bool:
        told.append((ours(geom), theirs(sim, geom)))
        return told[-1][0]

    monkeypatch.setattr(sim, "touching_object", both)
    while not environment.step_chunk(np.clip(expert(), -1, 1).astype(np.float32)[None]).done:
        pass
    assert {(False, False), (True, True)} == set(told)


@pytest.mark.parametrize(
    ("backend", "message"),
    [("glfw", "MUJOCO_GL='glfw': without a display"), ("", "MUJOCO_GL='': .*apt-get install -y libosmesa6")],
)
def test_what_cannot_draw_is_refused(backend: str, message: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    if backend:
        monkeypatch.setenv("MUJOCO_GL", backend)
    else:
        monkeypatch.setattr(graphics, "_LIBRARIES", {"egl": ("libNoEGL.so",), "osmesa": ("libNoMesa.so",)})
    with pytest.raises(InputError, match=message):
        make_environment(MetaWorldConfig(task=TASK)).reset(0, TASK)


def test_pictures_change_with_a_moved_camera_and_physics_does_not():
    actions = np.random.default_rng(0).uniform(-1, 1, (30, 4)).astype(np.float32)
    frames, states = [], []
    for move in (0.0, 0.1):
        config = MetaWorldConfig(task=TASK, shift=ShiftConfig(camera=(0.0, move, 0.0)))
        environment = MetaWorld(config)
        environment.reset(5, TASK)
        frames.append(environment.step_chunk(actions).observation[IMAGE].astype(int))
        states.append(environment.simulator.everything())
    np.testing.assert_array_equal(*states)
    assert np.abs(frames[1] - frames[0]).mean() > 3
    assert config.nominal() == MetaWorldConfig(task=TASK), "demonstrations show the world without shift"
