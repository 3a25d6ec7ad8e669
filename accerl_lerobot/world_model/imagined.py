# SPDX-License-Identifier: Apache-2.0
"""Imagined worlds: their files, and the environments that the rollout runner steps as it steps a simulator.

An imagined episode begins at the first observation of a real one. Each chunk is one prediction of the world
model. The episode ends with the success model's first success, or at the time limit.

world_model/
  config.json          spec, config of the model, tasks and keys of its episodes, checks that it failed
  model.safetensors    weights and statistics of both models

Shapes: V cameras, H×W pixels, S robot state dims, K env steps of a chunk, A action dims.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import draccus
import numpy as np
import torch
from safetensors.torch import save_file
from torch import nn

from accerl_lerobot.checkpoint.safety import FileSource, read_json, read_tensors, safe_join
from accerl_lerobot.checkpoint.tensors import copied
from accerl_lerobot.config.parsing import DISCOVER, discover, imported
from accerl_lerobot.demos.record import make_expert
from accerl_lerobot.envs import make_environment
from accerl_lerobot.envs.base import ChunkResult, Environment, EnvironmentSpec, checked_actions
from accerl_lerobot.errors import InputError, expanded
from accerl_lerobot.experience import IMAGINED, TASK, Observation, task_codes
from accerl_lerobot.policies.config import executed_rows
from accerl_lerobot.policies.features import STATE
from accerl_lerobot.policies.untrusted import refusing
from accerl_lerobot.rollout.runner import FirstObservations, start_of
from accerl_lerobot.seeds import noise_seed, torch_seeded
from accerl_lerobot.world_model.config import ImaginationConfig, LearnableModelConfig
from accerl_lerobot.world_model.contract import (
    Episode,
    LearnableWorldModel,
    Prediction,
    State,
    WindowStart,
    WorldModelSpec,
    check_dataset,
    cut_windows,
    model_arrays,
    resize,
    spec_of,
)
from accerl_lerobot.world_model.pixels import SuccessModel

if TYPE_CHECKING:
    from accerl_lerobot.engines.config import RunConfig

logger = logging.getLogger(__name__)

CONFIG = "config.json"
WEIGHTS = "model.safetensors"


class World(nn.Module):
    """World model and success model, which all imagined environments of a process share."""

    def __init__(
        self,
        model: LearnableWorldModel,
        tasks: Sequence[str] = (),
        learnt: Sequence[str] = (),
        failed_checks: Sequence[str] = (),
    ) -> None:
        super().__init__()
        self.model = model
        self.success = SuccessModel(len(model.spec.cameras))
        self.version = 0  # gradient steps that they have made in the run
        self.tasks = list(tasks)  # instructions of the episodes it was trained on
        self.learnt = list(learnt)  # keys of these episodes
        self.failed_checks = list(failed_checks)

    @property
    def device(self) -> torch.device:
        return self.success.threshold.device

    def begin(self, frames: np.ndarray, robot: np.ndarray, task: str) -> State:
        """The model's state at the start of an episode, uint8 (V, H, W, 3) and float32 (S,)."""
        start = Episode(
            frames=frames[None],
            times=np.zeros(1, np.int64),
            state=robot[None],
            actions=np.zeros((1, self.model.spec.action_dim), np.float32),
            success=False,
            task=task,
        )
        context = cut_windows([WindowStart(start, 0)], self.model.spec).context
        return self.model.begin(context, [task])

    @torch.no_grad()
    def step(self, state: State, actions: np.ndarray) -> Prediction:
        """Predicts one chunk of actions, float32 (K, A)."""
        return self.model.step(state, torch.from_numpy(actions[None]))

    def succeeds(self, frames: np.ndarray, task: str) -> bool:
        """True if the frames, uint8 (V, H, W, 3), show the task achieved."""
        codes = torch.from_numpy(task_codes([task]))
        [probability] = self.success.probabilities(torch.from_numpy(frames[None]), codes)
        return bool(probability > self.success.threshold)

    def load(self, version: int, weights: dict[str, Any]) -> None:
        """Take over the weights of another world, between two chunks; episodes under way go on."""
        self.load_state_dict(weights)
        self.version = version


