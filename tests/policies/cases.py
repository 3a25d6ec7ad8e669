# SPDX-License-Identifier: Apache-2.0
"""Every policy type, small, offline, on LeRobot's own classes: what `test_contract` runs its tests on.

`slow` functions are written from the formulas: float64 NumPy, one request at a time, entry by entry. Networks
are run on one observation alone, without padding or cache.
"""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from accerl_lerobot.experience import Request
from accerl_lerobot.policies.adapter import LeRobotAdapter, stack_observations
from accerl_lerobot.policies.config import (
    DiffusionSamplerConfig,
    FlowSamplerConfig,
    GaussianSamplerConfig,
    SamplerConfig,
    TokenSamplerConfig,
)
from accerl_lerobot.testing import perturb
from tests.policies import diffusion_oracle, oracle
from tests.policies.checkpoints import write_act, write_bins, write_diffusion, write_smolvla
from tests.policies.tiny import looking_back, requests
from tests.policies.tiny_pi import small, write_pi

Latent = dict[str, Tensor]


@dataclass(frozen=True, kw_only=True)
class Case:
    """A checkpoint of one policy type, and how to compute its log-probs and actions in another way."""

    kind: str
    write: Callable[[Path], Path]
    samplers: tuple[SamplerConfig, ...]
    slow: Callable[[LeRobotAdapter, list[Request], Latent], list[float] | np.ndarray]
    """Log-probs (B,) of stored latents under the current weights."""
    stock: Callable[[LeRobotAdapter, dict[str, Tensor], list[Request], Latent], Tensor] | None = None
    """LeRobot's own chunk (B, ≥ K, A) in normalised units, on the noise of the requests."""
    parts: tuple[str, ...] = ()
    """Parts of parameter names, whose gradients are compared with finite differences."""
    chunk: tuple[int, int] = (3, 2)
    image: int = 32
    ask: Callable[..., list[Request]] = requests
    prepare: Callable[[LeRobotAdapter], None] = lambda adapter: perturb(adapter, 0.1)
    """Makes the weights those of a policy that has been trained a little."""
    moved: float = 0.1
    """How far weights are moved before a comparison with `slow`."""
    close: tuple[float, float] = (1e-5, 2e-4)
    """Relative and absolute tolerance of that comparison."""
    step: float = 0.02
    slack: float = 0.02
    """Step and relative error of finite differences: ReLUs bend, and smaller steps drown in rounding."""
    context: Callable[[], contextlib.AbstractContextManager[None]] = contextlib.nullcontext
    """Holds whenever the policy is built."""

    def requests(self, count: int, **options: Any) -> list[Request]:
        return self.ask(count, image=self.image, **options)


def alone(adapter: LeRobotAdapter, request: Request) -> dict[str, Tensor]:
    """The preprocessed batch of one request."""
    return adapter.processing.prepare(*stack_observations([request]))


def normal_log_prob(x: float, mean: float, std: float) -> float:
    return -0.5 * ((x - mean) / std) ** 2 - math.log(std * math.sqrt(2 * math.pi))


def layer_norm(x: np.ndarray, weights: dict[str, np.ndarray], name: str) -> np.ndarray:
    x = (x - x.mean()) / math.sqrt(x.var() + 1e-5)
    return x * weights[f"{name}.weight"] + weights[f"{name}.bias"]


def linear(x: np.ndarray, weights: dict[str, np.ndarray], name: str) -> np.ndarray:
    return weights[f"{name}.weight"] @ x + weights[f"{name}.bias"]


def bounded(raw: np.ndarray, low: float, high: float) -> np.ndarray:
    """A number whose logarithm lies between those of the bounds."""
    return np.exp(math.log(low) + (math.log(high) - math.log(low)) / (1 + np.exp(-raw)))


def arrays(module: torch.nn.Module) -> dict[str, np.ndarray]:
    return {k: v.double().numpy() for k, v in module.state_dict().items()}


@torch.no_grad()
def features_of(adapter: LeRobotAdapter, request: Request) -> np.ndarray:
    """Mean feature of the real tokens, (width,)."""
    encoded = adapter.model.encode(alone(adapter, request))
    return encoded.features[0][encoded.mask[0]].double().mean(0).numpy()


# ---- flow: SmolVLA, π0, π0.5


def slow_flow(adapter: LeRobotAdapter, asked: Sequence[Request], latent: Latent) -> np.ndarray:
    """See `Case.slow`; each observation is read alone."""
    encoded = [adapter.model.encode(alone(adapter, request)) for request in asked]

    def read(x: np.ndarray, t: float, sample: int) -> np.ndarray:
        with torch.no_grad():
            velocity = encoded[sample].context
            return velocity(torch.from_numpy(x).float()[None], torch.tensor([t]).float())[0].double().numpy()

    x0, x = (part.numpy() for part in latent["path"].unbind(1))
    shape, std = adapter.family.shape, adapter.family.sampler.noise_level
    return oracle.log_prob(read, x0, x, shape, std)


