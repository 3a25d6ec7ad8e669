# SPDX-License-Identifier: Apache-2.0
"""A policy's decisions at dreamt frames, beside those at the real ones.

Pixels may be right where nobody looks. So real episodes are dreamt from beginning to end with the actions
that were made, and wherever the policy would have decided it decides twice: on what was seen, and on what is
dreamt by then, the robot's state included. All its decisions have the same noise, so that what differs
between them is what it was shown. Reality is shown at the world model's resolution as well.

    alike     R² = 1 − Σ|dreamt − real|² / Σ|real − mean|² of its actions, each in units of its spread, with
              the mean over the real frames at the same depth

1: it would not notice. 0: no better than if every frame were the average one of its depth.

Shapes: M decisions, D depths, K env steps of a chunk, A action dims.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from accerl_lerobot.envs.base import WorldSpec
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Request
from accerl_lerobot.policies.base import PolicyAdapter
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.features import check_features, env_features, policy_features
from accerl_lerobot.world_model import fit
from accerl_lerobot.world_model.contract import WorldModel, WorldModelSpec
from accerl_lerobot.world_model.episodes import Episode, Place, longest
from accerl_lerobot.world_model.frames import observed
from accerl_lerobot.world_model.judge import bootstrap
from accerl_lerobot.world_model.replayed import Replayed, replay

STILL = 1e-6
"""Standard deviation below which an action never varies, and is left out."""
BATCH = 64
"""Decisions at a time."""


class Decided(NamedTuple):
    """Decisions of one policy, at M moments; see `decide_twice`."""

    real: np.ndarray
    """float32 (M, K, A), on what was seen."""
    dreamt: np.ndarray
    """float32 (M, K, A), on what was dreamt."""
    episode: np.ndarray
    """int64 (M,), of which episode each is."""
    depth: np.ndarray
    """int64 (M,), chunks dreamt by then, from 1."""


def as_world(spec: WorldModelSpec, settings: Any) -> WorldSpec:
    """A world that shows what a world model does, in the sizes that a policy has learnt from.

    Args:
        spec: of the world model.
        settings: LeRobot's config of the policy.
    """
    wanted = {camera: tuple(feature.shape[1:]) for camera, feature in settings.image_features.items()}
    images = {camera: (*wanted.get(camera, spec.image_size), 3) for camera in spec.cameras}
    bound = np.full(spec.action_dim, np.inf, np.float32)
    return WorldSpec(
        images=images,
        state_dim=spec.state_dim,
        action_dim=spec.action_dim,
        action_low=-bound,
        action_high=bound,
        fps=spec.fps,
        max_steps=1,
        tasks=spec.tasks,
    )


def check_policies(paths: Sequence[str], spec: WorldModelSpec) -> list[WorldSpec]:
    """Refuses policies that cannot act in the dreams of such a world model, before anything is tried.

    Returns:
        `as_world` of each.

    Raises:
        InputError: one of them cannot, or is no checkpoint; the field is ``policies``.
    """
    from accerl_lerobot.policies.loading import rehearsed_config

    worlds = []
    for path in paths:
        with _named(path):
            settings = rehearsed_config(PolicyConfig(path=path))
            worlds.append(as_world(spec, settings))
            check_features(policy_features(settings), env_features(worlds[-1]), {}, "policy.path", path)
            executed = getattr(settings, "n_action_steps", 1)
            fit.check_fit(spec, worlds[-1], executed, settings.n_obs_steps, True)
    return worlds


def load_policy(path: str) -> PolicyAdapter:
    """One of those that are fit.

    Raises:
        InputError: its weights cannot be read; the field is ``policies``.
    """
    from accerl_lerobot.policies.loading import load_adapter

    with _named(path):
        return load_adapter(PolicyConfig(path=path))


@contextmanager
def _named(path: str) -> Iterator[None]:
    try:
        yield
    except InputError as error:
        raise InputError("policies", path, f"{error.value}: {error.remedy}") from error


def replayed_whole(model: WorldModel, episodes: Sequence[Episode]) -> Replayed:
    """Dreams of them from beginning to end with the actions that were made."""
    at = [Place(e, 0) for e in range(len(episodes))]
    return replay(model, episodes, at, longest(episodes, model.spec.chunk))


def decide_twice(policy: PolicyAdapter, spec: WorldModelSpec, world: WorldSpec, of: Replayed) -> Decided:
    """Has a policy decide on what was seen and on what was dreamt, wherever there was something to decide.

    Args:
        policy: answers with LeRobot's own sampler.
        spec: of the world model.
        world: see `as_world`.
        of: see `replayed_whole`.
    """
    # After a chunk that another one has followed.
    rows, depths = np.nonzero(of.made[:, 1:])
    windows = of.windows
    seen = windows.context + depths
    frames = {"real": windows.frames[rows, seen], "dreamt": of.dreams.frames[rows, depths]}
    robot = {"real": windows.state[rows, seen], "dreamt": of.dreams.robot[rows, depths]}
    said: dict[str, list[np.ndarray]] = {name: [] for name in frames}
    for name, decisions in said.items():
        for start in range(0, len(rows), BATCH):
            requests = [
                Request(
                    observation=observed(frames[name][i], robot[name][i], windows.task[rows[i]], spec, world),
                    noise_seed=0,
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
        ``first`` (after one chunk) and ``whole`` (at every depth) as estimates, NaN where nothing varied;
        ``policies`` and ``decisions``, how many.
    """
    wrong, spread = [np.zeros(0)], [np.zeros(0)]
    for one in every:
        if not len(one.real):
            continue
        real, dreamt = (part.reshape(len(part), -1).astype(np.float64) for part in (one.real, one.dreamt))
        depths = np.unique(one.depth, return_inverse=True)[1]
        mean = np.stack([real[depths == d].mean(0) for d in range(depths.max() + 1)])[depths]
        unit = real.std(0)
        varied = unit > STILL
        wrong.append(np.square((dreamt - real)[:, varied] / unit[varied]).sum(1))
        spread.append(np.square((real - mean)[:, varied] / unit[varied]).sum(1))
    depth, groups = (np.concatenate([getattr(one, k) for one in every]) for k in ("depth", "episode"))
    off, usual = np.concatenate(wrong), np.concatenate(spread)

    def estimate(chosen: np.ndarray) -> dict[str, float]:
        rows = np.flatnonzero(chosen)

        def of(drawn: np.ndarray) -> float:
            total = float(usual[rows[drawn]].sum())
            return 1 - float(off[rows[drawn]].sum()) / total if total > 0 else float("nan")

        return bootstrap(groups[rows], of)._asdict()

    return {
        "first": estimate(depth == 1),
        "whole": estimate(depth > 0),
        "policies": len(every),
        "decisions": len(depth),
    }
