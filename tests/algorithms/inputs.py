# SPDX-License-Identifier: Apache-2.0
"""Batches the loss tests share."""

from __future__ import annotations

from typing import Any

import torch

from accerl_lerobot.algorithms import LossInputs


def make_inputs(
    n: int = 12, factors: int = 3, spread: float = 0.4, seed: int = 0, **replace: Any
) -> LossInputs:
    """Random float64 batch; `spread` is the standard deviation of log ρ per factor."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    old = normal(n, factors)
    fields: dict[str, Any] = {
        "log_prob_old": old,
        "log_prob_new": (old + spread * normal(n, factors)).requires_grad_(),
        "advantage": normal(n),
        "value": normal(n).requires_grad_(),
        "returns": normal(n),
        "entropy": normal(n).abs().requires_grad_(),
    }
    return LossInputs(**{**fields, **replace})


def one(log_ratio: float, advantage: float) -> LossInputs:
    """A single decision with one factor; log-probs are relative to μ's."""
    zero = torch.zeros(1, dtype=torch.float64)
    new = torch.tensor([[log_ratio]], dtype=torch.float64, requires_grad=True)
    return LossInputs(
        log_prob_new=new,
        log_prob_old=torch.zeros(1, 1, dtype=torch.float64),
        advantage=torch.tensor([advantage], dtype=torch.float64),
        value=zero,
        returns=zero,
        entropy=zero,
    )


def gradient(inputs: LossInputs, loss: torch.Tensor) -> torch.Tensor:
    """∂ loss / ∂ log π, (N, L)."""
    (result,) = torch.autograd.grad(loss, inputs.log_prob_new, retain_graph=True)
    return result