def stock_flow(
    adapter: LeRobotAdapter, batch: dict[str, Tensor], asked: list[Request], latent: Latent
) -> Tensor:
    return adapter.policy.predict_action_chunk(batch, noise=latent["path"][:, 0])


# ---- Gaussian: ACT


def slow_act(adapter: LeRobotAdapter, asked: list[Request], latent: Latent) -> list[float]:
    seen: list[Tensor] = []
    hook = adapter.policy.model.decoder.register_forward_hook(lambda m, a, out: seen.append(out.double()))
    config, totals = adapter.family.sampler, []
    for request, u in zip(asked, latent["u"].double().numpy(), strict=True):
        mean = adapter.policy.predict_action_chunk(alone(adapter, request))[0].double().numpy()
        total = 0.0
        for row in range(3):
            weights = arrays(adapter.family.std)
            hidden = layer_norm(seen[-1][row, 0].numpy(), weights, "norm")
            std = bounded(linear(hidden, weights, "out"), *config.bounds)
            total += sum(normal_log_prob(u[row, dim], mean[row, dim], std[dim]) for dim in range(2))
        totals.append(total)
    hook.remove()
    return totals


def stock_act(
    adapter: LeRobotAdapter, batch: dict[str, Tensor], asked: list[Request], latent: Latent
) -> Tensor:
    queued = torch.stack([adapter.policy.select_action(batch) for _ in range(3)], 1)
    assert torch.equal(queued, adapter.policy.predict_action_chunk(batch)[:, :3]), (
        "what lerobot-eval executes"
    )
    adapter.policy.reset()
    return queued


# ---- diffusion


@torch.no_grad()
def slow_diffusion(adapter: LeRobotAdapter, asked: list[Request], latent: Latent) -> list[float]:
    policy, config, totals = adapter.policy, adapter.family.sampler, []
    rule = {
        "scheduler": policy.config.noise_scheduler_type,
        "prediction": policy.config.prediction_type,
        "clip": 1.0 if policy.config.clip_sample else None,
    }
    timesteps = [int(t) for t in policy.diffusion.noise_scheduler.timesteps]
    first = policy.config.n_obs_steps - 1
    for request, path in zip(asked, latent["path"], strict=True):
        batch = alone(adapter, request)
        steps = [batch["observation.state"], batch["observation.images.front"]]
        if first == 0:
            steps = [part[:, None] for part in steps]
        images = policy.diffusion.rgb_encoder[0](steps[1][0])
        condition = torch.cat([steps[0][0], images], -1).flatten()[None]

        def network(x: np.ndarray, t: int, condition: Tensor = condition) -> np.ndarray:
            output = policy.diffusion.unet(torch.from_numpy(x).float()[None], torch.tensor([t]), condition)
            return output[0].double().numpy()

        rows = slice(first, first + 3)
        totals.append(
            diffusion_oracle.log_prob(network, path.numpy(), timesteps, 20, rows, config.std_min, rule).sum()
        )
    return totals


# ---- tokens: smolvla_bins, π0-FAST


@torch.no_grad()
def slow_bins(adapter: LeRobotAdapter, asked: list[Request], latent: Latent) -> list[float]:
    """By the head's matrix in double precision."""
    weights, totals = arrays(adapter.policy.model.head), []
    for request, tokens in zip(asked, latent["tokens"].tolist(), strict=True):
        hidden = adapter.policy.hidden(alone(adapter, request))[0].double().numpy()
        logits = (hidden @ weights["weight"].T + weights["bias"]) / adapter.family.sampler.temperature
        log_probs = logits - np.log(np.exp(logits).sum(-1, keepdims=True))
        totals.append(sum(log_probs[place, token] for place, token in enumerate(tokens)))
    return totals


def stock_bins(
    adapter: LeRobotAdapter, batch: dict[str, Tensor], asked: list[Request], latent: Latent
) -> Tensor:
    stock = adapter.policy.predict_action_chunk(batch)
    queued = torch.stack([adapter.policy.select_action(batch) for _ in range(6)], 1)
    assert torch.equal(queued[:, :3], stock[:, :3]), "what lerobot-eval executes"
    assert torch.equal(queued[:, 3:], stock[:, :3]), "a new chunk once the first is used up"
    adapter.policy.reset()
    return stock


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


def slow_pi0_fast(adapter: LeRobotAdapter, asked: list[Request], latent: Latent) -> list[float]:
    return [_slow_tokens(adapter, r, t) for r, t in zip(asked, latent["tokens"], strict=True)]