def new_world(spec: WorldModelSpec, config: LearnableModelConfig, **content: Sequence[str]) -> World:
    """An untrained world, with a model of the class that `config` names."""
    return World(imported(config.make)(spec, config), **content)


def save_world(directory: Path, world: World) -> None:
    """Writes a new folder."""
    directory.mkdir(parents=True)
    content = {
        "spec": asdict(world.model.spec),
        "model": draccus.encode(world.model.config, LearnableModelConfig),
        "tasks": world.tasks,
        "learnt": world.learnt,
        "failed_checks": world.failed_checks,
    }
    (directory / CONFIG).write_text(json.dumps(content, indent=2) + "\n")
    weights = {name: tensor.contiguous() for name, tensor in copied(world).items()}
    save_file(weights, directory / WEIGHTS)


def load_world(directory: Path, package: str | None = None, *, section: str = "") -> World:
    """Reads what `save_world` wrote, on the CPU and in eval mode.

    `package` registers the model's type, where that is not one of ours; errors name the config `section`.
    """
    prefix = f"{section}." if section else ""
    origin = FileSource(f"{prefix}path", str(directory))
    discover(package, section)
    content = read_json(safe_join(directory, CONFIG, origin), origin)
    weights = safe_join(directory, WEIGHTS, origin)
    what = "not a world model of accerl world-model; if its type is of another package, name that: "
    with refusing(origin, f"{what}{prefix}{DISCOVER}"):
        spec = draccus.decode(WorldModelSpec, content.pop("spec"))
        config = draccus.decode(LearnableModelConfig, content.pop("model"))
        world = new_world(spec, config, **content)
        world.load_state_dict(dict(read_tensors(weights, origin)))
    return world.requires_grad_(False).eval()


class ImaginedEnvironment(Environment):
    """An environment of a world model's predictions, with the real environment's spec.

    Args:
        first: tasks and first observations of real episodes.
    """

    source = IMAGINED

    def __init__(self, world: World, spec: EnvironmentSpec, first: FirstObservations) -> None:
        self.spec = spec
        self._world = world
        self._first = first
        self._task = ""
        self._seed = 0
        self._steps = 0
        self._state: State = {}

    def reset(self, seed: int, task: str) -> Observation:
        _, first = start_of(self._first, seed)
        arrays = {name: np.asarray(value)[None] for name, value in first.items() if name != TASK}
        [frames], [robot] = model_arrays(arrays, self._world.model.spec)
        self._task = str(first[TASK])
        self._seed = seed
        self._steps = 0
        self._state = self._world.begin(frames, robot, self._task)
        return self._observation(frames, robot)

    def step_chunk(self, actions: np.ndarray) -> ChunkResult:
        actions = checked_actions(actions, self.spec)
        # Equal episodes in any process, although a model may draw from the global generator.
        with torch_seeded(noise_seed(self._seed, self._steps), ()):
            prediction = self._world.step(self._state, actions)
        self._state = prediction.state
        frames = prediction.frames[0].numpy()
        success = self._world.succeeds(frames, self._task)
        self._steps += len(actions)
        rewards = np.zeros(len(actions), np.float32)
        rewards[-1] = float(success)
        return ChunkResult(
            observation=self._observation(frames, prediction.robot[0].numpy()),
            rewards=rewards,
            terminated=success,
            truncated=not success and self._steps >= self.spec.max_steps,
            success=success,
        )

    def render(self, height: int, width: int) -> np.ndarray:
        raise NotImplementedError("imagined episodes are not filmed")

    def state(self) -> Any:
        return {name: getattr(self, name) for name in ("_task", "_seed", "_steps", "_state")}

    def restore(self, state: Any) -> None:
        vars(self).update(state)

    def _observation(self, frames: np.ndarray, robot: np.ndarray) -> Observation:
        """Observation of frames uint8 (V, H, W, 3), in the sizes of the real environment."""
        observation: Observation = {TASK: self._task}
        for frame, (camera, shape) in zip(frames, self.spec.images.items(), strict=True):
            observation[camera] = resize(frame[None], shape[:2])[0]
        if self.spec.state_dim:
            observation[STATE] = robot
        return observation


