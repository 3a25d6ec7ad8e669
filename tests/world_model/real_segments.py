# SPDX-License-Identifier: Apache-2.0
"""Real experience of the simulated environment, played at random."""

from __future__ import annotations

import numpy as np

from accerl_lerobot.envs import SimulatedConfig, make_environment
from accerl_lerobot.experience import Decision, Segment
from accerl_lerobot.rollout.runner import ActiveEpisode, EpisodePlan
from accerl_lerobot.world_model.contract import WorldModelSpec

K = 4
WORLD = SimulatedConfig(max_steps=16, image_size=16, hold=6, tolerance=0.2)
SPEC = WorldModelSpec(
    cameras=("observation.images.front",),
    image_size=(16, 16),
    state_dim=4,
    action_dim=2,
    chunk=K,
    context=2,
    fps=80,
)


def decided(chunk: np.ndarray, version: int = 0) -> Decision:
    return Decision(
        chunk=chunk.astype(np.float32),
        latent={"x": chunk.ravel().astype(np.float32)},
        log_prob=np.zeros(1, np.float32),
        version=version,
    )


def real_episode(seed: int, *, length: int = 8, solve_at: int = 99) -> list[Segment]:
    """An episode of random chunks, which are right from decision `solve_at` on."""
    environment = make_environment(WORLD)
    rng = np.random.default_rng(seed)
    plan = EpisodePlan(task="match", seed=seed, explore=True)
    episode = ActiveEpisode(plan, environment.spec.max_steps, [environment.reset(seed, "match")])
    segments: list[Segment] = []
    for t in range(99):
        chunk = rng.uniform(-0.2, 0.2, (K, 2)).astype(np.float32)
        if t >= solve_at:
            chunk = np.repeat(environment.solution[None], K, 0)  # type: ignore[attr-defined]
        result = environment.step_chunk(chunk)
        reward = float(result.rewards.sum()) - 0.01
        episode.add(decided(chunk), chunk, reward, result.steps, result.observation)
        if result.done or len(episode.taken) == length:
            key = f"{seed}.{len(segments)}"
            segments.append(episode.cut(key, result.done, result.success))
        if result.done:
            break
    return segments
