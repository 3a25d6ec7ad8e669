# SPDX-License-Identifier: Apache-2.0
"""The world models that a run can imagine with, and the check that one fits environment and policy.

Beside the learned one there are reference models: an oracle, the best there can be, and two placebos. What a
policy gains from a copy of the last frame, or from a model that gets other actions, it does not gain from the
world model.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from accerl_lerobot.envs import EnvConfig, make_world
from accerl_lerobot.envs.base import ChunkResult, World, WorldSpec
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import TASK
from accerl_lerobot.policies.loading import resolve_device
from accerl_lerobot.world_model.config import ImaginationConfig
from accerl_lerobot.world_model.contract import (
    Context,
    LearnableWorldModel,
    Prediction,
    Reset,
    State,
    WorldModel,
    WorldModelSpec,
)
from accerl_lerobot.world_model.data import model_arrays
from accerl_lerobot.world_model.store import load_world_model, rehearse_world_model
from accerl_lerobot.world_model.success_plugin.modeling_success_pairs import SuccessPairsRewardModel

SECTION = "imagination"
SHOWN = 4
"""Tasks of a list that an error shows."""


class ImaginationModels(NamedTuple):
    """A world model, and the success model beside it, where it needs one."""

    model: WorldModel
    success: SuccessPairsRewardModel | None


def make_models(
    config: ImaginationConfig,
    env: EnvConfig,
    world: WorldSpec,
    executed: int,
    device: str,
    *,
    first: bool = False,
) -> ImaginationModels:
    """Builds the models that `config` names, of an environment and the actions executed per decision.

    If nobody has loaded the files before (`first`), a child process does so first, see `isolation`.

    Raises:
        InputError: they cannot be loaded.
    """
    where = resolve_device(device)
    learned = success = None
    if config.needs_path:
        assert config.path is not None  # as ImaginationConfig has checked
        path, package = Path(config.path), config.discover_packages_path
        if first:
            rehearse_world_model(path, package, section=SECTION)
        learned, success = load_world_model(path, package, section=SECTION)
        learned.to(where)
    model: WorldModel
    if learned is None:
        model = OracleModel(_spec_of(world, executed), lambda: make_world(env), config.rollouts)
    elif config.model == "copy":
        model = CopyModel(learned.spec)
    else:
        model = ShuffledModel(learned) if config.model == "shuffled" else learned
    if success is not None:
        success.config.device = str(where)
    return ImaginationModels(model, None if success is None else success.to(where))


def _spec_of(world: WorldSpec, executed: int) -> WorldModelSpec:
    """All that an environment shows, at its own size."""
    height, width, _ = next(iter(world.images.values()))
    return WorldModelSpec(
        cameras=tuple(world.images),
        image_size=(height, width),
        state_dim=world.state_dim,
        action_dim=world.action_dim,
        chunk=executed,
        fps=world.fps,
        context=1,
        provides=frozenset({"pixels", "state"} if world.state_dim else {"pixels"}),
    )


class CopyModel(WorldModel):
    """Predicts that nothing changes."""

    def __init__(self, spec: WorldModelSpec) -> None:
        self.spec = replace(spec, provides=spec.provides - {"uncertainty"})

    def begin(self, context: Context, tasks: Sequence[str], resets: Sequence[Reset] | None = None) -> State:
        return {"frames": context.frames[:, -1], "robot": context.robot[:, -1]}

    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Prediction:
        unknown = torch.full((len(actions),), torch.nan)
        return Prediction(state=state, frames=state["frames"], robot=state["robot"], uncertainty=unknown)


class ShuffledModel(WorldModel):
    """Another model that gets the actions of another row."""

    def __init__(self, model: WorldModel) -> None:
        self.model, self.spec = model, model.spec

    def begin(self, context: Context, tasks: Sequence[str], resets: Sequence[Reset] | None = None) -> State:
        return self.model.begin(context, tasks, resets)

    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Prediction:
        if len(actions) < 2:
            raise ValueError("a single rollout can only get its own actions")
        return self.model.step(state, actions.roll(1, 0), seeds)


def learned_part(model: WorldModel) -> LearnableWorldModel:
    """The model that is trained: the model itself, or the one inside a `ShuffledModel`."""
    model = model.model if isinstance(model, ShuffledModel) else model
    assert isinstance(model, LearnableWorldModel)  # as `ImaginationConfig.learns` says
    return model


class OracleModel(WorldModel):
    """Simulators that are put where a rollout starts: at a reset.

    A state holds the actions since the reset, so it can be continued more than once; a simulator that is
    already there just goes on. At most `simulators` are kept.
    """

    def __init__(self, spec: WorldModelSpec, make: Callable[[], World], simulators: int) -> None:
        self.spec = replace(spec, provides=spec.provides - {"uncertainty"} | {"success"})
        self._make, self._most = make, simulators
        self._at: OrderedDict[bytes, World] = OrderedDict()  # the longest unused first
        self._free: list[World] = []
        self._made = 0
        self.tasks: list[str] = []

    def begin(self, context: Context, tasks: Sequence[str], resets: Sequence[Reset] | None = None) -> State:
        if resets is None:
            raise ValueError("an oracle needs the reset of every start")
        self.tasks += sorted({reset.task for reset in resets} - set(self.tasks))
        return {
            "task": torch.tensor([self.tasks.index(reset.task) for reset in resets]),
            "seed": torch.tensor([reset.seed for reset in resets]),
            "count": torch.zeros(len(resets), dtype=torch.long),
            "played": torch.zeros(len(resets), 0, self.spec.action_dim),
        }

    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Prediction:
        results = [self._play(state, i, actions[i].numpy()) for i in range(len(actions))]
        count, chunk = state["count"], actions.shape[1]
        lacking = int(count.max()) + chunk - state["played"].shape[1]
        played = torch.nn.functional.pad(state["played"], (0, 0, 0, max(0, lacking)))
        for i, n in enumerate(count.tolist()):
            played[i, n : n + chunk] = actions[i]
        names = [name for name in results[0].observation if name != TASK]
        observations = {n: np.stack([np.asarray(r.observation[n]) for r in results]) for n in names}
        frames, robot = model_arrays(observations, self.spec)
        return Prediction(
            state={**state, "count": count + chunk, "played": played},
            frames=torch.from_numpy(frames),
            robot=torch.from_numpy(robot),
            uncertainty=torch.full((len(actions),), torch.nan),
            success=torch.tensor([float(r.success) for r in results]),
            done=torch.tensor([r.done for r in results]),
        )

    def close(self) -> None:
        """Closes the simulators."""
        for world in (*self._at.values(), *self._free):
            world.close()
        self._at.clear()
        self._free.clear()

    def _play(self, state: State, row: int, actions: np.ndarray) -> ChunkResult:
        task, seed = self.tasks[int(state["task"][row])], int(state["seed"][row])
        played = state["played"][row, : int(state["count"][row])].numpy()
        world = self._at.pop(_key(task, seed, played), None)
        if world is None:
            world = self._any_simulator()
            world.reset(seed, task)
            if len(played):
                world.step_chunk(played)
        result = world.step_chunk(actions)
        if result.done:
            self._free.append(world)
        else:
            self._at[_key(task, seed, np.concatenate([played, actions]))] = world
        return result

    def _any_simulator(self) -> World:
        if self._free:
            return self._free.pop()
        if self._made < self._most or not self._at:
            self._made += 1
            return self._make()
        return self._at.popitem(last=False)[1]


def _key(task: str, seed: int, played: np.ndarray) -> bytes:
    return f"{task} {seed} ".encode() + np.ascontiguousarray(played, np.float32).tobytes()


def check_fit(
    spec: WorldModelSpec, world: WorldSpec, executed: int, history: int, has_success_model: bool
) -> None:
    """Refuses a world model that does not fit environment and policy, before a run begins.

    The policy executes so many actions per decision, and its observations hold `history` env steps.

    Raises:
        InputError: it has other cameras, another robot, other tasks or another chunk, nothing classifies
            successes, or the policy reads past observations, which are not imagined.
    """

    def refuse(value: object, why: str) -> InputError:
        return InputError(f"{SECTION}.path", value, why)

    if missing := [camera for camera in world.images if camera not in spec.cameras]:
        cameras = ", ".join(spec.cameras)
        raise refuse(
            missing[0], f"the world shows this camera, the world model {cameras}; train one of this world"
        )
    needed = {"pixels"} | ({"state"} if world.state_dim else set())
    if lacking := needed - spec.provides:
        why = "the policy reads it, and the world model does not provide it"
        raise refuse(sorted(lacking)[0], f"{why}; train one with accerl world-model")
    for name in ("state_dim", "action_dim", "fps"):
        theirs, ours = getattr(spec, name), getattr(world, name)
        if theirs != ours:
            remedy = f"is the world model's {name}, and the world's is {ours}; train one of this world"
            raise refuse(theirs, remedy)
    if spec.tasks and (others := [task for task in world.tasks if not _is_of(task, spec.tasks)]):
        more = "" if len(spec.tasks) <= SHOWN else f" and {len(spec.tasks) - SHOWN} more"
        remedy = (
            f"the world model is of {', '.join(spec.tasks[:SHOWN])}{more}; name these, or train one of it"
        )
        raise InputError("env.task", others[0], remedy)
    if spec.chunk != executed:
        why = f"env steps per prediction, and the policy executes {executed} actions per decision"
        raise refuse(spec.chunk, f"{why}; train one with world_model.chunk={executed}")
    if history > 1:
        why = "the policy looks back so many env steps, and only one frame per decision is imagined"
        raise InputError("policy.n_obs_steps", history, f"{why}; use a policy with 1, or imagination.share=0")
    if not has_success_model and "success" not in spec.provides:
        why = "there is no success model beside the world model, which does not classify successes itself"
        raise refuse(None, f"{why}; train both with accerl world-model")


def _is_of(task: str, known: Sequence[str]) -> bool:
    """True if the task is known. A task of a suite that is played alone may have the suite's name only."""
    suite, _, number = task.partition("/")
    return task in known or suite in known or (not number and any(k.startswith(f"{suite}/") for k in known))
