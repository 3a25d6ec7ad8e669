# SPDX-License-Identifier: Apache-2.0
"""Imagined environments: a learned world model that the rollout runner steps as it steps a simulator.

An imagined episode begins at the first observation of a real one. Each chunk is one prediction of the world
model. The episode ends with the success model's first success, at the time limit, or as a failure where the
world model is too uncertain, which is the pessimism of MOReL (arXiv 2005.05951).

Shapes: V cameras, H×W pixels, S robot state dims, K env steps of a chunk, A action dims.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import nn

from accerl_lerobot.envs import make_environment
from accerl_lerobot.envs.base import ChunkResult, Environment, EnvironmentSpec, checked_actions
from accerl_lerobot.errors import InputError, expanded
from accerl_lerobot.experience import IMAGINED, TASK, Observation, task_codes
from accerl_lerobot.world_model.config import IMAGINATION, ImaginationConfig
from accerl_lerobot.world_model.contract import (
    Context,
    LearnableWorldModel,
    Prediction,
    State,
    WorldModelSpec,
)
from accerl_lerobot.world_model.data import model_arrays, open_datasets, resize
from accerl_lerobot.world_model.store import check_predicts, load_failed, load_world_model
from accerl_lerobot.world_model.success_model import SuccessPairsRewardModel

if TYPE_CHECKING:
    from accerl_lerobot.engines.config import RunConfig

logger = logging.getLogger(__name__)

LEARN = "imagination.learn.dataset"
MAX_UNCERTAINTY = 2.0
"""Uncertainty above which an episode ends before a prediction; 1 is training data's 95th percentile."""


class ImaginedWorld(nn.Module):
    """World model and success model, which all imagined environments of a process share."""

    def __init__(self, model: LearnableWorldModel, success: SuccessPairsRewardModel) -> None:
        super().__init__()
        self.model, self.success = model, success
        self.version = 0  # gradient steps that they have made in the run

    def begin(self, frames: np.ndarray, robot: np.ndarray, task: str) -> State:
        """The model's state at the start of an episode, uint8 (V, H, W, 3) and float32 (S,)."""
        spec = self.model.spec
        images, numbers = torch.from_numpy(frames[None]), torch.from_numpy(robot[None])
        # Nothing has moved before the start, and no action was executed.
        context = Context(
            frames=images[:, None].repeat(1, spec.context, 1, 1, 1, 1),
            robot=numbers[:, None].repeat(1, spec.context, 1),
            actions=torch.zeros(1, spec.context - 1, spec.chunk, spec.action_dim),
            commanded_sum=torch.zeros(1, spec.action_dim),
            initial_state=numbers,
        )
        return self.model.begin(context, [task])

    @torch.no_grad()
    def step(self, state: State, actions: np.ndarray, seed: int) -> Prediction:
        """Predict one chunk of actions, float32 (K, A)."""
        return self.model.step(state, torch.from_numpy(actions[None]), [seed])

    def succeeds(self, before: np.ndarray, after: np.ndarray, task: str) -> float:
        """P(success) after a chunk, of the frames before and after it, uint8 (V, H, W, 3)."""
        return float(self.success.probabilities(before[None], after[None], task_codes([task]))[0])

    def load(self, version: int, weights: dict[str, Any]) -> None:
        """Take over the weights of another world, between two chunks; episodes under way go on."""
        self.load_state_dict(weights)
        self.version = version


class ImaginedEnvironment(Environment):
    """An environment of a world model's predictions, with the real environment's spec.

    Args:
        starts: tasks and first observations of real episodes; `reset` takes one of them by its seed.
    """

    source = IMAGINED

    def __init__(
        self, world: ImaginedWorld, spec: EnvironmentSpec, starts: Sequence[tuple[str, Observation]]
    ) -> None:
        self.spec, self._world, self._starts = spec, world, starts
        self._task = ""
        self._seed = self._steps = 0
        self._done = True
        self._frames = np.zeros((0, 0, 0, 3), np.uint8)
        self._robot = np.zeros(0, np.float32)
        self._state: State = {}

    def reset(self, seed: int, task: str) -> Observation:
        _, first = self._starts[seed % len(self._starts)]
        arrays = {name: np.asarray(value)[None] for name, value in first.items() if name != TASK}
        frames, robot = model_arrays(arrays, self._world.model.spec)
        self._task, self._seed, self._steps, self._done = str(first[TASK]), seed, 0, False
        self._frames, self._robot = frames[0], robot[0]
        self._state = self._world.begin(frames[0], robot[0], self._task)
        return self._observation(robot[0])

    def step_chunk(self, actions: np.ndarray) -> ChunkResult:
        if self._done:
            raise RuntimeError("the episode is over: call reset before step_chunk")
        actions = checked_actions(actions, self.spec)
        seed = int(np.random.default_rng((self._seed, self._steps)).integers(2**31))
        prediction = self._world.step(self._state, actions, seed)
        frames, robot = prediction.frames[0].cpu().numpy(), prediction.robot[0].cpu().numpy()
        probability = self._world.succeeds(self._frames, frames, self._task)
        uncertain = float(prediction.uncertainty[0]) > MAX_UNCERTAINTY  # NaN: the model has none
        if not (np.isfinite(robot).all() and math.isfinite(probability)):
            uncertain, frames, robot = True, self._frames, self._robot  # the model has diverged
        success = not uncertain and probability > self._world.success.config.threshold
        self._state, self._frames, self._robot = prediction.state, frames, robot
        self._steps += len(actions)
        late = self._steps >= self.spec.max_steps
        self._done = success or uncertain or late
        rewards = np.zeros(len(actions), np.float32)
        rewards[-1] = float(success)
        return ChunkResult(
            observation=self._observation(robot),
            rewards=rewards,
            terminated=success,
            truncated=self._done and not success,
            success=success,
            info={"uncertain": float(uncertain)},
        )

    def render(self, height: int, width: int) -> np.ndarray:
        return resize(self._frames[:1], (height, width))[0]

    def state(self) -> Any:
        names = ("_task", "_seed", "_steps", "_done", "_frames", "_robot", "_state")
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


