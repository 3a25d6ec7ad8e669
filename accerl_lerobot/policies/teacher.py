# SPDX-License-Identifier: Apache-2.0
"""A teacher that acts in part of the exploring episodes, on the states of a world model.

It is learnt off-policy by `algorithms.chunk_critic`, imitated by the policy, and never part of a
checkpoint that LeRobot loads. `world_model.states` has the interface of the model.

Shapes: M networks side by side, B rows, S numbers of a state, K actions of A dims.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from accerl_lerobot.checkpoint.tensors import fixed
from accerl_lerobot.experience import TASK_BITS, Observations, Request, stack_observations, task_codes
from accerl_lerobot.policies.config import Load, PolicyConfig, executed_rows
from accerl_lerobot.policies.features import STATE, policy_features
from accerl_lerobot.seeds import episode_of

if TYPE_CHECKING:
    from accerl_lerobot.world_model.config import StateModelConfig
    from accerl_lerobot.world_model.states import StateModel, StateSpec

WIDTH = 256
ACTING_SHARE = 0.5  # of exploring episodes, in which it acts once it is ready
NOISE = 0.25  # standard deviation of its exploration, in normalised action units
ENCODED = 64  # observations of which states are computed at once; images may be large
TEACHER_PREFIX = "teacher."  # how names of its weights begin among those that are published


class Ensemble(nn.Module):
    """M networks of three layers with LayerNorm and SiLU, computed at once."""

    def __init__(self, inputs: int, outputs: int, members: int) -> None:
        super().__init__()
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        for i, o in ((inputs, WIDTH), (WIDTH, WIDTH), (WIDTH, outputs)):
            uniform = torch.rand(members, i, o) * 2 - 1
            self.weights.append(uniform / i**0.5)
            self.biases.append(torch.zeros(members, 1, o))
        with torch.no_grad():
            self.weights[-1].mul_(0.1)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs) to (M, B, outputs)."""
        members = len(self.weights[0])
        x = x.expand(members, -1, -1)
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = torch.baddbmm(bias, x, weight)
            x = functional.layer_norm(x, x.shape[-1:])
            x = functional.silu(x)
        return torch.baddbmm(self.biases[-1], x, self.weights[-1])


class Teacher(nn.Module):
    """Chunks from states; once `ready`, it acts in part of the exploring episodes.

    A state consists of the output of ``model.encode`` and the code of the task.

    Its parameters and buffers are published with the policy's weights. The trainer sets the parameters that
    no gradient reaches.
    """

    def __init__(self, model: StateModel, chunk: tuple[int, int]) -> None:
        super().__init__()
        self.model = model
        self.chunk = chunk
        state = model.size + TASK_BITS
        rows, action_dim = chunk
        self.network = Ensemble(state, rows * action_dim, 1)
        self.mean = fixed(torch.zeros(state))
        self.std = fixed(torch.ones(state))
        self.low = fixed(-torch.ones(action_dim))
        """(A,), smallest action that it gives, in normalised units; with `high`, the range that was explored:
        beyond it the critic knows nothing."""
        self.high = fixed(torch.ones(action_dim))
        self.ready = fixed(torch.zeros(()))  # 1 once it may act

    @torch.no_grad()
    def states(self, observations: Observations, tasks: Sequence[str], elapsed: np.ndarray) -> Tensor:
        """States (B, S) of observations, each (B, ...), at shares `elapsed` (B,) of the time limit."""
        states: list[Tensor] = []
        parts = math.ceil(len(tasks) / ENCODED)
        for rows in np.array_split(np.arange(len(tasks)), parts):
            some = {name: values[rows] for name, values in observations.items()}
            texts = [tasks[row] for row in rows]
            seen = self.model.encode(some, texts, elapsed[rows]).to(self.mean)
            codes = torch.from_numpy(task_codes(texts))
            states.append(torch.cat([seen, codes.to(seen)], 1))
        return torch.cat(states)

    def scaled(self, state: Tensor) -> Tensor:
        """States (B, S) in units of what has been seen."""
        scaled = (state - self.mean) / self.std
        return scaled.clamp(-10, 10)

    def forward(self, state: Tensor) -> Tensor:
        """(B, S) to chunks (B, K, A) in the policy's normalised units."""
        middle = (self.low + self.high) / 2
        half = (self.high - self.low) / 2
        raw = self.network(self.scaled(state))[0]
        share = torch.tanh(raw.unflatten(-1, self.chunk))
        return middle + half * share

    def acts(self, request: Request) -> bool:
        """True if this decision is the teacher's."""
        if not request.explore or not self.ready:
            return False
        return self.plays(episode_of(request.noise_seed))

    def plays(self, episode: int) -> bool:
        """True if, once ready, it makes all decisions of this exploring episode; see `seeds.episode_of`."""
        generator = np.random.default_rng((episode, 4))
        return generator.random() < ACTING_SHARE

    @torch.no_grad()
    def replace(self, chunk: Tensor, requests: Sequence[Request]) -> Tensor:
        """The chunks (B, K, A) of a batch, the teacher's where it acts, with noise of the request's seed."""
        rows = [i for i, request in enumerate(requests) if self.acts(request)]
        if not rows:
            return chunk
        asked = [requests[i] for i in rows]
        observations, tasks = stack_observations(asked)
        elapsed = np.array([request.elapsed for request in asked], np.float32)
        taught = self(self.states(observations, tasks, elapsed)).cpu()
        chunk = chunk.clone()
        for row, request, actions in zip(rows, asked, taught, strict=True):
            generator = np.random.default_rng((request.noise_seed, 5))
            noise = torch.from_numpy(generator.standard_normal(self.chunk))
            chunk[row] = actions + NOISE * noise.to(actions)
        return chunk


def with_teacher(load: Load, model: StateModelConfig, environment_state: int, config: PolicyConfig) -> Any:
    """Load a policy and give it an untrained teacher on states of an untrained `model`.

    `environment_state` is the number of numbers that the simulator tells; 0: it tells none.
    """
    from accerl_lerobot.world_model.states import new_state_model

    adapter: Any = load(config)
    spec = state_spec(adapter.policy.config, config.rename_map, environment_state)
    zero, scale = adapter.processing.units(torch.zeros(1, spec.chunk[1]))
    spec = spec._replace(units=(zero[0].numpy(), scale[0].numpy()))
    teacher = Teacher(new_state_model(spec, model), spec.chunk)
    adapter.teacher = teacher.to(adapter.device)
    return adapter


def state_spec(policy: Any, rename_map: dict[str, str], environment_state: int) -> StateSpec:
    """Sizes that a state model of this policy has; `policy` is LeRobot's config of it."""
    from accerl_lerobot.world_model.states import StateSpec

    env_names = {new: name for name, new in rename_map.items()}
    cameras: dict[str, int] = {}
    state = 0
    for name, shape in policy_features(policy).shapes.items():
        if len(shape) == 3:
            cameras[env_names.get(name, name)] = shape[0]
        elif name == STATE:
            state = policy.n_obs_steps * shape[0]
    return StateSpec(
        cameras=cameras,
        state=state,
        environment_state=environment_state,
        chunk=(executed_rows(policy), policy.action_feature.shape[0]),
    )
