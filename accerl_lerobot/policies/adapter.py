# SPDX-License-Identifier: Apache-2.0
"""The interface of a policy to the engine, π(chunk | observation) and V(observation), and LeRobot's adapter.

`decide` acts, `evaluate` re-scores what was stored; both use one `encode` and one `Family`, so at equal
weights the ratio is 1 up to rounding. `algorithms.probe` measures that in a run; `self_check` compares with
LeRobot.
"""

from __future__ import annotations

import contextlib
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from accerl_lerobot.checkpoint.tensors import in_parts, part_of, whole
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import TASK, Decision, Request, Segment, stack_observations
from accerl_lerobot.policies import saving
from accerl_lerobot.policies.config import PLUGINS, PolicyConfig, SamplerConfig
from accerl_lerobot.policies.family import Encoded, Family, Model, pooled
from accerl_lerobot.policies.teacher import TEACHER_PREFIX, Teacher
from accerl_lerobot.policies.untrusted import FAMILY, VALUE_HEAD

HIDDEN = 128
OBS_STATE = "observation.state"
IMAGES = "observation.image"  # begins ``observation.images.<camera>``; LeRobot's name for a lone camera
CONSTANT = 1e-6  # environment units in one normalised unit, below which an action counts as constant
SELF_CHECK_TOLERANCE = 1e-5  # between our sampler and LeRobot's, in normalised actions; fp32 noise is 1e-6


class ValueHead(nn.Module):
    """Attention of one learned query over the features, LayerNorm, Linear, ReLU, Linear; starts at V = 0.

    Initial weights depend on the last `torch.manual_seed` alone, not on what was drawn since: how a policy is
    loaded must not change its critic.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.query = nn.Parameter(torch.zeros(width))
        self.norm = nn.LayerNorm(width)
        self.hidden = nn.Linear(width, HIDDEN)
        bound, generator = width**-0.5, torch.Generator().manual_seed(torch.initial_seed() % 2**63)
        for parameter in self.hidden.parameters():  # as nn.Linear begins
            nn.init.uniform_(parameter, -bound, bound, generator=generator)
        self.out = nn.Linear(HIDDEN, 1)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, features: Tensor, mask: Tensor) -> Tensor:
        """V (B,) from features (B, P, width) and mask (B, P) bool, True where a token is real."""
        features = features.detach().float()  # the critic does not shape the backbone
        scores = (features @ self.query) / features.shape[-1] ** 0.5
        weights = torch.softmax(scores.masked_fill(~mask, float("-inf")), -1)
        return self.out(torch.relu(self.hidden(self.norm(pooled(features, weights))))).float()[:, 0]


class Evaluation(NamedTuple):
    """A batch of stored decisions under the current weights."""

    log_prob: Tensor  # (B, L), same factors as `Decision.log_prob`
    entropy: Tensor  # (B,)
    value: Tensor  # (B,), V of the observations


class PolicyAdapter(nn.Module, ABC):
    """One policy as the engine sees it: stochastic, with a density and a critic."""

    device: torch.device

    def factors(self, latent: dict[str, Tensor]) -> Tensor | None:
        """bool (B, L), False for log-prob factors that a latent does not have, such as tokens after the
        terminator; None if all latents have all of them."""
        return None

    @abstractmethod
    def decide(self, requests: Sequence[Request], version: int) -> list[Decision]:
        """Acts on a batch, without gradient. Answers in the order of the requests."""

    @abstractmethod
    def evaluate(
        self, observations: dict[str, np.ndarray], tasks: Sequence[str], latent: dict[str, Tensor]
    ) -> Evaluation:
        """Re-scores stored latents, each (B, ...), differentiably; observations, each (B, ...), are raw."""

    @abstractmethod
    def values(self, observations: dict[str, np.ndarray], tasks: Sequence[str]) -> Tensor:
        """V only, (B,), without gradient."""

    block_names = ""  # regular expression

    def blocks(self) -> list[nn.Module]:
        """The network's repeated modules whose weights are used inside their own call and nowhere else.

        Neither their arguments hold anything in which a call leaves tensors, such as a key-value cache. None
        is within another.
        """
        found: dict[str, nn.Module] = {}
        for name, module in self.named_modules():
            inside = any(name.startswith(f"{outer}.") for outer in found)
            has_weights = next(module.parameters(), None) is not None
            if has_weights and not inside and re.fullmatch(self.block_names, name):
                found[name] = module
        return list(found.values()) if self.block_names else []

    @abstractmethod
    def trainable(self) -> dict[str, nn.Parameter]:
        """Parameters that the trainer updates and publishes; the critic's begin with ``value_head.``"""

    @abstractmethod
    def copy_weights(self) -> Any:
        """A copy of what `save` writes, unaffected by further training."""

    @abstractmethod
    def save(self, directory: Path, config: PolicyConfig, weights: Any) -> None:
        """Writes `weights`, from `copy_weights`, as ``pretrained_model`` into `directory`."""

    def load_trainable(self, tensors: dict[str, np.ndarray]) -> None:
        """Copies published weights in place: all of them, or none where names or shapes do not fit."""
        parameters = self.trainable()
        mine, theirs = ({(k, tuple(v.shape)) for k, v in of.items()} for of in (parameters, tensors))
        if mine != theirs:
            raise ValueError(f"published weights differ by name or shape: {sorted(mine ^ theirs)[:4]}")
        with torch.no_grad():
            for name, parameter in parameters.items():
                array, on_cpu = tensors[name], parameter.device.type == "cpu"
                # Received arrays are read-only, which torch cannot express: NumPy copies, where it can.
                if on_cpu and parameter.dtype == torch.float32 and not in_parts(parameter):
                    np.copyto(parameter.detach().numpy(), array)
                else:
                    parameter.copy_(part_of(torch.tensor(array), parameter))

    def view_trainable(self) -> dict[str, np.ndarray]:
        """`trainable` as NumPy arrays; on a CPU the parameters' own memory, to be copied before an update."""
        named = {name: whole(parameter.detach()) for name, parameter in self.trainable().items()}
        return {name: tensor.to("cpu", torch.float32).numpy() for name, tensor in named.items()}

    def export_trainable(self) -> dict[str, np.ndarray]:
        """A copy of `trainable` as NumPy arrays, safe to hand to another thread."""
        return {name: view.copy() for name, view in self.view_trainable().items()}


