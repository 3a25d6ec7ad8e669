# SPDX-License-Identifier: Apache-2.0
"""Imagined worlds: their files, and the environments that the rollout runner steps as it steps a simulator.

An imagined episode begins at the first observation of a real one. Each chunk is one prediction of the world
model. The episode ends with the success model's first success, or at the time limit.

world_model/
  config.json          spec, config of the model, keys of the episodes it was trained on, checks it failed
  model.safetensors    weights and statistics of both models

Shapes: V cameras, H×W pixels, S robot state dims, K env steps of a chunk, A action dims.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Collection
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import draccus
import numpy as np
import torch
from safetensors.torch import save_file
from torch import nn

from accerl_lerobot.checkpoint.safety import FileSource, read_json, read_tensors, safe_join
from accerl_lerobot.config.parsing import DISCOVER, discover
from accerl_lerobot.demos.record import make_expert
from accerl_lerobot.envs import make_environment
from accerl_lerobot.envs.base import ChunkResult, Environment, EnvironmentSpec, checked_actions
from accerl_lerobot.errors import InputError, expanded, in_one_line, input_error
from accerl_lerobot.experience import IMAGINED, TASK, Observation, task_codes
from accerl_lerobot.policies.config import executed_rows
from accerl_lerobot.policies.untrusted import Unfilled
from accerl_lerobot.rollout.runner import Starts, start_of
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
    new_model,
    resize,
)
from accerl_lerobot.world_model.pixels import SuccessModel

if TYPE_CHECKING:
    from accerl_lerobot.engines.config import RunConfig

logger = logging.getLogger(__name__)

CONFIG = "config.json"
WEIGHTS = "model.safetensors"
LEARN = "imagination.learn.dataset"


class World(nn.Module):
    """World model and success model, which all imagined environments of a process share."""

    def __init__(self, model: LearnableWorldModel) -> None:
        super().__init__()
        self.model = model
        self.success = SuccessModel()
        self.version = 0  # gradient steps that they have made in the run

    def begin(self, frames: np.ndarray, robot: np.ndarray, task: str) -> State:
        """The model's state at the start of an episode, uint8 (V, H, W, 3) and float32 (S,)."""
        start = Episode(
            frames=frames[None],
            times=np.zeros(1, np.int64),
            state=robot[None],
            actions=np.zeros((0, self.model.spec.action_dim), np.float32),
            success_at=-1,
            task=task,
        )
        context = cut_windows([start], [WindowStart(0, 0)], self.model.spec, chunks=0).context
        return self.model.begin(context, [task])

    @torch.no_grad()
    def step(self, state: State, actions: np.ndarray, seed: int) -> Prediction:
        """Predicts one chunk of actions, float32 (K, A)."""
        return self.model.step(state, torch.from_numpy(actions[None]), [seed])

    def succeeds(self, frames: np.ndarray, task: str) -> bool:
        """True if the frames, uint8 (V, H, W, 3), show the task achieved."""
        codes = torch.from_numpy(task_codes([task]))
        batch = torch.from_numpy(frames[None])
        [probability] = self.success.probabilities(batch, codes)
        return bool(probability > self.success.threshold)

    def load(self, version: int, weights: dict[str, Any]) -> None:
        """Take over the weights of another world, between two chunks; episodes under way go on."""
        self.load_state_dict(weights)
        self.version = version


def save_world(
    directory: Path, world: World, learnt: Collection[str] = (), failed_checks: Collection[str] | None = None
) -> None:
    """Writes a new folder. `learnt` are keys of episodes; `failed_checks` None: it has not been checked."""
    directory.mkdir(parents=True)
    if failed_checks is not None:
        failed_checks = list(failed_checks)
    content = {
        "spec": asdict(world.model.spec),
        "model": draccus.encode(world.model.config, LearnableModelConfig),
        "learnt": sorted(learnt),
        "failed_checks": failed_checks,
    }
    (directory / CONFIG).write_text(json.dumps(content, indent=2) + "\n")
    # Copies, as safetensors refuses tensors that share memory.
    weights = {k: v.clone(memory_format=torch.contiguous_format) for k, v in world.state_dict().items()}
    save_file(weights, directory / WEIGHTS)


