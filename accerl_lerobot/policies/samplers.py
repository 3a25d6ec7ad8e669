# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""How policies explore: one config per family of likelihood, picked by ``--policy.sampler.type``.

Free of torch, so that a run is parsed before it is loaded. Saved with every checkpoint, since a stored latent
means nothing without it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import draccus

from accerl_lerobot.errors import InputError


@dataclass(frozen=True, kw_only=True)
class SamplerConfig(draccus.ChoiceRegistry):
    """Base of every sampler config."""

    @property
    def type(self) -> str:
        """The registered name, that of the family."""
        return str(self.get_choice_name(self.__class__))

    def override(self, policy_config: Any) -> None:
        """Puts what it asks of the policy itself into LeRobot's config, which is saved with the policy."""


@SamplerConfig.register_subclass("flow")
@dataclass(frozen=True, kw_only=True)
class FlowSamplerConfig(SamplerConfig):
    """Flow policies: which denoising steps are Gaussian, and how wide. `flow.py` explains the choices."""

    stochastic: str = "last"
    """Which denoising steps are Gaussian: last, all or one."""
    noise: str = "euler"
    """euler (stock mean, constant std), flow_sde (marginal-preserving, std grows with t) or learned (stock
    mean, a std that is learnt per observation, step and action dim, as in ReinFlow)."""
    noise_level: float = 0.2
    """(0, 2]. euler: total injected std in normalised action units. flow_sde: the factor a of
    σ_t = a·√(t/(1−t)). learned: the std of each step at the start."""
    noise_min: float = 0.08
    """learned: lower bound of the std, > 0 and below `noise_level`."""
    noise_max: float = 0.4
    """learned: upper bound of the std, above `noise_level`."""
    padded: str = "joint"
    """Padded action dims under ``all`` and ``one``: joint (noise in them, counted in the density; the stock
    sampler as noise → 0) or analytic (overwritten by t·ε_pad after every step: exact given ε_pad and free of
    untrained velocities' variance, but not the stock sampler). Without effect under ``last``."""

    def __post_init__(self) -> None:
        choices = {
            "stochastic": ("last", "all", "one"),
            "noise": ("euler", "flow_sde", "learned"),
            "padded": ("joint", "analytic"),
        }
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                raise InputError(
                    f"policy.sampler.{name}", getattr(self, name), f"use one of {', '.join(allowed)}"
                )
        if not 0 < self.noise_level <= 2:
            raise InputError(
                "policy.sampler.noise_level", self.noise_level, "use a value in (0, 2]; 0.2 is usual"
            )
        if self.noise == "learned":
            if not 0 < self.noise_min < self.noise_level:
                remedy = f"use a value between 0 and policy.sampler.noise_level, {self.noise_level}"
                raise InputError("policy.sampler.noise_min", self.noise_min, remedy)
            if not self.noise_level < self.noise_max <= 2:
                remedy = f"use a value between policy.sampler.noise_level, {self.noise_level}, and 2"
                raise InputError("policy.sampler.noise_max", self.noise_max, remedy)


@SamplerConfig.register_subclass("noise_space")
@dataclass(frozen=True, kw_only=True)
class NoiseSpaceSamplerConfig(SamplerConfig):
    """A frozen flow policy, steered by the initial noise it is given (DSRL); see `noise_space.py`."""

    std: float = 1.0
    """Std of the noise at the start, (0, 2]; 1 is what the policy was trained with."""
    std_min: float = 0.1
    """Lower bound of the learnt std, > 0 and below `std`."""
    std_max: float = 2.0
    """Upper bound of the learnt std, above `std`."""
    bound: float = 2.0
    """Largest absolute mean, > 0: noise the policy never saw in training gives actions nobody trained."""
    hidden: int = 128
    """Width of the head's hidden layer."""
    per_row: bool = False
    """True: every row of a chunk gets a noise of its own. False: one row's noise for all, which is a far
    smaller space to search, and not how the policy was trained."""
    at_rest: str = "mean"
    """How it acts when it does not explore: mean, or sample, which with `per_row` and `std` 1 is the frozen
    policy itself as long as nothing has been learnt."""

    def __post_init__(self) -> None:
        if not 0 < self.std <= 2:
            raise InputError("policy.sampler.std", self.std, "use a value in (0, 2]")
        if not 0 < self.std_min < self.std:
            remedy = f"use a value between 0 and policy.sampler.std, {self.std}"
            raise InputError("policy.sampler.std_min", self.std_min, remedy)
        if not self.std < self.std_max:
            raise InputError("policy.sampler.std_max", self.std_max, f"use a value above {self.std}")
        if not self.bound > 0:
            raise InputError("policy.sampler.bound", self.bound, "use a positive number")
        if self.at_rest not in ("mean", "sample"):
            raise InputError("policy.sampler.at_rest", self.at_rest, "use mean or sample")
        if self.hidden < 1:
            raise InputError("policy.sampler.hidden", self.hidden, "use a positive width")


