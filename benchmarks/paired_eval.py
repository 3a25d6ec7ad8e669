# SPDX-License-Identifier: Apache-2.0
"""Policies in an environment and in its world model, from the same starts and with the same noise.

Two questions: does the policy that succeeds more often in imagination succeed more often in reality? And do
imagination and reality agree about one policy, start by start? The first is what choosing between policies
needs, the second what learning needs.

Shapes: P policies, N starts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from accerl_lerobot.envs.base import World
from accerl_lerobot.experience import Observation, Request
from accerl_lerobot.policies.adapter import PolicyAdapter
from accerl_lerobot.seeds import noise_seed
from accerl_lerobot.world_model.contract import Context
from accerl_lerobot.world_model.data import model_arrays, policy_observation
from accerl_lerobot.world_model.metrics import Estimate, ranks
from accerl_lerobot.world_model.registry import ImaginationModels
from accerl_lerobot.world_model.success_plugin.modeling_success_pairs import probabilities

Start = tuple[str, int]
"""Task and seed of `World.reset`."""
DRAWS = 1000
"""Bootstrap resamples."""


def rollout_real(
    policy: PolicyAdapter,
    worlds: Sequence[World],
    starts: Sequence[Start],
    on_episode: Callable[[int], object] = lambda ended: None,
) -> np.ndarray:
    """Success of each start in the environment, bool (N,), with LeRobot's own sampler.

    Args:
        policy: decides for all environments at once.
        worlds: as many episodes run at a time.
        starts: of the episodes.
        on_episode: receives the number of ended episodes.
    """
    success = np.zeros(len(starts), bool)
    waiting = list(range(len(starts)))[::-1]
    playing: dict[int, tuple[int, int, Observation]] = {}
    while waiting or playing:
        for slot, world in enumerate(worlds):
            if slot not in playing and waiting:
                i = waiting.pop()
                playing[slot] = (i, 0, world.reset(starts[i][1], starts[i][0]))
        requests = [_request(o, starts[i], step) for i, step, o in playing.values()]
        decisions = policy.decide(requests, 0)
        for (slot, (i, step, _)), decision in zip(list(playing.items()), decisions, strict=True):
            result = worlds[slot].step_chunk(decision.chunk)
            playing[slot] = (i, step + 1, result.observation)
            if result.done:
                success[i] = result.success
                del playing[slot]
                on_episode(len(starts) - len(waiting) - len(playing))
    return success


def rollout_imagined(
    policy: PolicyAdapter, models: ImaginationModels, world: World, starts: Sequence[Start], batch: int = 32
) -> np.ndarray:
    """The highest P(success) of each start in imagination, float64 (N,).

    A rollout succeeds by any threshold below it, as nothing depends on the threshold before the success. So
    all are imagined to the time limit.

    Args:
        policy: as in `rollout_real`.
        models: world model and success model.
        world: shows the first observations; no action is executed in it.
        starts: of the rollouts.
        batch: rollouts at a time.
    """
    parts = [starts[i : i + batch] for i in range(0, len(starts), batch)]
    return np.concatenate([_imagine(policy, models, world, part) for part in parts])


def _imagine(
    policy: PolicyAdapter, models: ImaginationModels, world: World, starts: Sequence[Start]
) -> np.ndarray:
    model, success = models
    assert success is not None
    spec, count = model.spec, len(starts)
    observations = [world.reset(seed, task) for task, seed in starts]
    tasks = [str(o["task"]) for o in observations]
    keys = [k for k in observations[0] if k != "task"]
    arrays = {k: np.stack([np.asarray(o[k]) for o in observations]) for k in keys}
    frames, robot = model_arrays(arrays, spec)
    state = model.begin(
        Context(
            frames=torch.from_numpy(frames)[:, None].repeat(1, spec.context, 1, 1, 1, 1),
            robot=torch.from_numpy(robot)[:, None].repeat(1, spec.context, 1),
            actions=torch.zeros(count, spec.context - 1, spec.chunk, spec.action_dim),
            commanded_sum=torch.zeros(count, spec.action_dim),
            initial_state=torch.from_numpy(robot),
        ),
        tasks,
    )
    low, high = world.spec.action_low, world.spec.action_high
    highest = np.zeros(count)
    for step in range(math.ceil(world.spec.max_steps / spec.chunk)):
        requests = [_request(o, s, step) for o, s in zip(observations, starts, strict=True)]
        decisions = policy.decide(requests, 0)
        actions = np.stack([np.clip(d.chunk, low, high) for d in decisions]).astype(np.float32)
        seeds = [noise_seed(seed, 1, step) for _, seed in starts]
        prediction = model.step(state, torch.from_numpy(actions), seeds)
        after, robots = prediction.frames.cpu().numpy(), prediction.robot.cpu().numpy()
        highest = np.maximum(highest, probabilities(success, frames, after))
        observations = [
            policy_observation(after[row], robots[row], tasks[row], spec, world.spec) for row in range(count)
        ]
        state, frames = prediction.state, after
    return highest


def _request(observation: Observation, start: Start, step: int) -> Request:
    return Request(observation=observation, noise_seed=noise_seed(start[1], 0, step), explore=False)


def agreement(real: np.ndarray, imagined: np.ndarray, seed: int = 0) -> dict[str, Any]:
    """Agreement of outcomes, bool (P, N) each, with 95 % percentile bootstraps over policies and starts.

    Returns:
        Estimates as dicts: ``pearson`` and ``spearman`` of the P rates; ``mmrv``, see there; ``bias``, the
        mean of imagined less real rates; ``slope`` of the real rate over the imagined one; ``mcc``, the mean
        over policies of `matthews`. A number that cannot be had is NaN.

    Raises:
        ValueError: the arrays are not of the same policies and starts, or there are none.
    """
    if real.shape != imagined.shape or real.ndim != 2 or not real.size:
        raise ValueError(f"outcomes {real.shape} and {imagined.shape}: both must be (P, N)")
    rng = np.random.default_rng(seed)
    values = _statistics(real, imagined)
    policies, starts = real.shape
    draws = []
    for _ in range(DRAWS):
        rows, columns = rng.integers(policies, size=policies), rng.integers(starts, size=starts)
        draws.append(_statistics(real[rows][:, columns], imagined[rows][:, columns]))
    return {
        name: _estimate(value, [draw[name] for draw in draws])._asdict() for name, value in values.items()
    }


def even_threshold(real: np.ndarray, scores: np.ndarray) -> float:
    """The threshold at which about as many rollouts succeed in imagination as in reality, over all policies.

    Args:
        real: bool (P, N), outcomes.
        scores: float (P, N), the highest P(success) of each imagined rollout.

    Returns:
        In [0, 1], in the middle between two scores, or between one and an end of that range.
    """
    values = np.concatenate([[0.0], np.unique(scores), [1.0]])
    cuts = (values[1:] + values[:-1]) / 2
    above = (scores.reshape(-1, 1) > cuts).sum(0)
    return float(cuts[np.argmin(np.abs(above - real.sum()))])


def pearson(x: np.ndarray, y: np.ndarray) -> float:
    """Correlation; NaN where one of them does not vary."""
    x, y = x - x.mean(), y - y.mean()
    size = float(np.sqrt((x * x).sum() * (y * y).sum()))
    return float((x * y).sum() / size) if size > 1e-12 else float("nan")


def spearman(x: np.ndarray, y: np.ndarray) -> float:
    """Correlation of ranks; ties have their mean rank."""
    return pearson(ranks(x), ranks(y))


def mmrv(real: np.ndarray, imagined: np.ndarray) -> float:
    """Mean maximum rank violation of rates (P,) (Li et al. 2024, SIMPLER, arXiv 2405.05941); 0 is best.

    For each policy: the largest real difference to one that imagination puts on the wrong side of it.
    """
    apart = np.abs(real[:, None] - real[None])
    wrong = (real[:, None] < real[None]) != (imagined[:, None] < imagined[None])
    return float((apart * wrong).max(1).mean())


def matthews(real: np.ndarray, imagined: np.ndarray) -> float:
    """Matthews' correlation of outcomes (N,); NaN where one of them does not vary."""
    return pearson(real.astype(np.float64), imagined.astype(np.float64))


def _statistics(real: np.ndarray, imagined: np.ndarray) -> dict[str, float]:
    real_rates, imagined_rates = real.mean(1), imagined.mean(1)
    within = [matthews(r, d) for r, d in zip(real, imagined, strict=True)]
    known = [x for x in within if not np.isnan(x)]
    centred = imagined_rates - imagined_rates.mean()
    spread = float(np.square(centred).sum())
    joint = float((centred * (real_rates - real_rates.mean())).sum())
    return {
        "pearson": pearson(imagined_rates, real_rates),
        "spearman": spearman(imagined_rates, real_rates),
        "mmrv": mmrv(real_rates, imagined_rates),
        "bias": float((imagined_rates - real_rates).mean()),
        "slope": joint / spread if spread > 1e-12 else float("nan"),
        "mcc": float(np.mean(known)) if known else float("nan"),
    }


def _estimate(value: float, draws: list[float]) -> Estimate:
    known = np.array([x for x in draws if not np.isnan(x)])
    low, high = np.quantile(known, [0.025, 0.975]) if len(known) else (np.nan, np.nan)
    return Estimate(value, float(low), float(high))