def read_content(directory: Path, section: str = "") -> dict[str, Any]:
    """The config file that `save_world` wrote; errors name the config `section`."""
    origin = _origin(directory, section)
    content = read_json(safe_join(directory, CONFIG, origin), origin)
    for name in ("learnt", "failed_checks"):
        if not isinstance(content.get(name) or [], list):
            raise origin.refuse(f"{CONFIG}: {name}", "not one of accerl world-model")
    return content


def load_world(directory: Path, package: str | None = None, *, section: str = "") -> World:
    """Reads what `save_world` wrote, on the CPU and in eval mode.

    `package` registers the model's type, where that is not one of ours; errors name the config `section`.
    """
    origin = _origin(directory, section)
    discover(package, section)
    content = read_content(directory, section)
    weights = safe_join(directory, WEIGHTS, origin)
    try:
        spec = draccus.decode(WorldModelSpec, content.get("spec"))
        config = draccus.decode(LearnableModelConfig, content.get("model"))
        with Unfilled():
            world = World(new_model(spec, config))
        world.load_state_dict(dict(read_tensors(weights, origin)))
    except Exception as error:  # the files may hold anything
        refusal = input_error(error)  # draccus wraps what a config refuses
        if refusal is not None and refusal.field == origin.field:
            raise refusal from error
        if refusal is not None:
            raise origin.refuse(CONFIG, str(refusal)) from error
        package = origin.field.removesuffix("path") + DISCOVER
        hint = f"not a world model of accerl world-model ({in_one_line(error)}); "
        hint += f"if its type is of another package, name that: {package}"
        raise InputError(origin.field, origin.value, hint) from error
    return world.requires_grad_(False).eval()


def _origin(directory: Path, section: str) -> FileSource:
    field = f"{section}.path" if section else "path"
    return FileSource(field, str(directory))


class ImaginedEnvironment(Environment):
    """An environment of a world model's predictions, with the real environment's spec.

    Args:
        starts: tasks and first observations of real episodes.
    """

    source = IMAGINED

    def __init__(self, world: World, spec: EnvironmentSpec, starts: Starts) -> None:
        self.spec = spec
        self._world = world
        self._starts = starts
        self._task = ""
        self._seed = 0
        self._steps = 0
        self._done = True
        self._frames = np.zeros((0, 0, 0, 3), np.uint8)
        self._state: State = {}

    def reset(self, seed: int, task: str) -> Observation:
        _, first = start_of(self._starts, seed)
        arrays = {name: np.asarray(value)[None] for name, value in first.items() if name != TASK}
        [frames], [robot] = model_arrays(arrays, self._world.model.spec)
        self._task = str(first[TASK])
        self._seed = seed
        self._steps = 0
        self._done = False
        self._frames = frames
        self._state = self._world.begin(frames, robot, self._task)
        return self._observation(robot)

    def step_chunk(self, actions: np.ndarray) -> ChunkResult:
        if self._done:
            raise RuntimeError("the episode is over: call reset before step_chunk")
        actions = checked_actions(actions, self.spec)
        seed = int(np.random.default_rng((self._seed, self._steps)).integers(2**31))
        prediction = self._world.step(self._state, actions, seed)
        self._state = prediction.state
        self._frames = prediction.frames[0].cpu().numpy()
        success = self._world.succeeds(self._frames, self._task)
        self._steps += len(actions)
        late = self._steps >= self.spec.max_steps
        self._done = success or late
        rewards = np.zeros(len(actions), np.float32)
        rewards[-1] = float(success)
        return ChunkResult(
            observation=self._observation(prediction.robot[0].cpu().numpy()),
            rewards=rewards,
            terminated=success,
            truncated=late and not success,
            success=success,
        )

    def render(self, height: int, width: int) -> np.ndarray:
        return resize(self._frames[:1], (height, width))[0]

    def state(self) -> Any:
        names = ("_task", "_seed", "_steps", "_done", "_frames", "_state")
        return {name: getattr(self, name) for name in names}

    def restore(self, state: Any) -> None:
        vars(self).update(state)

    def _observation(self, robot: np.ndarray) -> Observation:
        """Observation of the newest frames, in the sizes of the real environment."""
        observation: Observation = {TASK: self._task}
        for v, camera in enumerate(self._world.model.spec.cameras):
            if camera in self.spec.images:
                size = self.spec.images[camera][:2]
                observation[camera] = resize(self._frames[v : v + 1], size)[0]
        if self.spec.state_dim:
            observation["observation.state"] = robot.astype(np.float32)
        return observation


