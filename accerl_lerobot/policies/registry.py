# SPDX-License-Identifier: Apache-2.0
"""LeRobot policy types that have a likelihood here, and the families that suit them; free of torch."""

from __future__ import annotations

import importlib
from typing import Any

from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import PolicyConfig, SamplerConfig

POLICIES: dict[str, tuple[str, tuple[str, ...]]] = {
    "smolvla": ("accerl_lerobot.policies.smolvla:SmolVLA", ("flow",)),
    "act": ("accerl_lerobot.policies.act:ACT", ("gaussian",)),
    "gaussian_actor": ("accerl_lerobot.policies.gaussian_actor:GaussianActor", ("gaussian",)),
    "diffusion": ("accerl_lerobot.policies.diffusion:Diffusion", ("diffusion",)),
    "pi0": ("accerl_lerobot.policies.pi0:Pi0", ("flow",)),
    "pi05": ("accerl_lerobot.policies.pi0:Pi05", ("flow",)),
    "pi0_fast": ("accerl_lerobot.policies.pi0_fast:Pi0Fast", ("tokens",)),
    "smolvla_bins": ("accerl_lerobot.policies.smolvla:SmolVLABins", ("tokens",)),
}
"""LeRobot policy type → its model, and the families that suit it, the default one first."""
FAMILIES = {
    "flow": "accerl_lerobot.policies.flow:FlowFamily",
    "gaussian": "accerl_lerobot.policies.gaussian:GaussianFamily",
    "diffusion": "accerl_lerobot.policies.diffusion:DiffusionFamily",
    "tokens": "accerl_lerobot.policies.tokens:TokenFamily",
}
"""Family → class; its config is registered under the same name in `config`."""
PLUGINS = {"smolvla_bins": "accerl_lerobot.policies.bins_plugin"}
"""LeRobot policy type of this package → the package that registers it with LeRobot."""
USES_HISTORY = ("diffusion",)
"""Types that read the observations of ``n_obs_steps`` env steps; the others read one."""
NO_DENSITY = {
    "tdmpc": "it plans by sampling and has no action density; LeRobot trains it with its own RL objective",
    "vqbet": "LeRobot does not return its code log-probs; use smolvla",
}


def register_policies() -> None:
    """Fills LeRobot's registry of policy types in this process: its own, and ours."""
    importlib.import_module("lerobot.policies")
    for package in PLUGINS.values():
        importlib.import_module(package)


def discovery(policy_type: str | None) -> list[str]:
    """Arguments by which stock LeRobot commands find this type; none for LeRobot's own."""
    if policy_type not in PLUGINS:
        return []
    return [f"--policy.discover_packages_path={PLUGINS[policy_type]}"]


def check_type(policy_type: Any, field: str, prefix: str = "") -> str:
    """Refuses a LeRobot policy type that has no likelihood here; `prefix` begins the remedy.

    Raises:
        InputError: it has none.
    """
    if policy_type not in POLICIES:
        why = NO_DENSITY.get(policy_type, f"no likelihood for it here; use one of {', '.join(POLICIES)}")
        raise InputError(field, policy_type, prefix + why)
    return str(policy_type)


def check_observations(policy_config: Any, field: str) -> None:
    """Refuses an observation history that LeRobot's policy of this type does not read.

    Raises:
        InputError: as above.
    """
    if policy_config.n_obs_steps != 1 and policy_config.type not in USES_HISTORY:
        remedy = f"only {', '.join(USES_HISTORY)} looks back; a {policy_config.type} policy takes 1"
        raise InputError(field, policy_config.n_obs_steps, remedy)


def sampler_config(config: PolicyConfig, policy_type: str) -> SamplerConfig:
    """How a policy of this type explores in this run.

    Raises:
        InputError: the configured sampler is of a family that does not suit it.
    """
    families = POLICIES[policy_type][1]
    if config.sampler is None:
        default: SamplerConfig = SamplerConfig.get_choice_class(families[0])()
        return default
    if config.sampler.type not in families:
        remedy = f"a {policy_type} policy explores by {' or '.join(families)}"
        raise InputError("policy.sampler.type", config.sampler.type, remedy)
    return config.sampler


def steps_field(policy_config: Any) -> str | None:
    """Field of a LeRobot policy config that holds its denoising steps; None if it does not denoise."""
    return next((n for n in ("num_steps", "num_inference_steps") if hasattr(policy_config, n)), None)


def override(policy_config: Any, config: PolicyConfig) -> None:
    """Puts a run's choices of denoising steps, executed rows and precision into LeRobot's policy config."""
    if hasattr(policy_config, "pretrained_backbone_weights"):
        # The checkpoint has them; LeRobot would download torchvision's first, even when told to stay offline.
        policy_config.pretrained_backbone_weights = None
    if config.num_steps is not None:
        name = steps_field(policy_config)
        if name is None:
            remedy = f"a {policy_config.type} policy does not denoise; leave the field out"
            raise InputError("policy.num_steps", config.num_steps, remedy)
        setattr(policy_config, name, config.num_steps)
    if hasattr(policy_config, "dtype"):
        policy_config.dtype = "float32"  # see `PolicyConfig.precision`
    if config.n_action_steps is not None:
        chunk = int(getattr(policy_config, "chunk_size", 0) or getattr(policy_config, "horizon", 1))
        if policy_config.type in USES_HISTORY:
            chunk -= policy_config.n_obs_steps - 1  # rows that stand for the past
        if config.n_action_steps > chunk:
            remedy = f"use 1 to {chunk}, the chunk the policy predicts"
            raise InputError("policy.n_action_steps", config.n_action_steps, remedy)
        policy_config.n_action_steps = config.n_action_steps
