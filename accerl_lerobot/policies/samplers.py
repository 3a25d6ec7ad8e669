# SPDX-License-Identifier: Apache-2.0
"""How policies explore: one config per family of likelihood, picked by ``--policy.sampler.type``.

Free of torch, so that a run is parsed before it is loaded. Saved with every checkpoint, since a stored latent
means nothing without it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import draccus

from accerl_lerobot.config.ranges import Positive, Range, Section, Share
from accerl_lerobot.errors import InputError


@dataclass(frozen=True, kw_only=True)
class SamplerConfig(Section, draccus.ChoiceRegistry, section="policy.sampler"):
    """Base of every sampler config."""

    @property
    def type(self) -> str:
        """The registered name, that of the family."""
        return str(self.get_choice_name(self.__class__))

    def override(self, policy_config: Any) -> None:
        """Puts what it asks of the policy itself into LeRobot's config, which is saved with the policy."""


def _check_order(config: SamplerConfig, low: str, middle: str, high: str) -> None:
    value = getattr(config, middle)
    for name, right in ((low, getattr(config, low) < value), (high, value < getattr(config, high))):
        if not right:
            side = "below" if name == low else "above"
            remedy = f"use a value {side} policy.sampler.{middle}, {value:g}"
            raise InputError(f"policy.sampler.{name}", getattr(config, name), remedy)


@SamplerConfig.register_subclass("flow")
@dataclass(frozen=True, kw_only=True)
class FlowSamplerConfig(SamplerConfig):
    """Flow policies: which denoising steps are Gaussian, and how wide. `flow.py` explains the choices."""

    stochastic: Literal["last", "all", "one"] = "last"
    """Which denoising steps are Gaussian: last, all or one."""
    noise: Literal["euler", "flow_sde", "learned"] = "euler"
    """euler (stock mean, constant std), flow_sde (marginal-preserving, std grows with t) or learned (stock
    mean, a std that is learnt per observation, step and action dim, as in ReinFlow)."""
    noise_level: Annotated[float, Range("(0, 2]")] = 0.2
    """euler: total injected std in normalised action units. flow_sde: the factor a of
    σ_t = a·√(t/(1−t)). learned: the std of each step at the start."""
    noise_min: Annotated[float, Range("(0, 2]")] = 0.08
    """learned: lower bound of the std, > 0 and below `noise_level`."""
    noise_max: Annotated[float, Range("(0, 2]")] = 0.4
    """learned: upper bound of the std, above `noise_level`."""
    padded: Literal["joint", "analytic"] = "joint"
    """Padded action dims under ``all`` and ``one``: joint (noise in them, counted in the density; the stock
    sampler as noise → 0) or analytic (overwritten by t·ε_pad after every step: exact given ε_pad and free of
    untrained velocities' variance, but not the stock sampler). Without effect under ``last``."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.noise == "learned":
            _check_order(self, "noise_min", "noise_level", "noise_max")


@SamplerConfig.register_subclass("noise_space")
@dataclass(frozen=True, kw_only=True)
class NoiseSpaceSamplerConfig(SamplerConfig):
    """A frozen flow policy, steered by the initial noise it is given (DSRL); see `noise_space.py`."""

    std: Annotated[float, Range("(0, 2]")] = 1.0
    """Std of the noise at the start; 1 is what the policy was trained with."""
    std_min: Positive = 0.1
    """Lower bound of the learnt std, > 0 and below `std`."""
    std_max: Positive = 2.0
    """Upper bound of the learnt std, above `std`."""
    bound: Positive = 2.0
    """Largest absolute mean: noise the policy never saw in training gives actions nobody trained."""
    hidden: Annotated[int, Range("[1, 65536]")] = 128
    """Width of the head's hidden layer."""
    per_row: bool = False
    """True: every row of a chunk gets a noise of its own. False: one row's noise for all, which is a far
    smaller space to search, and not how the policy was trained."""
    at_rest: Literal["mean", "sample"] = "mean"
    """How it acts when it does not explore: mean, or sample, which with `per_row` and `std` 1 is the frozen
    policy itself as long as nothing has been learnt."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_order(self, "std_min", "std", "std_max")


@SamplerConfig.register_subclass("tokens")
@dataclass(frozen=True, kw_only=True)
class TokenSamplerConfig(SamplerConfig):
    """Token policies: every token is drawn from the softmax of its logits; see `tokens.py`."""

    temperature: Annotated[float, Range("(0, 10]")] = 1.0
    """Logits are divided by it, when acting and when re-scoring: below 1 the most likely tokens are
    drawn more often, above 1 less often."""


@SamplerConfig.register_subclass("gaussian")
@dataclass(frozen=True, kw_only=True)
class GaussianSamplerConfig(SamplerConfig):
    """Policies that predict one chunk, with a Gaussian around it; see `gaussian.py`.

    Only `at_rest` concerns a policy that has a std of its own, as gaussian_actor does.
    """

    std: Annotated[float, Range("(0, 2]")] = 0.2
    """Std of every action at the start, in normalised units."""
    std_min: Positive = 0.05
    """With `learn_std`: lower bound of the std, > 0 and below `std`."""
    std_max: Positive = 0.5
    """With `learn_std`: upper bound of the std, above `std`."""
    learn_std: bool = True
    """True: the std is learnt, per observation, row and action dim. False: it stays `std`."""
    detach: bool = True
    """True: the learnt std reads the policy's features without shaping them."""
    at_rest: Literal["stock", "mean"] = "stock"
    """How it acts when it does not explore: stock, as LeRobot's policy does, which for gaussian_actor means
    to sample; or mean. For act both are the same."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.learn_std:
            _check_order(self, "std_min", "std", "std_max")


@SamplerConfig.register_subclass("diffusion")
@dataclass(frozen=True, kw_only=True)
class DiffusionSamplerConfig(SamplerConfig):
    """Diffusion policies, each denoising step a Gaussian (DPPO); see `diffusion.py`.

    How many steps there are is ``policy.num_steps``.
    """

    std_min: Annotated[float, Range("(0, 1]")] = 0.1
    """Lower bound of a step's std while exploring, in normalised units. The last step has no noise
    of its own, so this is the executed action's std around what the chain arrives at."""
    last_steps: Annotated[int, Range("[1, 10000]")] | None = None
    """Explore in, and learn from, so many steps at the end of the chain; those before act as LeRobot's and
    are left out of the ratio, which then is an approximation off-policy. None: all steps, which is exact."""
    eta: Share = 1.0
    """DDIM: noise of the exploring steps, from 0 (none but `std_min`) to 1 (as much as DDPM). LeRobot's own
    DDIM sampler has 0."""
    scheduler: Literal["DDPM", "DDIM"] | None = None
    """DDPM or DDIM, whatever the policy was trained with: both reverse the same noising. None keeps the
    checkpoint's. Written into what is saved."""

    def override(self, policy_config: Any) -> None:
        """See the base class."""
        if self.scheduler is not None:
            policy_config.noise_scheduler_type = self.scheduler
