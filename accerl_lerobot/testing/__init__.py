# SPDX-License-Identifier: Apache-2.0
"""Checks of a policy's likelihood, for the tests of a package that has a policy of its own.

Example:
    ::

        from accerl_lerobot.testing import check_policy

        def test_likelihood(checkpoint: Path):
            check_policy(checkpoint, [observation, another])

`check_policy` does all of them; the others are its parts, for a policy that needs other steps or tolerances.
Each raises AssertionError.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from accerl_lerobot.experience import Decision, Observation, Request, stack_observations, stacked
from accerl_lerobot.policies.adapter import LeRobotAdapter, PolicyAdapter
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.loading import load_adapter

TOLERANCE = 1e-4
"""|ρ − 1| of a whole chunk at equal weights, in fp32 on any CPU; found are 1e-7 to 2e-5. Also the error of
other numbers, relative to the largest of their kind."""
BATCH = 12  # decisions that are compared in batches of several sizes
MOVED = 0.5  # std of log ρ between the two policies of `check_importance`
STEPS_MOST = 100  # small steps of the weights until log ρ varies by that much
DEVIATIONS = 5.0  # standard errors between two estimates; one in two million is further off by chance


def check_policy(policy: PolicyConfig | Path | str, observations: Sequence[Observation]) -> None:
    """Checks what training rests on.

    1. Decisions do not depend on their batch, and ρ = 1 at equal weights.
    2. Without exploration, the policy acts as LeRobot's own sampler does.
    3. What is saved and loaded is the same policy.
    4. The log-prob is the density of what is executed: E_μ[ρ f(a)] = E_π[f(a)].
    5. Its gradient is that of finite differences, and reaches every trained weight.

    `policy` is a checkpoint's folder, or how to load it, and a small one: it decides some 20,000 times.
    `observations` are two or more, as the environment gives them.
    """
    if not isinstance(policy, PolicyConfig):
        policy = PolicyConfig(path=str(policy), device="cpu")
    adapter = load_adapter(policy)
    perturb(adapter, 0.1)  # heads start at zero, where only their output layers have a gradient
    asked = []
    for i in range(BATCH):
        observation = observations[i % len(observations)]
        asked.append(Request(observation=observation, noise_seed=i))
    check_batches(adapter, asked, few=4)
    check_stock_sampler(adapter, asked)
    with tempfile.TemporaryDirectory() as folder:
        check_saved(adapter, asked, policy, Path(folder) / "pretrained_model")
    check_importance(adapter, observations[0])
    decisions = adapter.decide(asked, 0)
    perturb(adapter, 0.02, seed=1)
    check_gradient(adapter, asked, decisions)


def check_batches(adapter: PolicyAdapter, asked: Sequence[Request], few: int) -> list[Decision]:
    """ρ = 1 whichever batch decides and whichever re-scores, and equal decisions; those made together.

    The weights must not be fresh; `asked` are at least ten, of which a `few` are decided alone.
    """
    together = adapter.decide(asked, 7)
    alone = [adapter.decide([request], 7)[0] for request in asked[:few]]
    check_alike(alone, together[:few])
    check_alike(adapter.decide(asked[::-1], 7)[::-1], together)
    check_ratio_one(adapter, asked, together)
    check_ratio_one(adapter, asked, [*alone, *together[few:]])
    check_ratio_one(adapter, asked[7:10], together[7:10])
    return together


def check_ratio_one(adapter: PolicyAdapter, asked: Sequence[Request], decisions: Sequence[Decision]) -> None:
    """ρ = 1 for weights that made the decisions, in batches of any size."""
    ratio = log_ratio(adapter, asked, decisions).exp()
    off = (ratio - 1).abs().max()
    assert off <= TOLERANCE, f"at equal weights |ρ − 1| is {off:.2e}, above {TOLERANCE}"


def check_alike(found: Sequence[Decision], expected: Sequence[Decision]) -> None:
    """Chunks and latents are equal but for rounding."""
    mine, _ = stored(found)
    theirs, _ = stored(expected)
    mine["chunk"] = _chunks(found)
    theirs["chunk"] = _chunks(expected)
    for name, tensor in theirs.items():
        error = (mine[name] - tensor).abs().max()
        largest = tensor.abs().max()
        most = TOLERANCE * largest if tensor.is_floating_point() else 0
        where = f"{name} is off by {error:.2e} where the largest is {largest:.2e}"
        assert error <= most, f"of two decisions on one request, {where}"


def check_stock_sampler(adapter: LeRobotAdapter, asked: Sequence[Request]) -> None:
    """Without exploration: LeRobot's own sampler on equal noise, and nothing that could be scored."""
    adapter.self_check(*stack_observations(asked))
    decisions = adapter.decide([replace(request, explore=False) for request in asked], 0)
    rows = len(decisions[0].chunk)
    expected = adapter.policy.config.n_action_steps
    assert rows == expected, f"the adapter executes {rows} rows, not n_action_steps={expected} of its policy"
    assert not any(d.log_prob.any() for d in decisions), "without exploration, log-probs must be 0"


