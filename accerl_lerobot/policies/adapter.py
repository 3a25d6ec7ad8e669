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
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from accerl_lerobot.checkpoint.tensors import part_of, whole
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import (
    TASK,
    Decision,
    Observation,
    Observations,
    Request,
    Segment,
    stack_observations,
)
from accerl_lerobot.policies import saving
from accerl_lerobot.policies.config import PLUGINS
from accerl_lerobot.policies.family import Encoded, Family, Latent, Model, pooled
from accerl_lerobot.policies.features import ACTION, STATE, policy_features
from accerl_lerobot.policies.processing import Processing
from accerl_lerobot.policies.teacher import TEACHER_PREFIX, Teacher
from accerl_lerobot.seeds import torch_seeded

HIDDEN = 128
ROUNDING = 1e-5  # by which numbers of two decisions may differ and be the same
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
        with torch_seeded(torch.initial_seed(), ()):
            self.hidden = nn.Linear(width, HIDDEN)
        self.out = nn.Linear(HIDDEN, 1)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, features: Tensor, mask: Tensor) -> Tensor:
        """V (B,) from features (B, P, width) and mask (B, P) bool, True where a token is real."""
        features = features.detach().float()  # the critic does not shape the backbone
        scores = (features @ self.query) / features.shape[-1] ** 0.5
        scores = scores.masked_fill(~mask, -torch.inf)
        x = self.norm(pooled(features, torch.softmax(scores, -1)))
        x = torch.relu(self.hidden(x))
        return self.out(x).float()[:, 0]


class Evaluation(NamedTuple):
    """A batch of stored decisions under the current weights."""

    log_prob: Tensor  # (B, L), same factors as `Decision.log_prob`
    entropy: Tensor  # (B,)
    value: Tensor  # (B,), V of the observations


class PolicyAdapter(nn.Module, ABC):
    """One policy as the engine sees it: stochastic, with a density and a critic."""

    device: torch.device

    def factors(self, latent: Latent) -> Tensor | None:
        """bool (B, L), False for log-prob factors that a latent does not have, such as tokens after the
        terminator; None if all latents have all of them."""
        return None

    @abstractmethod
    def decide(self, requests: Sequence[Request], version: int) -> list[Decision]:
        """Acts on a batch, without gradient. Answers in the order of the requests."""

    @abstractmethod
    def evaluate(self, observations: Observations, tasks: Sequence[str], latent: Latent) -> Evaluation:
        """Re-scores stored latents, each (B, ...), differentiably; observations, each (B, ...), are raw."""

    @abstractmethod
    def values(self, observations: Observations, tasks: Sequence[str]) -> Tensor:
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
            chosen = name and re.fullmatch(self.block_names, name)
            if chosen and not inside and list(module.parameters()):
                found[name] = module
        return list(found.values())

    @abstractmethod
    def trainable(self) -> dict[str, Tensor]:
        """Parameters that the trainer updates and publishes, and the teacher's buffers.

        The critic's begin with ``value_head.``, and the teacher's with ``teacher.``.
        """

    @abstractmethod
    def copy_weights(self) -> Any:
        """A copy of what `save` writes, unaffected by further training."""

    @abstractmethod
    def save(self, directory: Path, weights: Any) -> None:
        """Writes `weights`, from `copy_weights`, as ``pretrained_model`` into `directory`."""

    def load_trainable(self, tensors: dict[str, np.ndarray]) -> None:
        """Copies published weights in place."""
        with torch.no_grad():
            for name, parameter in self.trainable().items():
                # A copy: received arrays are read-only, which torch cannot express.
                parameter.copy_(part_of(torch.tensor(tensors[name]), parameter))

    def sees(self) -> bool:
        """False if a decision does not depend on the images."""
        return True

    def view_trainable(self) -> dict[str, np.ndarray]:
        """`trainable` as NumPy arrays; on a CPU the parameters' own memory, to be copied before an update."""
        views: dict[str, np.ndarray] = {}
        for name, parameter in self.trainable().items():
            tensor = whole(parameter.detach())
            views[name] = tensor.to("cpu", torch.float32).numpy()
        return views

    def export_trainable(self) -> dict[str, np.ndarray]:
        """A copy of `trainable` as NumPy arrays, safe to hand to another thread."""
        return {name: view.copy() for name, view in self.view_trainable().items()}