def trainable_of(parts: dict[str, nn.Module], teacher: Teacher | None) -> dict[str, nn.Parameter]:
    """Trainable parameters of the parts, and all of the teacher's, by the names they are published under."""
    named = {
        f"{part}.{name}": parameter
        for part, module in parts.items()
        for name, parameter in module.named_parameters()
        if parameter.requires_grad
    }
    learned = {} if teacher is None else dict(teacher.named_parameters())
    return named | {TEACHER_PREFIX + name: parameter for name, parameter in learned.items()}


def example_requests(config: Any, rename_map: dict[str, str], *, explore: bool = True) -> list[Request]:
    """Two requests with random observations for a policy, and instructions of unequal length.

    `config` is LeRobot's; `rename_map` is environment name → the policy's. A policy that looks back gets as
    many env steps as it wants, unless it keeps them itself, without exploration.
    """
    rng, env_names = np.random.default_rng(0), {policy: env for env, policy in rename_map.items()}
    batch = (2,) if config.n_obs_steps == 1 or not explore else (2, config.n_obs_steps)
    arrays: dict[str, np.ndarray] = {}
    for key, feature in config.input_features.items():
        name, shape = env_names.get(key, key), tuple(feature.shape)
        if key.startswith(IMAGES) and ".empty_camera_" not in key:
            arrays[name] = rng.integers(0, 256, (*batch, *shape[1:], shape[0]), dtype=np.uint8)
        elif key == OBS_STATE:
            arrays[name] = rng.standard_normal((*batch, *shape), dtype=np.float32)
    return [
        Request(
            observation={k: v[i] for k, v in arrays.items()} | {TASK: task}, noise_seed=i, explore=explore
        )
        for i, task in enumerate(("Go", "Put the red cube on the plate"))
    ]