def load_world(config: ImaginationConfig) -> ImaginedWorld:
    """The world that ``imagination.path`` has, on the CPU."""
    path = expanded(str(config.path), f"{IMAGINATION}.path")
    return ImaginedWorld(*load_world_model(path, config.discover_packages_path, section=IMAGINATION))


def imagined_environments(
    config: ImaginationConfig, count: int, spec: EnvironmentSpec, starts: Sequence[tuple[str, Observation]]
) -> tuple[ImaginedWorld, list[Environment]]:
    """The world of a run, and so many environments in it; `spec` is the real environment's."""
    world = load_world(config)
    return world, [ImaginedEnvironment(world, spec, starts) for _ in range(count)]


def check_imagination(config: RunConfig) -> None:
    """Refuses, before a run begins, a world model that does not fit environment and policy.

    It warns of one that is used as it is and has failed its validation.
    """
    from accerl_lerobot.run.preflight import policy_to_be

    policy, imagination = policy_to_be(config), config.imagination
    if (reward := getattr(config.env, "reward", "success")) != "success":
        hint = (
            "use success with imagination.environments: imagined episodes end with a success, and pay for it"
        )
        raise InputError("env.reward", reward, hint)
    if config.env.state_size:
        hint = "no policy reads it, and nothing imagined has it; leave it out, or imagination.environments"
        raise InputError("env.environment_state", getattr(config.env, "environment_state", None), hint)
    if policy.n_obs_steps > 1:
        hint = "the policy looks back so many env steps, and only one frame per decision is imagined; use a"
        raise InputError("policy.n_obs_steps", policy.n_obs_steps, f"{hint} policy with 1, or no imagination")
    with closing(make_environment(config.env)) as environment:
        spec = environment.spec
    path = expanded(str(imagination.path), f"{IMAGINATION}.path")
    world = load_world(imagination)
    check_predicts(path, world.model, world.success, section=IMAGINATION)
    check_fit(world.model.spec, spec, getattr(policy, "n_action_steps", 1))
    if imagination.learns:
        open_datasets({LEARN: imagination.learn.dataset}, world.model.spec)
    _warn_of_failed(path)


def _warn_of_failed(path: Path) -> None:
    failed = load_failed(path, IMAGINATION)
    if failed == []:
        return
    why = "was never validated" if failed is None else f"failed its validation ({', '.join(failed)[:200]})"
    logger.warning(
        "the world model of imagination.path=%s %s and is used all the same; train it longer or on more "
        "episodes",
        path, why,
    )  # fmt: skip


def check_fit(spec: WorldModelSpec, environment: EnvironmentSpec, executed: int) -> None:
    """Refuses a world model that does not fit environment and policy, which executes so many actions per
    decision."""
    field, again = f"{IMAGINATION}.path", "train one of this environment"
    if missing := [camera for camera in environment.images if camera not in spec.cameras]:
        hint = f"the environment shows this camera, the world model {spec.cameras!r}; {again}"
        raise InputError(field, missing[0], hint)
    for name in ("state_dim", "action_dim", "fps"):
        modelled, real = getattr(spec, name), getattr(environment, name)
        if modelled != real:
            hint = f"is the world model's {name}, and the environment's is {real}; {again}"
            raise InputError(field, modelled, hint)
    if spec.tasks and (others := [task for task in environment.tasks if not _is_of(task, spec.tasks)]):
        hint = f"the world model is of {spec.tasks!r}; name these, or train one of it"
        raise InputError("env.task", others[0], hint)
    if spec.chunk != executed:
        hint = f"env steps per prediction, and the policy executes {executed} actions per decision"
        raise InputError(field, spec.chunk, f"{hint}; train one with world_model.chunk={executed}")


def _is_of(task: str, known: Sequence[str]) -> bool:
    """True if the task is known. A task of a suite that is played alone may have the suite's name only."""
    suite, _, number = task.partition("/")
    return task in known or suite in known or (not number and any(k.startswith(f"{suite}/") for k in known))