@SamplerConfig.register_subclass("tokens")
@dataclass(frozen=True, kw_only=True)
class TokenSamplerConfig(SamplerConfig):
    """Token policies: every token is drawn from the softmax of its logits; see `tokens.py`."""

    temperature: float = 1.0
    """(0, 10]. Logits are divided by it, when acting and when re-scoring: below 1 the most likely tokens are
    drawn more often, above 1 less often."""

    def __post_init__(self) -> None:
        if not 0 < self.temperature <= 10:
            remedy = "use a value in (0, 10]; 1 samples what was trained"
            raise InputError("policy.sampler.temperature", self.temperature, remedy)


@SamplerConfig.register_subclass("gaussian")
@dataclass(frozen=True, kw_only=True)
class GaussianSamplerConfig(SamplerConfig):
    """Policies that predict one chunk, with a Gaussian around it; see `gaussian.py`.

    Only `at_rest` concerns a policy that has a std of its own, as gaussian_actor does.
    """

    std: float = 0.2
    """Std of every action at the start, in normalised units, (0, 2]."""
    std_min: float = 0.05
    """With `learn_std`: lower bound of the std, > 0 and below `std`."""
    std_max: float = 0.5
    """With `learn_std`: upper bound of the std, above `std`."""
    learn_std: bool = True
    """True: the std is learnt, per observation, row and action dim. False: it stays `std`."""
    detach: bool = True
    """True: the learnt std reads the policy's features without shaping them."""
    at_rest: str = "stock"
    """How it acts when it does not explore: stock, as LeRobot's policy does, which for gaussian_actor means
    to sample; or mean. For act both are the same."""

    def __post_init__(self) -> None:
        if not 0 < self.std <= 2:
            raise InputError("policy.sampler.std", self.std, "use a value in (0, 2]; 0.2 is usual")
        if self.learn_std and not 0 < self.std_min < self.std:
            remedy = f"use a value between 0 and policy.sampler.std, {self.std}"
            raise InputError("policy.sampler.std_min", self.std_min, remedy)
        if self.learn_std and not self.std < self.std_max:
            raise InputError("policy.sampler.std_max", self.std_max, f"use a value above {self.std}")
        if self.at_rest not in ("stock", "mean"):
            raise InputError("policy.sampler.at_rest", self.at_rest, "use stock or mean")


@SamplerConfig.register_subclass("diffusion")
@dataclass(frozen=True, kw_only=True)
class DiffusionSamplerConfig(SamplerConfig):
    """Diffusion policies, each denoising step a Gaussian (DPPO); see `diffusion.py`.

    How many steps there are is ``policy.num_steps``.
    """

    std_min: float = 0.1
    """Lower bound of a step's std while exploring, in normalised units, (0, 1]. The last step has no noise
    of its own, so this is the executed action's std around what the chain arrives at."""
    last_steps: int | None = None
    """Explore in, and learn from, so many steps at the end of the chain; those before act as LeRobot's and
    are left out of the ratio, which then is an approximation off-policy. None: all steps, which is exact."""
    eta: float = 1.0
    """DDIM: noise of the exploring steps, from 0 (none but `std_min`) to 1 (as much as DDPM). LeRobot's own
    DDIM sampler has 0."""
    scheduler: str | None = None
    """DDPM or DDIM, whatever the policy was trained with: both reverse the same noising. None keeps the
    checkpoint's. Written into what is saved."""

    def __post_init__(self) -> None:
        if not 0 < self.std_min <= 1:
            raise InputError("policy.sampler.std_min", self.std_min, "use a value in (0, 1]; 0.1 is usual")
        if self.last_steps is not None and self.last_steps < 1:
            raise InputError("policy.sampler.last_steps", self.last_steps, "use at least 1, or null for all")
        if not 0 <= self.eta <= 1:
            raise InputError("policy.sampler.eta", self.eta, "use a value in [0, 1]")
        if self.scheduler not in (None, "DDPM", "DDIM"):
            remedy = "use DDPM, DDIM, or null to keep the checkpoint's"
            raise InputError("policy.sampler.scheduler", self.scheduler, remedy)

    def override(self, policy_config: Any) -> None:
        """See the base class."""
        if self.scheduler is not None:
            policy_config.noise_scheduler_type = self.scheduler