def autocast_on(device: torch.device, precision: str) -> contextlib.AbstractContextManager[Any]:
    """Surrounds whatever runs a network in this precision."""
    if precision == "fp32":
        return contextlib.nullcontext()
    return torch.autocast(device.type, torch.bfloat16)


@dataclass
class Processing:
    """LeRobot's pre- and post-processor, which tokenise and normalise, fed with raw observations."""

    preprocessor: Any
    postprocessor: Any
    device: torch.device
    rename_map: dict[str, str]

    def prepare(self, observations: dict[str, np.ndarray], tasks: Sequence[str]) -> dict[str, Tensor]:
        """Normalised and tokenised observations."""
        return self.preprocessor({"task": list(tasks), **self.tensors(observations)})

    def tensors(self, observations: dict[str, np.ndarray]) -> dict[str, Tensor]:
        """By the policy's names; images go from uint8 (..., H, W, 3) to float (..., 3, H, W) in [0, 1]."""
        batch: dict[str, Tensor] = {}
        for key, array in observations.items():
            tensor = torch.from_numpy(np.ascontiguousarray(array)).to(self.device)
            if key.startswith(IMAGES):
                tensor = tensor.movedim(-1, -3).contiguous().float() / 255.0
            batch[self.rename_map.get(key, key)] = tensor
        return batch

    def unnormalise(self, chunk: Tensor) -> Tensor:
        """(B, K, A) from normalised to environment units."""
        return self.postprocessor(chunk)

    def normalise(self, chunk: Tensor) -> Tensor:
        """(B, K, A) from environment to normalised units; every normalisation that LeRobot has is affine.

        An action that is constant in the policy's dataset has no scale; it is 0.
        """
        ends = torch.stack([torch.zeros_like(chunk[0]), torch.ones_like(chunk[0])])
        zero, one = self.unnormalise(ends.to(self.device)).to(chunk)
        scale = one - zero
        varies = scale.abs() > CONSTANT
        return torch.where(varies, (chunk - zero) / torch.where(varies, scale, 1), 0)


