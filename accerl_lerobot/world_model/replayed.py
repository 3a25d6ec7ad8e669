# SPDX-License-Identifier: Apache-2.0
"""Real episodes dreamt again: real frames to begin at, real actions, and their real outcomes.

No policy decides anything here, so what is dreamt can be held against what was seen: by a trial, and by a
success model that is to learn how a dream looks that goes wrong.

Shapes: M dreams, D depths in chunks; see `episodes.py` for the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from accerl_lerobot.world_model.contract import Context, WorldModel, rows
from accerl_lerobot.world_model.episodes import Episode, Place, Windows, cut, held

BATCH = 64
"""Dreams at once."""


class Dreams(NamedTuple):
    """Dreams of M windows."""

    frames: np.ndarray
    """uint8 (M, D, V, H, W, 3)."""
    robot: np.ndarray
    """float32 (M, D, S)."""
    uncertainty: np.ndarray
    """float32 (M, D)."""
    ends: np.ndarray
    """uint8 (M, D, V, H, W, 3): what the chunk at a depth would show with the actions of `ends` instead."""


def context_of(windows: Windows, rows: slice = slice(None)) -> Context:
    """A world model's context at the beginning of some windows."""
    known = windows.context
    return Context(
        frames=torch.from_numpy(windows.frames[rows, :known]),
        robot=torch.from_numpy(windows.state[rows, :known]),
        actions=torch.from_numpy(windows.before[rows]),
        told=torch.from_numpy(windows.told[rows]),
        first=torch.from_numpy(windows.first[rows]),
    )


def cut_alike(steps: np.ndarray, success: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """How many actions of a chunk to believe in, so that successes and failures are cut short equally often.

    Args:
        steps: (M, D) actions that were executed.
        success: bool (M, D), whether that achieved the task.
        rng: draws, for each failure of a column, the steps of one of its successes.

    Returns:
        (M, D), never more than were executed.
    """
    cut_ = steps.copy()
    for d in range(steps.shape[1]):
        of = steps[success[:, d], d]
        if len(of):
            failed = ~success[:, d]
            cut_[failed, d] = np.minimum(steps[failed, d], rng.choice(of, int(failed.sum())))
    return cut_


def dream(
    model: WorldModel,
    windows: Windows,
    actions: np.ndarray,
    ends: np.ndarray | None = None,
    lengths: np.ndarray | None = None,
) -> Dreams:
    """Dreams windows on.

    Args:
        model: that dreams.
        windows: where dreams begin.
        actions: (M, D, K, A), what is done.
        ends: (M, D, K, A), other last chunks; None: the same.
        lengths: int (M,), chunks after which each dream ends, and nothing but zeros follows; None: D.
    """
    depth = actions.shape[1]
    lengths = np.full(len(windows), depth) if lengths is None else lengths
    parts = []
    for start in range(0, len(windows), BATCH):
        of = slice(start, start + BATCH)
        state = model.begin(context_of(windows, of), windows.task[of])
        part = _blank(model, len(windows.task[of]), depth)
        alive = np.arange(len(part.frames))
        for d in range(depth):
            going = lengths[start + alive] > d
            if not going.all():
                state, alive = rows(state, np.flatnonzero(going)), alive[going]
            if not len(alive):
                break
            seeds = [int(start + i + 1_000_003 * d) for i in alive]
            made = actions[start + alive, d]
            dreamt = model.step(state, torch.from_numpy(made), seeds)
            for name in ("frames", "robot", "uncertainty"):
                getattr(part, name)[alive, d] = getattr(dreamt, name).cpu().numpy()
            part.ends[alive, d] = part.frames[alive, d]
            if ends is not None:
                other = ends[start + alive, d]
                differ = np.flatnonzero((made != other).any((1, 2)))
                if len(differ):
                    chosen = [seeds[i] for i in differ]
                    again = model.step(rows(state, differ), torch.from_numpy(other[differ]), chosen)
                    part.ends[alive[differ], d] = again.frames.cpu().numpy()
            state = dreamt.state
        parts.append(part)
    return Dreams(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _blank(model: WorldModel, count: int, depth: int) -> Dreams:
    shape = (count, depth, len(model.spec.cameras), *model.spec.image_size, 3)
    return Dreams(
        frames=np.zeros(shape, np.uint8),
        robot=np.zeros((count, depth, model.spec.state_dim), np.float32),
        uncertainty=np.zeros((count, depth), np.float32),
        ends=np.zeros(shape, np.uint8),
    )


class Replayed(NamedTuple):
    """Windows, and what was dreamt of them with the actions that were made."""

    windows: Windows
    dreams: Dreams
    newest: np.ndarray
    """uint8 (M, V, H, W, 3), where they begin."""
    made: np.ndarray
    """bool (M, D), chunks that were really made, until the task was achieved or the episode ended."""

    def before(self, d: int) -> np.ndarray:
        """uint8 (M, V, H, W, 3), the frame before the chunk at a depth, counted from 0."""
        return self.newest if d == 0 else self.dreams.frames[:, d - 1]


def replay(
    model: WorldModel,
    episodes: Sequence[Episode],
    at: Sequence[Place],
    depth: int,
    rng: np.random.Generator | None = None,
) -> Replayed:
    """Dreams these episodes from there on, whole chunks at a time, until each has ended.

    Args:
        model: that dreams.
        episodes: of which
        at: these begin,
        depth: and last so many chunks at most.
        rng: with it `Dreams.ends` are of chunks that are cut short alike, whether they succeed or not.
    """
    spec = model.spec
    windows = cut(episodes, at, chunk=spec.chunk, context=spec.context, chunks=depth)
    ends = None
    if rng is not None:
        ends = held(windows.actions, cut_alike(windows.steps, windows.success, rng))
    happened = made(windows)
    dreams = dream(model, windows, held(windows.actions, windows.steps), ends, happened.sum(1))
    return Replayed(windows, dreams, windows.frames[:, spec.context - 1], happened)


def made(windows: Windows) -> np.ndarray:
    """See `Replayed.made`."""
    before = np.cumsum(windows.success, axis=1) - windows.success
    return (windows.valid | windows.success) & (before == 0)
