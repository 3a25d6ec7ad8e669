# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""What a policy would do at a dreamt frame, beside what it would do at the real one.

Pixels may be right where nobody looks. So real episodes are dreamt from beginning to end with the actions
that were made, and wherever the policy would have decided it decides twice, with equal noise: on what was
seen, and on what is dreamt by then, the robot's state included.

    alike     R² = 1 − Σ|dreamt − real|² / Σ|real − mean|² of its actions, each in units of its spread

1: it would not notice. 0: no better than if every frame were the average one.

Shapes: M decisions, D depths, K env steps of a chunk, A action dims.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from accerl_lerobot.envs.base import WorldSpec
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Request
from accerl_lerobot.policies.base import PolicyAdapter, check_fit
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.seeds import noise_seed
from accerl_lerobot.world_model import fit
from accerl_lerobot.world_model.contract import WorldModel, WorldModelSpec
from accerl_lerobot.world_model.episodes import Episode, Place
from accerl_lerobot.world_model.frames import observed
from accerl_lerobot.world_model.judge import bootstrap
from accerl_lerobot.world_model.replayed import Replayed, replay

STILL = 1e-6
"""Standard deviation below which an action never varies, and is left out."""
BATCH = 64
"""Decisions at a time."""


class Decided(NamedTuple):
    """Of one policy, at M moments; see `decide_twice`."""

    real: np.ndarray
    """float32 (M, K, A), on what was seen."""
    dreamt: np.ndarray
    """float32 (M, K, A), on what was dreamt."""
    episode: np.ndarray
    """int64 (M,), of which episode each is."""
    depth: np.ndarray
    """int64 (M,), chunks dreamt by then, from 1."""


def as_world(spec: WorldModelSpec) -> WorldSpec:
    """A world that shows what a world model does."""
    bound = np.full(spec.action_dim, np.inf, np.float32)
    return WorldSpec(
        images=dict.fromkeys(spec.cameras, (*spec.image_size, 3)),
        state_dim=spec.state_dim,
        action_dim=spec.action_dim,
        action_low=-bound,
        action_high=bound,
        fps=spec.fps,
        max_steps=1,
        tasks=spec.tasks,
    )


def check_policies(paths: Sequence[str], spec: WorldModelSpec) -> None:
    """Refuses policies that cannot act in the dreams of such a world model, before anything is tried.

    Raises:
        InputError: one of them cannot, or is no checkpoint; the field is ``policies``.
    """
    from accerl_lerobot.policies.loading import load_lerobot_config

    world = as_world(spec)
    for path in paths:
        try:
            settings = load_lerobot_config(PolicyConfig(path=path, device="cpu"))
            check_fit(settings, world, {})
            fit.check_fit(spec, world, getattr(settings, "n_action_steps", 1), settings.n_obs_steps, True)
        except InputError as error:
            raise InputError("policies", path, f"{error.value}: {error.remedy}") from error


def replayed_whole(model: WorldModel, episodes: Sequence[Episode]) -> Replayed:
    """Dreams of them from beginning to end with the actions that were made."""
    depth = max(-(-len(episode) // model.spec.chunk) for episode in episodes)
    return replay(model, episodes, [Place(e, 0) for e in range(len(episodes))], depth)


def decide_twice(policy: PolicyAdapter, spec: WorldModelSpec, of: Replayed) -> Decided:
    """Has a policy decide on what was seen and on what was dreamt, wherever there was something to decide.

    Args:
        policy: answers with LeRobot's own sampler.
        spec: of the world model.
        of: see `replayed_whole`.
    """
    # After a chunk that another one has followed.
    rows, depths = np.nonzero(of.made[:, 1:])
    windows, world = of.windows, as_world(spec)
    seen = windows.context + depths
    frames = {"real": windows.frames[rows, seen], "dreamt": of.dreams.frames[rows, depths]}
    robot = {"real": windows.state[rows, seen], "dreamt": of.dreams.robot[rows, depths]}
    said: dict[str, list[np.ndarray]] = {name: [] for name in frames}
    for name, decisions in said.items():
        for start in range(0, len(rows), BATCH):
            requests = [
                Request(
                    observation=observed(frames[name][i], robot[name][i], windows.task[rows[i]], spec, world),
                    noise_seed=noise_seed(int(rows[i]), 0, int(depths[i])),
                    explore=False,
                )
                for i in range(start, min(start + BATCH, len(rows)))
            ]
            decisions += [decision.chunk[: spec.chunk] for decision in policy.decide(requests, 0)]
    empty = np.zeros((0, spec.chunk, spec.action_dim), np.float32)
    real, dreamt = (np.stack(said[name]) if len(rows) else empty for name in ("real", "dreamt"))
    return Decided(real, dreamt, windows.episode[rows], depths + 1)


def alike(every: Sequence[Decided]) -> dict[str, Any]:
    """How alike policies decide, all of them taken together, with bootstraps over episodes.

    Returns:
        ``first``, ``last`` (after one chunk, and in the later half of the depths) and ``whole`` (all) as
        estimates, NaN where nothing varied; ``policies`` and ``decisions``, how many.
    """
    wrong, spread = [], []
    for one in every:
        if not len(one.real):
            continue
        real, dreamt = (part.reshape(len(part), -1).astype(np.float64) for part in (one.real, one.dreamt))
        unit = real.std(0)
        varied = unit > STILL
        wrong.append(np.square((dreamt - real)[:, varied] / unit[varied]).sum(1))
        spread.append(np.square((real - real.mean(0))[:, varied] / unit[varied]).sum(1))
    depth = np.concatenate([one.depth for one in every])
    groups = np.concatenate([one.episode for one in every])
    off, usual = (np.concatenate([np.zeros(0), *part]) for part in (wrong, spread))
    half = float(depth.max(initial=0)) / 2

    def estimate(chosen: np.ndarray) -> dict[str, float]:
        rows = np.flatnonzero(chosen)

        def of(drawn: np.ndarray) -> float:
            total = float(usual[rows[drawn]].sum())
            return 1 - float(off[rows[drawn]].sum()) / total if total > 0 else float("nan")

        return bootstrap(groups[rows], of)._asdict()

    return {
        "first": estimate(depth == 1),
        "last": estimate(depth > half),
        "whole": estimate(depth > 0),
        "policies": len(every),
        "decisions": len(depth),
    }
