# SPDX-License-Identifier: Apache-2.0
"""Every policy type, small, offline, on LeRobot's own classes: what `test_contract` runs its tests on."""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lerobot_policy_smolvla_bins  # noqa: F401 - registers its type
import torch
from torch import Tensor

from accerl_lerobot.experience import Request
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.config import (
    DiffusionSamplerConfig,
    FlowSamplerConfig,
    GaussianSamplerConfig,
    SamplerConfig,
    TokenSamplerConfig,
)
from accerl_lerobot.testing import perturb
from tests.policies.checkpoints import write_act, write_bins, write_diffusion, write_smolvla
from tests.policies.tiny import looking_back, requests
from tests.policies.tiny_pi import small, write_pi


@dataclass(frozen=True, kw_only=True)
class Case:
    """A checkpoint of one policy type, and what is particular about it."""

    kind: str
    write: Callable[[Path], Path]
    samplers: tuple[SamplerConfig, ...]
    parts: tuple[str, ...]  # of parameter names, whose gradients are compared with finite differences
    chunk: tuple[int, int] = (3, 2)
    image: int = 32
    ask: Callable[..., list[Request]] = requests
    prepare: Callable[[LeRobotAdapter], None] = lambda adapter: perturb(adapter, 0.1)
    """Makes the weights those of a policy that has been trained a little."""
    step: float = 0.02
    slack: float = 0.02
    """Step and relative error of finite differences: ReLUs bend, and smaller steps drown in rounding."""
    context: Callable[[], contextlib.AbstractContextManager[None]] = contextlib.nullcontext
    """Holds whenever the policy is built."""

    def requests(self, count: int, **options: Any) -> list[Request]:
        return self.ask(count, image=self.image, **options)


def lean(adapter: LeRobotAdapter, token: int, logit: float) -> None:
    """Makes a token about that likely, whatever is observed and has been said."""
    states: list[Tensor] = []
    head = adapter.policy.model.paligemma_with_expert.paligemma.lm_head
    hook = head.register_forward_pre_hook(lambda module, given: states.append(given[0]))
    adapter.decide(requests(16), 0)
    hook.remove()
    mean = torch.cat([state.flatten(0, -2) for state in states]).mean(0)
    with torch.no_grad():
        head.weight[token] = logit * mean / mean.square().sum()


UNET = ("rgb_encoder", "down_modules", "mid_modules", "up_modules", "final_conv")


def _pi(kind: str) -> Case:
    return Case(
        kind=kind,
        write=lambda path: write_pi(path, kind, chunk=5, executed=3, padded_dim=4, action_dim=2),
        samplers=(FlowSamplerConfig(noise_level=0.4),),
        parts=("vision_tower", "paligemma.model.language_model", "gemma_expert", "action_out_proj"),
        context=small,
    )


CASES = {
    "smolvla": Case(
        kind="smolvla",
        write=lambda path: write_smolvla(path, chunk=5, executed=3, padded_dim=4, action_dim=2, num_steps=3),
        samplers=(FlowSamplerConfig(noise_level=0.2),),  # rounding of log ρ is over this
        parts=("vision_model", "text_model", "lm_expert", "action_out_proj"),
        step=0.05,
    ),
    "pi0": _pi("pi0"),
    "pi05": _pi("pi05"),
    "pi0_fast": Case(
        kind="pi0_fast",
        write=lambda path: write_pi(path, "pi0_fast", num_steps=10),
        samplers=(TokenSamplerConfig(), TokenSamplerConfig(temperature=0.6)),
        parts=("vision_tower", "embed_tokens", "language_model.layers", "lm_head"),
        chunk=(4, 2),
        prepare=lambda adapter: lean(adapter, adapter.model.terminator, 4.0),
        context=small,
    ),
    "smolvla_bins": Case(
        kind="smolvla_bins",
        write=lambda path: write_bins(path, chunk=5, executed=3, action_range=(-0.5, 1.5)),
        samplers=(TokenSamplerConfig(), TokenSamplerConfig(temperature=0.7)),
        parts=("vision_model", "text_model", "queries", "head"),
        prepare=lambda adapter: perturb(adapter, 0.3),  # a new head's logits are all but flat
        step=0.05,
    ),
    "act": Case(
        kind="act",
        write=write_act,
        # Its ResNet rounds the chunk by up to 1e-6 from batch to batch, and log ρ by that over the std.
        samplers=(GaussianSamplerConfig(std=0.5),),
        parts=("model.backbone", "model.encoder.", "model.decoder.", "action_head"),
        image=16,
        step=0.005,
    ),
    "diffusion": Case(
        kind="diffusion",
        write=lambda path: write_diffusion(path, image=40, n_obs_steps=2),
        samplers=(DiffusionSamplerConfig(std_min=0.5),),
        parts=UNET,
        image=40,  # below 33 pixels LeRobot's spatial softmax sees one cell, whatever is in it
        ask=looking_back,
        step=0.005,
        slack=0.06,
    ),
}
DDIM = {"noise_scheduler_type": "DDIM", "prediction_type": "sample", "num_inference_steps": 3}
VARIANTS = {
    "diffusion, DDIM, one observation, batch norm": Case(
        kind="diffusion",
        write=lambda path: write_diffusion(path, image=40, use_group_norm=False, **DDIM),
        samplers=(DiffusionSamplerConfig(std_min=0.5), DiffusionSamplerConfig(std_min=0.1)),
        parts=UNET,
        image=40,
        step=0.005,
    )
}
"""Configurations that take another path through the code."""