class LeRobotAdapter(PolicyAdapter):
    """A LeRobot policy with its processors, a model that runs it, a likelihood and a critic.

    With `precision` bf16 the network runs under autocast; densities are computed in fp32 either way.
    """

    def __init__(
        self,
        policy: Any,
        processing: Processing,
        model: Model,
        family: Family,
        value_head: ValueHead,
        precision: str = "fp32",
    ) -> None:
        super().__init__()
        self.policy, self.processing, self.model = policy, processing, model
        self.device = next(policy.parameters()).device
        self.family, self.value_head = family.to(self.device), value_head.to(self.device)
        self.precision = precision
        self.block_names = model.blocks and rf"policy\.({model.blocks})"
        self.policy.eval()
        self.teacher: Teacher | None = None
        """Acts in its place in part of the exploring episodes; given by `teacher.with_teacher`."""
        self.demonstrations: Callable[[Segment], Iterator[Segment]] | None = None
        """Remembered by off-policy learning from the start; set by `engine.adapter.make_adapter`."""

    def encode(self, observations: dict[str, np.ndarray], tasks: Sequence[str]) -> Encoded:
        """Reads raw observations, each (B, ...), and B instructions, for the family; differentiable."""
        return self.model.encode(self.processing.prepare(observations, tasks))

    def imitate(
        self, observations: dict[str, np.ndarray], tasks: Sequence[str], chunk: Tensor
    ) -> tuple[Tensor, Encoded]:
        """LeRobot's training loss (B,) of chunks (B, K, A) in normalised units, and what it was read from."""
        encoded = self.encode(observations, tasks)
        return self.family.imitation_loss(encoded, chunk), encoded

    @property
    def feature_width(self) -> int | None:
        """Width of the features that `imitate` returns."""
        return self.model.width

    def autocast(self) -> contextlib.AbstractContextManager[Any]:
        """Surrounds whatever runs the network."""
        return autocast_on(self.device, self.precision)

    def factors(self, latent: dict[str, Tensor]) -> Tensor | None:
        return self.family.factors(latent)

    @torch.no_grad()
    def decide(self, requests: Sequence[Request], version: int) -> list[Decision]:
        arrays, tasks = stack_observations(requests)
        with self.autocast():
            encoded = self.encode(arrays, tasks)
            action = self.family.act(encoded, requests)
        executed = action.chunk.float()
        if self.teacher is not None:
            executed = self.teacher.replace(executed, requests)
        chunk = self.processing.unnormalise(executed).cpu().numpy()
        log_prob = action.log_prob.float().cpu().numpy()
        latents = {k: v.cpu().numpy() for k, v in action.latent.items()}
        return [
            Decision(
                chunk=chunk[i],
                latent={k: v[i] for k, v in latents.items()},
                log_prob=log_prob[i],
                version=version,
            )
            for i in range(len(requests))
        ]

    def evaluate(
        self, observations: dict[str, np.ndarray], tasks: Sequence[str], latent: dict[str, Tensor]
    ) -> Evaluation:
        with self.autocast():
            encoded = self.encode(observations, tasks)
            log_prob, entropy = self.family.score(encoded, {k: v.to(self.device) for k, v in latent.items()})
        return Evaluation(log_prob, entropy, self.value_head(encoded.features, encoded.mask))

    @torch.no_grad()
    def values(self, observations: dict[str, np.ndarray], tasks: Sequence[str]) -> Tensor:
        with self.autocast():
            encoded = self.encode(observations, tasks)
        return self.value_head(encoded.features, encoded.mask)

    def trainable(self) -> dict[str, nn.Parameter]:
        parts = {"policy": self.policy, "family": self.family, "value_head": self.value_head}
        return trainable_of(parts, self.teacher)

    def example_requests(self) -> list[Request]:
        """Two requests with random observations for this policy, and instructions of unequal length."""
        return example_requests(self.policy.config, self.processing.rename_map)

    def copy_weights(self) -> saving.Weights:
        return saving.copy_weights(self, {VALUE_HEAD: self.value_head, FAMILY: self.family})

    @property
    def sampler(self) -> SamplerConfig:
        """How it explores."""
        return self.family.sampler

    def save(self, directory: Path, config: PolicyConfig, weights: Any) -> None:
        saving.save_pretrained(self, directory, config, weights)

    @torch.no_grad()
    def self_check(self, observations: dict[str, np.ndarray], tasks: Sequence[str]) -> float:
        """Largest difference between our sampler without exploration and LeRobot's own on equal noise.

        Raises:
            InputError: above `SELF_CHECK_TOLERANCE`: log-probs would be those of another policy.
        """
        import lerobot

        batch = self.processing.prepare(observations, tasks)
        difference = self.family.difference(batch, self.model.encode(batch))
        self.policy.reset()
        if difference <= SELF_CHECK_TOLERANCE:
            return difference
        if (package := PLUGINS.get(self.policy.config.type)) is not None:
            why = f"its adapter in {package} acts unlike the policy without exploration"
            hint = f"{why}, by {difference:.2e}; correct the adapter's encode or stock"
            raise InputError("policy.type", self.policy.config.type, hint)
        fits = f"the adapter of {self.policy.name} does not fit LeRobot {lerobot.__version__}"
        hint = f"{fits}: it differs from its sampler by {difference:.2e}; install the pinned version"
        raise InputError("lerobot", lerobot.__version__, hint)