@torch.no_grad()
def _slow_tokens(adapter: LeRobotAdapter, request: Request, tokens: Tensor) -> float:
    """Token by token without a cache, the attention mask entry by entry, the softmax in double precision."""
    from lerobot.policies.common.vla_utils import prepare_attention_masks_4d

    policy, network = adapter.policy, adapter.policy.model.paligemma_with_expert
    batch = alone(adapter, request)
    (image,), _ = policy._preprocess_images(batch)
    prompt = batch["observation.language.tokens"][0][batch["observation.language.attention_mask"][0]]
    bos, total = policy._paligemma_tokenizer.bos_token_id, 0.0
    for position, token in enumerate(tokens.tolist()):
        words = torch.tensor([[*prompt.tolist(), bos, *tokens[:position].tolist()]])
        embedded = torch.cat([network.embed_image(image), network.embed_language_tokens(words)], 1)
        size, prefix = embedded.shape[1], embedded.shape[1] - position
        mask = torch.zeros(1, size, size, dtype=torch.bool)
        for query, key in itertools.product(range(size), repeat=2):
            mask[0, query, key] = key < prefix or key <= query
        (hidden, _), _ = network.forward(
            attention_mask=prepare_attention_masks_4d(mask),
            position_ids=torch.arange(size)[None],
            inputs_embeds=[embedded, None],
            use_cache=False,
        )
        logits = network.paligemma.lm_head(hidden[0, -1]).double().numpy()
        logits = (logits - logits.max()) / adapter.family.sampler.temperature
        total += logits[token] - np.log(np.exp(logits).sum())
        if token == adapter.model.terminator:
            break
    return total


def stock_tokens(
    adapter: LeRobotAdapter, batch: dict[str, Tensor], asked: list[Request], latent: Latent
) -> Tensor:
    return adapter.policy.predict_action_chunk(batch)


UNET = ("rgb_encoder", "down_modules", "mid_modules", "up_modules", "final_conv")


def _pi(kind: str, **fields: Any) -> Case:
    parts = ("vision_tower", "paligemma.model.language_model", "gemma_expert", "action_out_proj")
    return Case(
        kind=kind,
        write=lambda path: write_pi(path, kind, chunk=5, executed=3, padded_dim=4, action_dim=2),
        samplers=(FlowSamplerConfig(noise_level=0.4),),
        slow=slow_flow,
        stock=stock_flow,
        parts=parts,
        close=(1e-4, 2e-4),
        context=small,
    )


CASES = {
    "smolvla": Case(
        kind="smolvla",
        write=lambda path: write_smolvla(path, chunk=5, executed=3, padded_dim=4, action_dim=2, num_steps=3),
        samplers=(FlowSamplerConfig(noise_level=0.2),),  # rounding of log ρ is over this
        slow=slow_flow,
        stock=stock_flow,
        parts=("vision_model", "text_model", "lm_expert", "action_out_proj"),
        moved=0.3,
        step=0.05,
    ),
    "pi0": _pi("pi0"),
    "pi05": _pi("pi05"),
    "pi0_fast": Case(
        kind="pi0_fast",
        write=lambda path: write_pi(path, "pi0_fast", num_steps=10),
        samplers=(TokenSamplerConfig(), TokenSamplerConfig(temperature=0.6)),
        slow=slow_pi0_fast,
        stock=stock_tokens,
        parts=("vision_tower", "embed_tokens", "language_model.layers", "lm_head"),
        chunk=(4, 2),
        prepare=lambda adapter: lean(adapter, adapter.model.terminator, 4.0),
        close=(1e-4, 1e-3),
        context=small,
    ),
    "smolvla_bins": Case(
        kind="smolvla_bins",
        write=lambda path: write_bins(path, chunk=5, executed=3, action_range=(-0.5, 1.5)),
        samplers=(TokenSamplerConfig(), TokenSamplerConfig(temperature=0.7)),
        slow=slow_bins,
        stock=stock_bins,
        parts=("vision_model", "text_model", "queries", "head"),
        prepare=lambda adapter: perturb(adapter, 0.3),  # a new head's logits are all but flat
        close=(1e-5, 1e-4),
        step=0.05,
    ),
    "act": Case(
        kind="act",
        write=write_act,
        # Its ResNet rounds the chunk by up to 1e-6 from batch to batch, and log ρ by that over the std.
        samplers=(GaussianSamplerConfig(std=0.5),),
        slow=slow_act,
        stock=stock_act,
        parts=("model.backbone", "model.encoder.", "model.decoder.", "action_head"),
        image=16,
        close=(1e-5, 1e-4),
        step=0.005,
    ),
    "diffusion": Case(
        kind="diffusion",
        write=lambda path: write_diffusion(path, image=40, n_obs_steps=2),
        samplers=(DiffusionSamplerConfig(std_min=0.5),),
        slow=slow_diffusion,
        parts=UNET,
        image=40,  # below 33 pixels LeRobot's spatial softmax sees one cell, whatever is in it
        ask=looking_back,
        close=(1e-3, 2e-3),
        step=0.005,
        slack=0.06,
    ),
}
"""The seven types, by their names in LeRobot."""
VARIANTS = {
    "diffusion, DDIM, one observation, batch norm": Case(
        kind="diffusion",
        write=lambda path: write_diffusion(
            path,
            image=40,
            use_group_norm=False,
            noise_scheduler_type="DDIM",
            prediction_type="sample",
            num_inference_steps=3,
        ),
        samplers=(DiffusionSamplerConfig(std_min=0.5), DiffusionSamplerConfig(std_min=0.1)),
        slow=slow_diffusion,
        parts=UNET,
        image=40,
        close=(1e-3, 2e-3),
        step=0.005,
    )
}
"""Other families, and configurations that take another path through the code."""