class PretrainedAdapter(PolicyAdapter):
    """A LeRobot policy with its processors.

    With `precision` bf16 the network runs under autocast; densities are computed in fp32 either way.
    """

    parts: dict[str, nn.Module]
    """Trained modules by name; LeRobot saves the one named ``policy``."""
    feature_width: int | None = None
    """Width of the features that `imitate` returns; None: they are not known."""
    explores = True

    def __init__(self, policy: Any, processing: Processing, precision: str) -> None:
        super().__init__()
        self.policy = policy.eval()
        self.processing = processing
        self.precision = precision
        self.device = next(policy.parameters()).device
        self.parts = {"policy": policy}
        self.teacher: Teacher | None = None
        """Acts in its place in part of the exploring episodes; given by `teacher.with_teacher`."""
        self.demonstrations: Callable[[Segment], Iterator[Segment]] | None = None
        """Remembered by off-policy learning from the start; set by `run.adapter.make_adapter`."""

    @abstractmethod
    def imitate(
        self, observations: Observations, tasks: Sequence[str], chunk: Tensor
    ) -> tuple[Tensor, Encoded | None]:
        """LeRobot's training loss, (B,) or its mean, of chunks (B, K, A) in normalised units, and what it was
        read from, if that is known."""

    def autocast(self) -> contextlib.AbstractContextManager[Any]:
        """Surrounds whatever runs the network."""
        if self.precision == "fp32":
            return contextlib.nullcontext()
        return torch.autocast(self.device.type, torch.bfloat16)

    def execute(self, chunk: Tensor, requests: Sequence[Request]) -> np.ndarray:
        """Chunks (B, K, A) in the environment's units, the teacher's where it acts."""
        if self.teacher is not None:
            chunk = self.teacher.replace(chunk, requests)
        return self.processing.unnormalise(chunk).cpu().numpy()

    def trainable(self) -> dict[str, Tensor]:
        named: dict[str, Tensor] = {}
        for part, module in self.parts.items():
            for name, parameter in module.named_parameters():
                if parameter.requires_grad:
                    named[f"{part}.{name}"] = parameter
        if self.teacher is not None:
            for name, tensor in self.teacher.state_dict(keep_vars=True).items():
                named[TEACHER_PREFIX + name] = tensor
        return named

    def copy_weights(self) -> saving.Weights:
        return {name: saving.copy_state(module) for name, module in self.parts.items()}

    def save(self, directory: Path, weights: saving.Weights | None = None) -> None:
        """Writes LeRobot's ``pretrained_model`` layout; without `weights`, those of now."""
        weights = weights or self.copy_weights()
        saving.save_pretrained(self.policy, self.processing, directory, weights)

    def sees(self) -> bool:
        request, other = self.example_requests()
        names = [name for name in request.observation if name not in (TASK, STATE)]
        images = {name: other.observation[name] for name in names}
        changed = replace(request, observation=request.observation | images)
        first = self.decide([request], 0)[0]
        second = self.decide([changed], 0)[0]
        same = np.allclose(first.chunk, second.chunk, ROUNDING, ROUNDING)
        same = same and np.allclose(first.log_prob, second.log_prob, ROUNDING, ROUNDING)
        return not (same and images)

    def example_requests(self) -> list[Request]:
        """Two requests with random observations for this policy, and instructions of unequal length.

        A policy that looks back gets as many env steps as it wants, unless it does not explore: then it keeps
        them itself.
        """
        rng = np.random.default_rng(0)
        config = self.policy.config
        env_names = {policy: env for env, policy in self.processing.rename_map.items()}
        steps: tuple[int, ...] = ()
        if self.explores and config.n_obs_steps > 1:
            steps = (config.n_obs_steps,)
        requests: list[Request] = []
        for seed, task in enumerate(("Go", "Put the red cube on the plate")):
            observation: Observation = {TASK: task}
            for key, shape in policy_features(config).shapes.items():
                name = env_names.get(key, key)
                if key == STATE:
                    observation[name] = rng.standard_normal((*steps, *shape), dtype=np.float32)
                elif key != ACTION:
                    channels, height, width = shape
                    size = (*steps, height, width, channels)
                    observation[name] = rng.integers(0, 256, size, dtype=np.uint8)
            requests.append(Request(observation=observation, noise_seed=seed, explore=self.explores))
        return requests


