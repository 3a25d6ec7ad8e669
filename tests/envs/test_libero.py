# SPDX-License-Identifier: Apache-2.0
"""LIBERO: LeRobot's environment, physics and pictures; coarser meshes that look the same."""

import contextlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lerobot.envs.configs import LiberoEnv
from lerobot.envs.factory import make_env
from lerobot.envs.utils import preprocess_observation
from lerobot.processor.env_processor import LiberoProcessorStep

from accerl_lerobot.config.parsing import decode, encode
from accerl_lerobot.envs import LiberoConfig, libero, libero_simulator, make_environment
from accerl_lerobot.envs.graphics import import_mujoco
from accerl_lerobot.envs.libero import bddl_file, instruction, recorded_states
from accerl_lerobot.envs.libero_simulator import LiberoEnvironment, Simulator
from accerl_lerobot.errors import InputError
from accerl_lerobot.seeds import EVAL_SEEDS, eval_seed, train_seed
from tests.envs.libero_assets import ASSETS, needs_assets

pytest.importorskip("libero")
import_mujoco()  # before robosuite, which loads MuJoCo without an offscreen OpenGL
SIZE = 128
IMAGE, WRIST = "observation.images.image", "observation.images.image2"


def some_actions(count: int, seed: int = 0) -> np.ndarray:
    """Downwards with noise, the fingers opening and closing, some without a turn; float32 (count, 7)."""
    rng = np.random.default_rng(seed)
    closing = (-1.0) ** (np.arange(count) // 15)
    actions = rng.normal(0, 0.5, (count, 7)) + np.array([0, 0, -0.3, 0, 0, 0, 0])
    actions[:, 6] += closing
    actions[3::10, 3:6] = 0
    return np.clip(actions, -1, 1).astype(np.float32)


def test_names_and_texts_are_liberos_own():
    numbers = [int(task[-1]) for task in LiberoConfig(task="libero_goal/2, libero_goal").tasks]
    assert numbers == [2, 0, 1, *range(3, 10)]
    assert len(LiberoConfig(task="libero_90").tasks) == 90
    limits = {"libero_object": 280, "libero_goal/3": 300, "libero_spatial,libero_10/0": 520}
    assert {task: LiberoConfig(task=task).time_limit for task in limits} == limits
    assert LiberoConfig(task="libero_10", max_steps=99).time_limit == 99
    written = encode(LiberoConfig(task="libero_object"))
    assert decode(LiberoConfig, written | {"task": "libero_10"}).time_limit == 520, "not that of former tasks"
    assert instruction("libero_object/3") == "pick up the bbq sauce and place it in the basket"
    assert instruction("libero_10/2") == "turn on the stove and put the moka pot on it"
    assert bddl_file("libero_90/0").is_file()


def test_recorded_starts_are_read_without_unpickling():
    import torch

    file = bddl_file("libero_object/4")
    starts = file.parents[2] / "init_files" / file.parent.name / f"{file.stem}.pruned_init"
    theirs = torch.load(starts, weights_only=False)
    assert len(theirs) == 50 and np.array_equal(recorded_states("libero_object/4"), theirs.ravel())


def test_what_is_said_where_meshes_are_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(InputError, match="env.assets='nowhere': no folder of LIBERO's assets"):
        libero.assets_folder("nowhere")
    monkeypatch.setattr(libero, "package", lambda: tmp_path)  # which has no assets/
    with pytest.raises(InputError, match=r"the Hub did not give them .*; hf download lerobot/libero-assets"):
        libero.assets_folder("")  # tests are offline


def test_torques_against_the_definition():
    """Operational space control with pseudo-inverses and the null space's projector, term by term."""
    rng = np.random.default_rng(1)
    full = rng.normal(size=(9, 9))
    full = full @ full.T + 9 * np.eye(9)
    arm = libero_simulator.Arm(
        jacobian=rng.normal(size=(2, 3, 9)), mass=full, bias=rng.normal(size=9), qpos=rng.normal(size=9),
        qvel=rng.normal(size=9), position=rng.normal(size=3),
        rotation=np.linalg.qr(rng.normal(size=(3, 3)))[0],
    )  # fmt: skip
    turned = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    gains = np.stack([np.full(6, 150.0), np.full(6, 24.5)])
    aim = libero_simulator.Aim(rng.normal(size=3), turned, rng.normal(size=7), gains)

    mass, j = full[:7, :7], arm.jacobian.reshape(6, 9)[:, :7]
    velocity = arm.jacobian.reshape(6, 9) @ arm.qvel - arm.jacobian.reshape(6, 9)[:, 7:] @ arm.qvel[7:]
    turn = sum(np.cross(arm.rotation[:, k], turned[:, k]) for k in range(3)) / 2
    wanted = 150 * np.concatenate([aim.position - arm.position, turn]) - 24.5 * velocity
    inverse = np.linalg.inv(mass)
    hand = np.linalg.pinv(j @ inverse @ j.T)
    linear, angular = (np.linalg.pinv(part @ inverse @ part.T) for part in (j[:3], j[3:]))
    null = np.eye(7) - inverse @ j.T @ hand @ j
    pose = mass @ (10 * (aim.rest - arm.qpos[:7]) - 2 * np.sqrt(10) * arm.qvel[:7])
    wrench = np.concatenate([linear @ wanted[:3], angular @ wanted[3:]])
    expected = j.T @ wrench + arm.bias[:7] + null.T @ pose
    assert np.allclose(libero_simulator.operational_space_torques(arm, aim), expected, rtol=1e-9, atol=1e-9)


def test_a_coarser_mesh_keeps_its_shape_and_its_picture():
    """A sheet of 60 × 60 squares, folded upwards at x = 0.5, whose texture is its own plane."""
    side = np.linspace(0, 1, 61)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side, indexing="ij"))
    vertices = np.stack([x, y, np.maximum(0, x - 0.5)], 1)
    corner = (np.arange(60)[:, None] * 61 + np.arange(60)).ravel()
    squares = np.stack([corner, corner + 61, corner + 62, corner + 1], 1)
    faces = np.concatenate([squares[:, [0, 1, 2]], squares[:, [0, 2, 3]]])
    kept, merged = libero_simulator.coarser(vertices, faces)
    assert 600 < len(kept) <= 2000 and len(merged) == len(kept)
    a, b, c = (vertices[merged[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    assert area == pytest.approx(0.5 + 0.5 * np.sqrt(2), rel=0.1)
    places = np.stack([x, y], 1)[faces[kept]]
    now = libero_simulator.moved_texture(vertices[faces[kept]], vertices[merged], places)
    away = np.abs(now - np.stack([x, y], 1)[merged]).max(axis=(1, 2))
    assert np.quantile(away, 0.9) < 1e-6, "on a plane each corner takes its place along"


@needs_assets
@pytest.mark.parametrize(
    ("task", "opening"),
    [
        ("libero_goal/5", ()),  # a region of the table: push the plate to the front of the stove
        pytest.param("libero_10/3", ("white_cabinet_1_bottom_level",), marks=pytest.mark.slow),
    ],
)
def test_state_has_all_that_a_task_is_about(task: str, opening: tuple[str, ...]):
    config = LiberoConfig(task=task, image_size=64, rendering="fast", assets=ASSETS, environment_state=True)
    with contextlib.closing(make_environment(config)) as environment:
        state = environment.reset(eval_seed(0, 0), task)["observation.environment_state"]
        simulator = environment.simulator
        where = np.concatenate([simulator.position(name) for name in simulator.env.obj_of_interest])
        way = where[:3] - simulator.hand[0]
        joints = [simulator.data.joint(name).qpos[0] for name in opening]
        assert state.shape == (environment.spec.environment_state_dim,) and state[-1] == 0
    for number in (*where, *way, *joints):
        assert np.abs(state - number).min() < 1e-6


RECORDED, DRAWN = eval_seed(0, 7), train_seed(0, 0, 7)
SLOW = [
    # LIBERO draws the opening of spatial/4's drawer once more for each reset that it has made before.
    ("libero_spatial/4", RECORDED, "stock"), ("libero_goal/3", DRAWN, "stock"),
    ("libero_10/2", DRAWN, "stock"), ("libero_90/20", RECORDED, "stock"),
    ("libero_goal/8", RECORDED, "fast"),
]  # fmt: skip
# There are 50 recorded starts.
QUICK = [("libero_object/0", eval_seed(0, 57), "stock"), ("libero_object/0", DRAWN, "fast")]


@needs_assets
@pytest.mark.parametrize(
    ("task", "seed", "rendering"), [*QUICK, *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW)]
)
def test_physics_are_liberos(task: str, seed: int, rendering: Any):
    simulator = Simulator(task, rendering, ASSETS)
    simulator.reset(eval_seed(0, 3))  # of which nothing may be left
    simulator.step(some_actions(1)[0])
    simulator.reset(seed)
    from libero.libero.envs.env_wrapper import ControlEnv

    stock = ControlEnv(str(bddl_file(task)), use_camera_obs=False, has_offscreen_renderer=False)
    stock.reset()
    stock.seed(seed)
    stock.reset()
    if seed in EVAL_SEEDS:
        stock.set_init_state(recorded_states(task).reshape(50, -1)[(seed - EVAL_SEEDS.start) % 50])
    for _ in range(10):
        stock.step([0, 0, 0, 0, 0, 0, -1])
    theirs, ours = stock.env.sim.data, simulator.data
    for action in (None, *some_actions(40)):
        if action is not None:
            stock.step(action)
            assert simulator.step(action)[0] == stock.check_success()
        assert np.abs(theirs.qpos - ours.qpos).max() < 1e-9
        assert np.abs(theirs.qvel - ours.qvel).max() < 1e-6
    stock.close()
    simulator.close()


@needs_assets
@pytest.mark.slow
@pytest.mark.parametrize("task", ["libero_object/1", "libero_goal/2", "libero_90/20"])
def test_observations_are_lerobots(task: str):
    """LeRobot's environment and processor first: once ours has an OpenGL context, theirs draws into it."""
    Simulator(task, "stock", ASSETS).close()  # sets the folder of assets
    suite, number = task.split("/")
    size = {"observation_width": SIZE, "observation_height": SIZE}
    vector = make_env(LiberoEnv(task=suite, task_ids=[int(number)], **size))[suite][int(number)]
    stock = vector.envs[0].unwrapped
    stock.init_state_id = 7

    def seen(raw: dict) -> dict[str, np.ndarray]:
        batch = LiberoProcessorStep().observation(preprocess_observation(raw))
        pictures = {k: (batch[k][0].permute(1, 2, 0) * 255).round().byte().numpy() for k in (IMAGE, WRIST)}
        return pictures | {"observation.state": batch["observation.state"][0].numpy()}

    theirs = [seen(vector.reset(seed=[eval_seed(0, 7)])[0])]
    theirs += [seen(vector.step(action[None])[0]) for action in some_actions(12)]
    vector.close()
    environment = LiberoEnvironment(LiberoConfig(task=task, image_size=SIZE, assets=ASSETS))
    ours = [environment.reset(eval_seed(0, 7), task)]
    ours += [environment.step_chunk(action[None]).observation for action in some_actions(12)]
    for their, our in zip(theirs, ours, strict=True):
        assert np.array_equal(their[IMAGE], our[IMAGE]) and np.array_equal(their[WRIST], our[WRIST])
        assert np.abs(their["observation.state"] - our["observation.state"]).max() < 1e-6
        assert our["task"] == stock.task_description
    environment.close()
