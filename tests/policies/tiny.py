# SPDX-License-Identifier: Apache-2.0
"""Observations for tiny policies, and stored decisions as the trainer sees them."""

from __future__ import annotations

import math
import pickle
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.experience import TASK, Decision, Origin, Request, Segment
from accerl_lerobot.policies.adapter import LeRobotAdapter, PolicyAdapter, stack_observations
from accerl_lerobot.policies.config import PolicyConfig, SamplerConfig
from accerl_lerobot.policies.loading import load_adapter
from accerl_lerobot.policies.saving import save_pretrained
from accerl_lerobot.rollout.segments import SegmentBuilder
from tests.rounding import assert_close

TOLERANCE = 1e-4
"""The contract: |ρ − 1| of a whole chunk at equal weights, in fp32 on any CPU; found are 1e-7 to 2e-5."""
TEXTS = ("Match the target", "Go", "Mirror the target slowly, then stay")
"""Texts of different lengths, so that a batch pads some of them."""


def requests(count: int, *, explore: bool = True, seed: int = 0, image: int = 32) -> list[Request]:
    rng = np.random.default_rng(seed)
    return [
        Request(
            observation={
                "observation.images.front": rng.integers(0, 256, (image, image, 3), dtype=np.uint8),
                "observation.state": rng.standard_normal(4, dtype=np.float32),
                TASK: TEXTS[i % len(TEXTS)],
            },
            noise_seed=1000 * seed + i,
            explore=explore,
        )
        for i in range(count)
    ]


def looking_back(count: int, *, explore: bool = True, image: int = 32) -> list[Request]:
    """Requests whose observations hold two env steps, unrelated ones."""
    return [
        replace(
            now,
            observation={
                key: value if key == TASK else np.stack([before.observation[key], value])
                for key, value in now.observation.items()
            },
        )
        for before, now in zip(
            requests(count, seed=7, image=image), requests(count, explore=explore, image=image), strict=True
        )
    ]


def adapter_at(path: Path, sampler: SamplerConfig | None = None, **options: Any) -> LeRobotAdapter:
    return load_adapter(PolicyConfig(path=str(path), device="cpu", sampler=sampler, **options))


def as_segment(asked: Sequence[Request], adapter: LeRobotAdapter, length: int) -> Segment:
    """Plays requests as one episode, in which each decision is made alone; it has been through a pickle."""
    builder = SegmentBuilder(asked[0].observation, length, Origin("task", seed=0, decision=0))
    for i in range(length):
        decision = adapter.decide([asked[i]], 3)[0]
        builder.add(decision, decision.chunk, 0.0, 3, asked[i + 1].observation)
    return pickle.loads(pickle.dumps(builder.cut("test")))


def stored(decisions: Sequence[Decision]) -> tuple[dict[str, Tensor], Tensor]:
    """(latents, log-probs (B, L)) of decisions, as a batch."""
    latent = {k: torch.from_numpy(np.stack([d.latent[k] for d in decisions])) for k in decisions[0].latent}
    return latent, torch.from_numpy(np.stack([d.log_prob for d in decisions]))


def log_ratio(adapter: PolicyAdapter, asked: Sequence[Request], decisions: Sequence[Decision]) -> Tensor:
    """log ρ (B,) of whole chunks, re-scored in one batch without gradient."""
    latent, old = stored(decisions)
    with torch.no_grad():
        new = adapter.evaluate(*stack_observations(asked), latent).log_prob
    assert new.shape == old.shape
    return (new - old).sum(1)


def check_ratio_one(adapter: PolicyAdapter, asked: Sequence[Request], decisions: Sequence[Decision]) -> None:
    """The contract, for weights that made the decisions, in batches of any size."""
    off = (log_ratio(adapter, asked, decisions).exp() - 1).abs().max()
    assert off <= TOLERANCE, f"|ρ − 1| is {off:.2e}"


def check_alike(found: Sequence[Decision], expected: Sequence[Decision]) -> None:
    """Chunks, latents and values are equal but for rounding."""
    assert_close(np.stack([d.chunk for d in found]), np.stack([d.chunk for d in expected]))
    assert_close([d.value for d in found], [d.value for d in expected])
    for key, latent in stored(expected)[0].items():
        assert_close(stored(found)[0][key], latent)