class LeRobotAdapter(PretrainedAdapter):
    """A LeRobot policy with a model that runs it, a likelihood and a critic."""

    def __init__(
        self,
        policy: Any,
        processing: Processing,
        model: Model,
        family: Family,
        value_head: ValueHead,
        precision: str = "fp32",
    ) -> None:
        super().__init__(policy, processing, precision)
        self.model = model
        self.family = family.to(self.device)
        self.value_head = value_head.to(self.device)
        self.parts |= {"family": self.family, "value_head": self.value_head}
        self.feature_width = model.width
        self.block_names = rf"policy\.({model.blocks})"

    def encode(self, observations: Observations, tasks: Sequence[str]) -> Encoded:
        """Reads raw observations, each (B, ...), and B instructions, for the family; differentiable."""
        return self.model.encode(self.processing.prepare(observations, tasks))

    def imitate(
        self, observations: Observations, tasks: Sequence[str], chunk: Tensor
    ) -> tuple[Tensor, Encoded]:
        encoded = self.encode(observations, tasks)
        return self.family.imitation_loss(encoded, chunk), encoded

    def factors(self, latent: Latent) -> Tensor | None:
        return self.family.factors(latent)

    @torch.no_grad()
    def decide(self, requests: Sequence[Request], version: int) -> list[Decision]:
        arrays, tasks = stack_observations(requests)
        with self.autocast():
            encoded = self.encode(arrays, tasks)
            action = self.family.act(encoded, requests)
        chunks = self.execute(action.chunk.float(), requests)
        log_probs = action.log_prob.float().cpu().numpy()
        latents = {name: values.cpu().numpy() for name, values in action.latent.items()}
        decisions: list[Decision] = []
        for i, chunk in enumerate(chunks):
            latent = {name: values[i] for name, values in latents.items()}
            decisions.append(Decision(chunk=chunk, latent=latent, log_prob=log_probs[i], version=version))
        return decisions

    def evaluate(self, observations: Observations, tasks: Sequence[str], latent: Latent) -> Evaluation:
        latent = {name: values.to(self.device) for name, values in latent.items()}
        with self.autocast():
            encoded = self.encode(observations, tasks)
            log_prob, entropy = self.family.score(encoded, latent)
        value = self.value_head(encoded.features, encoded.mask)
        return Evaluation(log_prob, entropy, value)

    @torch.no_grad()
    def values(self, observations: Observations, tasks: Sequence[str]) -> Tensor:
        with self.autocast():
            encoded = self.encode(observations, tasks)
        return self.value_head(encoded.features, encoded.mask)

    @torch.no_grad()
    def self_check(self, observations: Observations, tasks: Sequence[str]) -> float:
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
        kind = self.policy.config.type
        package = PLUGINS.get(kind, f"LeRobot {lerobot.__version__}")
        why = f"its adapter does not fit {package}: it differs from LeRobot's sampler by {difference:.2e}"
        hint = "install the version that the adapter was written for, or correct its encode or stock"
        raise InputError("policy.type", kind, f"{why}; {hint}")