def world_path(config: ImaginationConfig) -> Path:
    """The folder that ``imagination.path`` names."""
    return expanded(str(config.path), "imagination.path")


def world_of(config: ImaginationConfig) -> World:
    """The world that ``imagination.path`` has."""
    return load_world(world_path(config), config.discover_packages_path, section="imagination")


def imagined_environments(
    config: ImaginationConfig, count: int, spec: EnvironmentSpec, starts: Starts
) -> tuple[World, list[Environment]]:
    """The world of a run, and so many environments in it; `spec` is the real environment's."""
    world = world_of(config)
    return world, [ImaginedEnvironment(world, spec, starts) for _ in range(count)]


def check_imagination(config: RunConfig) -> None:
    """Refuses, before a run begins, what imagined episodes cannot have, and a world model that does not fit.

    It warns of a world model that has failed a check.
    """
    from accerl_lerobot.run.preflight import policy_to_be

    policy = policy_to_be(config)
    imagination = config.imagination
    reward = getattr(config.env, "reward", "success")
    if reward != "success":
        hint = (
            "use success with imagination.environments: imagined episodes end with a success, and pay for it"
        )
        raise InputError("env.reward", reward, hint)
    if config.env.state_size:
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
            return
    world = world_of(imagination)
    _check_fit(world.model.spec, spec, executed_rows(policy))
    if imagination.learns and imagination.learn.dataset.repo_id is not None:
        check_dataset(imagination.learn.dataset, world.model.spec, LEARN)
    failed = read_content(world_path(imagination), "imagination").get("failed_checks")
    if failed == []:
        return
    why = "was never checked"
    if failed is not None:
        why = f"failed checks ({', '.join(map(str, failed))})"
    text = "the world model of imagination.path=%s %s; train it longer or on more episodes"
    logger.warning(text, imagination.path, why)


def _check_fit(spec: WorldModelSpec, environment: EnvironmentSpec, executed: int) -> None:
    """Refuses a world model that does not fit environment and policy, which executes so many actions per
    decision."""
    field = "imagination.path"
    again = "train one of this environment"
    shown = tuple(environment.images)
    for camera in sorted({*shown} ^ {*spec.cameras}):
        hint = f"the environment shows {shown!r}, the world model {spec.cameras!r}; {again}"
        raise InputError(field, camera, hint)
    for name in ("state_dim", "action_dim", "fps"):
        modelled = getattr(spec, name)
        real = getattr(environment, name)
        if modelled != real:
            hint = f"is the world model's {name}, and the environment's is {real}; {again}"
            raise InputError(field, modelled, hint)
    for text in environment.instructions:
        if spec.tasks and text not in spec.tasks:
            raise InputError(field, text, f"the world model was trained on {spec.tasks!r}; {again}")
    if spec.chunk != executed:
        hint = f"env steps per prediction, and the policy executes {executed} actions per decision"
        raise InputError(field, spec.chunk, f"{hint}; train one with world_model.chunk={executed}")
