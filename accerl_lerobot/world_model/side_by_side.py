# SPDX-License-Identifier: Apache-2.0
"""A policy in a world and in dreams of it, from the same starts and with the same noise.

Shapes: N starts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch

from accerl_lerobot.envs.base import World
from accerl_lerobot.experience import Observation, Request
from accerl_lerobot.policies.adapter import PolicyAdapter
from accerl_lerobot.seeds import noise_seed
from accerl_lerobot.world_model.contract import Context
from accerl_lerobot.world_model.frames import observed, seen
from accerl_lerobot.world_model.imagine import Dreamer
from accerl_lerobot.world_model.success import probabilities

Start = tuple[str, int]
"""Task and seed of `World.reset`."""


def lived(
    policy: PolicyAdapter,
    worlds: Sequence[World],
    starts: Sequence[Start],
    on_episode: Callable[[int], object] = lambda ended: None,
) -> np.ndarray:
    """Success of each start in reality, bool (N,), with LeRobot's own sampler.

    Args:
        policy: decides for all worlds at once.
        worlds: as many episodes at a time.
        starts: of the episodes.
        on_episode: told how many have ended.
    """
    success = np.zeros(len(starts), bool)
    waiting = list(range(len(starts)))[::-1]
    playing: dict[int, tuple[int, int, Observation]] = {}
    while waiting or playing:
        for slot, world in enumerate(worlds):
            if slot not in playing and waiting:
                i = waiting.pop()
                playing[slot] = (i, 0, world.reset(starts[i][1], starts[i][0]))
        requests = [_request(o, starts[i], made) for i, made, o in playing.values()]
        decisions = policy.decide(requests, 0)
        for (slot, (i, made, _)), decision in zip(list(playing.items()), decisions, strict=True):
            result = worlds[slot].step_chunk(decision.chunk)
            playing[slot] = (i, made + 1, result.observation)
            if result.done:
                success[i] = result.success
                del playing[slot]
                on_episode(len(starts) - len(waiting) - len(playing))
    return success


def dreamt(
    policy: PolicyAdapter, dreamer: Dreamer, world: World, starts: Sequence[Start], batch: int = 32
) -> np.ndarray:
    """The highest P(success) of each start in dreams, float64 (N,).

    What lies above a threshold is what would succeed by it: until a dream succeeds nothing in it depends on
    where that is. So all are dreamt to the world's time limit.

    Args:
        policy: decides, as in `lived`.
        dreamer: dreams, and tells successes.
        world: shows the first observations; nothing is done in it.
        starts: of the dreams.
        batch: dreams at a time.
    """
    parts = [starts[i : i + batch] for i in range(0, len(starts), batch)]
    return np.concatenate([_dreamt(policy, dreamer, world, part) for part in parts])


def _dreamt(policy: PolicyAdapter, dreamer: Dreamer, world: World, starts: Sequence[Start]) -> np.ndarray:
    model, judge = dreamer
    assert judge is not None
    spec, count = model.spec, len(starts)
    observations = [world.reset(seed, task) for task, seed in starts]
    tasks = [str(o["task"]) for o in observations]
    keys = [k for k in observations[0] if k != "task"]
    frames, robot = seen({k: np.stack([np.asarray(o[k]) for o in observations]) for k in keys}, spec)
    state = model.begin(
        Context(
            frames=torch.from_numpy(frames)[:, None].repeat(1, spec.context, 1, 1, 1, 1),
            robot=torch.from_numpy(robot)[:, None].repeat(1, spec.context, 1),
            actions=torch.zeros(count, spec.context - 1, spec.chunk, spec.action_dim),
            told=torch.zeros(count, spec.action_dim),
            first=torch.from_numpy(robot),
        ),
        tasks,
    )
    low, high = world.spec.action_low, world.spec.action_high
    highest = np.zeros(count)
    for made in range(math.ceil(world.spec.max_steps / spec.chunk)):
        decisions = policy.decide(
            [_request(o, s, made) for o, s in zip(observations, starts, strict=True)], 0
        )
        actions = np.stack([np.clip(d.chunk, low, high) for d in decisions]).astype(np.float32)
        dream = model.step(
            state, torch.from_numpy(actions), [noise_seed(seed, 1, made) for _, seed in starts]
        )
        after, robots = dream.frames.cpu().numpy(), dream.robot.cpu().numpy()
        highest = np.maximum(highest, probabilities(judge, frames, after))
        observations = [
            observed(after[row], robots[row], tasks[row], spec, world.spec) for row in range(count)
        ]
        state, frames = dream.state, after
    return highest


def _request(observation: Observation, start: Start, made: int) -> Request:
    return Request(observation=observation, noise_seed=noise_seed(start[1], 0, made), explore=False)