def world_of(config: ImaginationConfig) -> World:
    """The world that ``imagination.path`` has."""
    path = expanded(str(config.path), "imagination.path")
    return load_world(path, config.discover_packages_path, section="imagination")


def imagined_environments(
    config: ImaginationConfig, count: int, spec: EnvironmentSpec, first: FirstObservations
) -> tuple[World, list[Environment]]:
    """The world of a run, and so many environments in it; `spec` is the real environment's."""
    world = world_of(config)
    return world, [ImaginedEnvironment(world, spec, first) for _ in range(count)]


@contextmanager
def about_learning() -> Iterator[None]:
    """Puts ``imagination.learn`` into errors about that dataset."""
    try:
        yield
    except InputError as error:
        raise InputError(f"imagination.learn.{error.field}", error.value, error.hint) from error


def check_imagination(config: RunConfig) -> None:
    """Refuses, before a run begins, what imagined episodes cannot have, and a world model that does not fit.

    It warns of a world model that has failed a check.
    """
    from accerl_lerobot.run.preflight import policy_to_be

    policy = policy_to_be(config)
    executed = executed_rows(policy)
    imagination = config.imagination
    reward = getattr(config.env, "reward", "success")
    if reward != "success":
        hint = (
            "use success with imagination.environments: imagined episodes end with a success, and pay for it"
        )
        raise InputError("env.reward", reward, hint)
    if config.env.tells_state:
        hint = "no policy reads it, and nothing imagined has it; leave it out, or imagination.environments"
        raise InputError("env.environment_state", getattr(config.env, "environment_state", None), hint)
    if policy.n_obs_steps > 1:
        hint = (
            "the policy looks back so many env steps, and only one frame per decision is imagined; use a "
            "policy with 1, or no imagination"
        )
        raise InputError("policy.n_obs_steps", policy.n_obs_steps, hint)
    with closing(make_environment(config.env)) as environment:
        spec = environment.spec
        if imagination.path is None:
            for task in spec.tasks[: imagination.expert_episodes]:
                make_expert(config.env, environment, task)
    if imagination.path is not None:
        _check_world(imagination, spec, executed)
    decisions = -(-spec.max_steps // executed)
    if imagination.learns and config.rollout.segment_length < decisions:
        hint = f"use {decisions} or more: the world model learns from segments that are whole episodes"
        raise InputError("rollout.segment_length", config.rollout.segment_length, hint)


def _check_world(config: ImaginationConfig, environment: EnvironmentSpec, executed: int) -> None:
    """Refuses a world model that does not fit environment and policy, which executes so many actions per
    decision, or that could not go on learning."""
    field = "imagination.path"
    world = world_of(config)
    needed = spec_of(environment, 0, executed)
    for name in ("cameras", "state_dim", "action_dim", "fps", "chunk"):
        modelled = getattr(world.model.spec, name)
        real = getattr(needed, name)
        if modelled != real:
            hint = f"is the world model's {name}, and this run's is {real}; train one for this run"
            raise InputError(field, modelled, hint)
    for text in environment.instructions:
        if text not in world.tasks:
            hint = f"the world model was trained on {world.tasks!r}; train one for this run"
            raise InputError(field, text, hint)
    if config.learns and config.learn.dataset.repo_id is not None:
        with about_learning():
            check_dataset(config.learn.dataset, world.model.spec)
    if world.failed_checks:
        failed = ", ".join(world.failed_checks)
        text = "the world model of imagination.path=%s failed checks (%s); train it on more episodes"
        logger.warning(text, config.path, failed)
