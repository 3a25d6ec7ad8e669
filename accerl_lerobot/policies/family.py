# SPDX-License-Identifier: Apache-2.0
"""The two halves of an adapter: a *model* runs one LeRobot policy type, a *family* gives it a likelihood.

    observations ──processors──► batch ──Model.encode──► Encoded ──Family.act──► chunk, latent, log-prob
                                                            └──────Family.score(latent) ──► log-prob

A model knows LeRobot's internals and nothing of densities; a family knows densities and asks the model for
what its `Encoded.context` offers, a velocity field for instance. `config.POLICIES` says which go together.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Request

Latent = dict[str, Tensor]
"""The tensors (B, ...) that a family sampled for B decisions, by name."""


@dataclass(frozen=True, kw_only=True)
class Encoded:
    """A batch of B observations, read once by the network."""

    features: Tensor  # (B, P, width), what the critic reads
    mask: Tensor  # bool (B, P), True where a feature is of something real
    context: Any  # input that the family samples from; each family's model defines it


class Action(NamedTuple):
    """A family's decisions for a batch."""

    chunk: Tensor  # (B, K, A), K executed actions in the policy's normalised units
    latent: Latent  # all that `Family.score` needs beside the observations
    log_prob: Tensor  # (B, L); zero where not exploring


class NoDensityError(InputError):
    """An option of a checkpoint with which it acts in LeRobot, and has no exact likelihood here."""


class Model(ABC):
    """One LeRobot policy type; holds the policy and no weights of its own.

    Raises:
        NoDensityError: an option of this checkpoint would make its density wrong.
        InputError: LeRobot itself does not act with an option, or acts wrongly.
    """

    backbone: ClassVar[str | None] = None  # prefix of what tuning mode ``expert`` freezes; None: no expert
    blocks: ClassVar[str] = ""
    """Regular expression of the names of the policy's blocks, see `PolicyAdapter.blocks`; empty: none. Where
    LeRobot runs the inside of a layer without calling the layer, the layer's parts are blocks."""
    unread: ClassVar[tuple[str, ...]] = ()  # tensors nothing is computed with; savers drop tied ones
    idle: tuple[str, ...] = ()  # prefixes of parameters that no action depends on; never trained or published
    width: int  # width of the features

    def __init__(self, policy: Any) -> None:
        """Refuses options that several of LeRobot's policies have."""
        real_time = getattr(policy.config, "rtc_config", None)
        if real_time is not None and real_time.enabled:
            hint = "real-time chunking changes the sampler's density; set it to false in config.json"
            raise InputError("policy.rtc_config.enabled", True, hint)
        self.policy = policy

    @staticmethod
    def loading() -> AbstractContextManager[None]:
        """Holds while LeRobot builds policy and processors."""
        return nullcontext()

    @abstractmethod
    def encode(self, batch: dict[str, Tensor]) -> Encoded:
        """Reads a preprocessed batch."""

    def stock(self, batch: dict[str, Tensor], **noise: Tensor) -> Tensor:
        """LeRobot's own chunk (B, K, A) in normalised units; where it denoises, from this ``noise``."""
        return self.policy.predict_action_chunk(batch, **noise)


class Family(nn.Module, ABC):
    """One way of acting at random with a known density; may own parameters, which are trained."""

    def __init__(self, model: Any, sampler: Any) -> None:
        super().__init__()
        self.model = model
        self.sampler = sampler

    @abstractmethod
    def act(self, encoded: Encoded, requests: Sequence[Request]) -> Action:
        """Samples; where a request does not explore, LeRobot's own sampler."""

    @abstractmethod
    def score(self, encoded: Encoded, latent: Latent) -> tuple[Tensor, Tensor]:
        """Log-prob (B, L), differentiable, of what `act` stored, and entropy (B,)."""

    def difference(self, batch: dict[str, Tensor], encoded: Encoded) -> float:
        """Largest difference, normalised units, between our sampler without exploration and LeRobot's."""
        count = len(encoded.features)
        requests = [Request(observation={}, noise_seed=seed, explore=False) for seed in range(count)]
        ours, latent, _ = self.act(encoded, requests)
        noise: dict[str, Tensor] = {}
        if "path" in latent:
            noise["noise"] = latent["path"][:, 0].clone()
        stock = self.model.stock(batch, **noise)
        executed = stock[:, : ours.shape[1]]
        return float((ours - executed).abs().max())

    def imitation_loss(self, encoded: Encoded, chunk: Tensor) -> Tensor:
        """LeRobot's training loss (B,) on chunks (B, K, A) of as many actions as are executed, normalised.

        `run.preflight` refuses off-policy algorithms for a family without it.
        """
        raise NotImplementedError

    def factors(self, latent: Latent) -> Tensor | None:
        """See `PolicyAdapter.factors`."""
        return None

    @staticmethod
    def exploring(requests: Sequence[Request], device: torch.device) -> Tensor:
        """bool (B,)."""
        return torch.tensor([request.explore for request in requests], device=device)


class NoiseFamily(Family):
    """A family that acts on standard normal noise, which is drawn from each request's own seed.

    One without a `score` of its own has `entropy`, and a `log_prob` (B, L) of the context and a latent.
    """

    noise_sizes: tuple[tuple[int, ...], ...]
    """Sizes of the noise tensors of one request, in the order of the draws."""
    sample: Callable[..., Action]
    """Called with the context, a tensor of noise (B, *size) for each of these sizes, and bool (B,), True
    where a request explores."""
    log_prob: Callable[..., Tensor]
    entropy: float
    """Differential entropy of what is drawn, which no weight changes."""

    def act(self, encoded: Encoded, requests: Sequence[Request]) -> Action:
        device = encoded.features.device
        noise = self.noise(requests, *self.noise_sizes, device=device)
        return self.sample(encoded.context, *noise, self.exploring(requests, device))

    def score(self, encoded: Encoded, latent: Latent) -> tuple[Tensor, Tensor]:
        log_prob = self.log_prob(encoded.context, latent)
        return log_prob, log_prob.new_full((len(log_prob),), self.entropy)

    @staticmethod
    def noise(requests: Sequence[Request], *sizes: tuple[int, ...], device: torch.device) -> list[Tensor]:
        """Standard normal tensors, each (B, *size), row i from request i's own seed, whatever its batch."""
        generators = [np.random.default_rng(request.noise_seed) for request in requests]
        tensors: list[Tensor] = []
        for size in sizes:
            draws = np.stack([rng.standard_normal(size, dtype=np.float32) for rng in generators])
            tensors.append(torch.from_numpy(draws).to(device))
        return tensors


LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)


def normal_log_prob(x: Tensor, mean: Tensor, std: Tensor) -> Tensor:
    """log N(x; mean, std²) of each entry; shapes as they broadcast."""
    z = (x - mean) / std
    return -0.5 * z * z - torch.log(std) - LOG_SQRT_2PI


def normal_entropy(std: Tensor) -> Tensor:
    """Differential entropy of N(·, std²) in nats, of each entry."""
    return torch.log(std) + LOG_SQRT_2PI + 0.5


def pooled(features: Tensor, weights: Tensor) -> Tensor:
    """Weighted mean, fp32 (B, width), of features (B, P, width); weights (B, P) of any sum above 0."""
    weights = weights / weights.sum(-1, keepdim=True)
    return (weights[..., None] * features.float()).sum(1)
