# SPDX-License-Identifier: Apache-2.0
"""The flow likelihood: a slow oracle, and the stock sampler where nothing explores."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.policies.config import FlowSamplerConfig
from accerl_lerobot.policies.flow import FlowFamily, FlowShape

STD = 0.3
CONFIG = FlowSamplerConfig(noise_level=STD)
ROW_MIX = np.array([[0.2, -0.5, 0.3], [0.4, 0.1, -0.2], [-0.3, 0.6, 0.5]])
DIM_MIX = np.array(
    [[0.5, 0.8, -0.4, 0.3], [-0.6, 0.2, 0.7, -0.9], [0.9, -0.5, 0.1, 0.4], [0.2, 0.7, -0.8, 0.6]]
)


def sizes(num_steps: int) -> FlowShape:
    """Three rows of which two are executed, two real dims and two padded ones."""
    return FlowShape(num_steps=num_steps, chunk_size=3, executed=2, padded_dim=4, action_dim=2)


def family(shape: FlowShape, config: FlowSamplerConfig = CONFIG) -> FlowFamily:
    return FlowFamily(SimpleNamespace(shape=shape), config)


def velocity(x: Tensor, t: Tensor) -> Tensor:
    """Every entry feeds back into every other, padded ones and rows that are not executed included."""
    rows, dims = torch.from_numpy(ROW_MIX).to(x), torch.from_numpy(DIM_MIX).to(x)
    return torch.tanh(rows @ x @ dims + t[:, None, None]) + 0.3 * x


def slow_velocity(x: np.ndarray, t: float) -> np.ndarray:
    return np.tanh(ROW_MIX @ x @ DIM_MIX + t) + 0.3 * x


def slow_integrate(x0: np.ndarray, shape: FlowShape) -> np.ndarray:
    """(B, K, D) from initial noise (B, K, D)."""
    n = shape.num_steps
    result = np.zeros(x0.shape)
    for b in range(len(x0)):
        x = x0[b].astype(np.float64)
        for k in range(n):
            x = x - slow_velocity(x, (n - k) / n) / n
        result[b] = x
    return result


def slow_log_prob(x0: np.ndarray, x: np.ndarray, shape: FlowShape) -> np.ndarray:
    """(B,) log-density of x (B, K, D) given the initial noise x0 (B, K, D)."""
    means = slow_integrate(x0, shape)
    result = np.zeros(len(x0))
    for b in range(len(x0)):
        for row in range(shape.executed):
            for dim in range(shape.action_dim):
                z = (float(x[b, row, dim]) - means[b, row, dim]) / STD
                result[b] += -0.5 * z**2 - math.log(STD * math.sqrt(2 * math.pi))
    return result


def draws(shape: FlowShape, count: int = 6, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(shape.num_steps)
    size = (count, shape.chunk_size, shape.padded_dim)
    x0, eps = (torch.randn(size, generator=generator, dtype=dtype) for _ in range(2))
    return x0, eps


def explore_all(x0: Tensor) -> Tensor:
    return torch.ones(len(x0), dtype=torch.bool)


def plain_ode(x: Tensor, num_steps: int) -> Tensor:
    """LeRobot's loop."""
    dt = -1.0 / num_steps
    for step in range(num_steps):
        x = x + dt * velocity(x, torch.tensor(1.0 + step * dt).to(x).expand(len(x)))
    return x


@pytest.mark.parametrize("num_steps", [1, 2, 3, 4])
def test_the_action_and_its_density_are_the_oracle_s(num_steps: int):
    shape = sizes(num_steps)
    x0, eps = draws(shape)
    flow = family(shape)
    _, latent, log_prob = flow.sample(velocity, x0, eps, explore_all(x0))
    x = latent["path"][:, 1]
    expected = slow_log_prob(x0.numpy(), x.numpy(), shape)
    mean = slow_integrate(x0.numpy(), shape)
    assert np.allclose(x.numpy(), mean + STD * eps.numpy(), atol=1e-12)
    assert log_prob.shape == (6, shape.executed)
    assert np.allclose(log_prob.sum(1), expected, atol=1e-10)
    assert torch.allclose(flow.log_prob(velocity, latent), log_prob, rtol=0, atol=1e-12)


@pytest.mark.parametrize("num_steps", [1, 2, 3, 4])
def test_not_exploring_is_the_stock_sampler_bit_for_bit(num_steps: int):
    shape = sizes(num_steps)
    x0, eps = draws(shape, dtype=torch.float32)
    stock = plain_ode(x0, num_steps)
    still, everyone = torch.zeros(6, dtype=torch.bool), explore_all(x0)

    def sample(explore: Tensor) -> tuple[Tensor, Tensor]:
        _, latent, log_prob = family(shape).sample(velocity, x0, eps, explore)
        return latent["path"][:, 1], log_prob

    x, log_prob = sample(still)
    assert torch.equal(x, stock) and not log_prob.any()
    some = torch.tensor([True, False, False, True, False, True])
    (mixed, mixed_log_prob), (exploring, exploring_log_prob) = sample(some), sample(everyone)
    assert torch.equal(mixed[~some], stock[~some]) and torch.equal(mixed[some], exploring[some])
    assert torch.equal(mixed_log_prob[some], exploring_log_prob[some])
    assert not mixed_log_prob[~some].any()
    assert not torch.isclose(exploring[:, :2, :2], stock[:, :2, :2]).any()