def check_saved(
    adapter: LeRobotAdapter, asked: Sequence[Request], config: PolicyConfig, directory: Path
) -> LeRobotAdapter:
    """ρ = 1 for decisions, each made alone, re-scored by what was saved and loaded, which is returned.

    The adapter, which `config` loaded, must have weights other than its checkpoint's; `directory` is new.
    """
    decisions = [adapter.decide([request], 0)[0] for request in asked]
    adapter.save(directory)
    loaded = load_adapter(replace(config, path=str(directory), revision=None))
    check_ratio_one(loaded, asked, decisions)
    check_alike(loaded.decide(asked, 0), decisions)
    return loaded


def check_importance(adapter: PolicyAdapter, observation: Observation, samples: int = 4096) -> None:
    """Decisions of μ weighted by ρ are decisions of π: E_μ[ρ] = 1, and E_μ[ρ a] = E_π[a] for each action.

    μ and π are the adapter before and after its weights are moved. Equal seeds give μ and π equal noise, so
    that the difference of two means has a small error: E_μ[(ρ − 1) a] − (E_π[a] − E_μ[a]) is tested.
    """
    asked = [Request(observation=observation, noise_seed=i) for i in range(samples)]
    before = adapter.decide(asked, 0)
    for _ in range(STEPS_MOST):
        perturb(adapter, 0.02, seed=2)
        if log_ratio(adapter, asked[:256], before[:256]).std() > MOVED:
            break
    else:
        raise AssertionError(f"log ρ does not change by {MOVED} when the weights do")
    ratio = log_ratio(adapter, asked, before).double().exp()
    weight = ratio[:, None] - 1
    old = _chunks(before).double().flatten(1)
    new = _chunks(adapter.decide(asked, 0)).double().flatten(1)
    weighted = weight * (old - old.mean(0))
    apart = torch.cat([weight, weighted - (new - old)], 1)
    error = apart.std(0) / math.sqrt(samples)
    deviations = apart.mean(0).abs() / error.clamp(min=1e-12)
    worst = float(deviations.max())
    hint = "the log-prob is not that of the actions that are executed"
    assert worst <= DEVIATIONS, f"E_μ[ρ f(a)] and E_π[f(a)] are {worst:.1f} standard errors apart: {hint}"


def check_gradient(
    adapter: PolicyAdapter,
    asked: Sequence[Request],
    decisions: Sequence[Decision],
    parts: Sequence[str] = ("",),
    *,
    step: float = 0.01,
    slack: float = 0.05,
) -> None:
    """Σ log-prob's gradient against finite differences, for the parameters whose names have a part.

    In fp32: `step` along the gradient itself, over its norm where that is above 1, so that the change is
    large against rounding; `slack` is the relative error. The weights must not be those that decided.
    """
    latent, _ = stored(decisions)
    adapter.evaluate(*stack_observations(asked), latent).log_prob.sum().backward()
    named = {k: p for k, p in adapter.trainable().items() if not k.startswith("value_head.")}
    silent = [k for k, p in named.items() if p.grad is None or not p.grad.abs().max() > 0]
    assert not silent, f"the log-prob does not depend on {silent[:3]}; name them in the model's `idle`"
    for part in parts:
        gradients = {k: p.grad.clone() for k, p in named.items() if part in k}
        norm = float(torch.cat([g.flatten() for g in gradients.values()]).norm())
        home = {k: named[k].detach().clone() for k in gradients}
        scores = []
        width = step / max(norm, 1)
        with torch.no_grad():
            for sign in (1, -1):
                for key, gradient in gradients.items():
                    named[key].copy_(home[key] + sign * width * gradient / norm)
                score = log_ratio(adapter, asked, decisions).double().sum()
                scores.append(float(score))
            for key, value in home.items():
                named[key].copy_(value)
        found = (scores[0] - scores[1]) / (2 * width)
        wrong = f"the log-prob rises by {found:.4g} along its gradient, whose norm is {norm:.4g}"
        assert math.isclose(found, norm, rel_tol=slack), f"{part or 'all parameters'}: {wrong}"


def perturb(adapter: PolicyAdapter, scale: float, seed: int = 0) -> None:
    """Moves every trainable weight at random, relative to its size."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in adapter.trainable().values():
            size = parameter.abs().mean() + 1e-3
            noise = torch.randn(parameter.shape, generator=generator)
            parameter += scale * size * noise.to(parameter.device)


def stored(decisions: Sequence[Decision]) -> tuple[dict[str, Tensor], Tensor]:
    """(latents, log-probs (B, L)) of decisions, as a batch."""
    latent = stacked([decision.latent for decision in decisions])
    log_prob = np.stack([decision.log_prob for decision in decisions])
    return {name: torch.from_numpy(rows) for name, rows in latent.items()}, torch.from_numpy(log_prob)


def log_ratio(adapter: PolicyAdapter, asked: Sequence[Request], decisions: Sequence[Decision]) -> Tensor:
    """log ρ (B,) of whole chunks, re-scored in one batch without gradient."""
    latent, old = stored(decisions)
    with torch.no_grad():
        new = adapter.evaluate(*stack_observations(asked), latent).log_prob.cpu()
    assert new.shape == old.shape, f"log-probs of shape {tuple(new.shape)}, which acted as {tuple(old.shape)}"
    return (new - old).sum(1)


def _chunks(decisions: Sequence[Decision]) -> Tensor:
    return torch.from_numpy(np.stack([decision.chunk for decision in decisions]))