def check_batches(adapter: PolicyAdapter, asked: Sequence[Request], few: int) -> list[Decision]:
    """ρ = 1 whichever batch decides and whichever re-scores, and equal decisions; those made together.

    Args:
        adapter: of weights that are not fresh.
        asked: at least ten; in one batch of all, one that is shorter, and alone.
        few: how many are decided alone.
    """
    together = adapter.decide(asked, 7)
    alone = [adapter.decide([request], 7)[0] for request in asked[:few]]
    check_alike(alone, together[:few])
    check_alike(adapter.decide(asked[::-1], 7)[::-1], together)
    check_ratio_one(adapter, asked, together)
    check_ratio_one(adapter, asked, [*alone, *together[few:]])
    check_ratio_one(adapter, asked[7:10], together[7:10])
    return together


def deviation(one: Tensor, other: Tensor) -> float:
    """Difference of two means in units of its standard error."""
    error = math.sqrt(one.var().item() / len(one) + other.var().item() / len(other))
    return abs(one.mean().item() - other.mean().item()) / error


def perturb(adapter: PolicyAdapter, scale: float, seed: int = 0) -> None:
    """Moves every trainable weight at random, relative to its size."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in adapter.trainable().values():
            size = parameter.abs().mean() + 1e-3
            parameter += scale * size * torch.randn(parameter.shape, generator=generator)


def check_journey(adapter: LeRobotAdapter, asked: Sequence[Request], path: Path, saved: Path) -> None:
    """ρ = 1 for a segment of decisions, each made alone, re-scored together by what was saved and loaded.

    Args:
        adapter: of perturbed weights, else nothing is shown.
        asked: one more than there are decisions.
        path: the checkpoint it was loaded from.
        saved: where to save it, new.
    """
    count, sampler = len(asked) - 1, adapter.family.sampler
    segment = as_segment(asked, adapter, count)
    save_pretrained(adapter, saved, PolicyConfig(path=str(path), device="cpu", sampler=sampler))
    with torch.no_grad():
        evaluation = adapter_at(saved, sampler).evaluate(
            {k: v[:-1] for k, v in segment.observations.items()},
            [str(r.observation[TASK]) for r in asked[:count]],
            {k: torch.from_numpy(v) for k, v in segment.latent.items()},
        )
    ratio = (evaluation.log_prob - torch.from_numpy(segment.log_prob)).sum(1).exp()
    assert (ratio - 1).abs().max() <= TOLERANCE
    assert_close(evaluation.value, segment.value)
    assert np.abs(segment.value).max() > 0, "the critic was saved and loaded, not made anew"


def check_gradient(
    adapter: LeRobotAdapter,
    asked: Sequence[Request],
    decisions: Sequence[Decision],
    parts: Sequence[str],
    *,
    step: float,
    slack: float = 0.02,
) -> None:
    """Σ log-prob's gradient against finite differences, for the parameters of each part.

    In fp32: along the gradient itself, where the change is large against rounding.

    Args:
        adapter: of weights other than those that made the decisions.
        parts: parts of parameter names.
        step: how far to go, over the norm of the part's gradient where that is above 1.
        slack: relative error.
    """
    latent, _ = stored(decisions)
    adapter.evaluate(*stack_observations(asked), latent).log_prob.sum().backward()
    named = {k: p for k, p in adapter.trainable().items() if not k.startswith("value_head.")}
    for part in parts:
        gradients = {k: p.grad.clone() for k, p in named.items() if part in k}
        norm = float(torch.cat([g.flatten() for g in gradients.values()]).norm())
        home, scores, width = {k: named[k].detach().clone() for k in gradients}, [], step / max(norm, 1)
        for sign in (1, -1):
            with torch.no_grad():
                for key, gradient in gradients.items():
                    named[key].copy_(home[key] + sign * width * gradient / norm)
            scores.append(float(log_ratio(adapter, asked, decisions).double().sum()))
        with torch.no_grad():
            for key, value in home.items():
                named[key].copy_(value)
        assert (scores[0] - scores[1]) / (2 * width) == pytest.approx(norm, rel=slack), part
