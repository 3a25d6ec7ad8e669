# SPDX-License-Identifier: Apache-2.0
"""Real episodes replayed in a world model with the executed actions, and how that ends.

An episode is imagined to its end, and the highest P(success) on the way is the rollout's *score*: an imagined
rollout ends with its first success. One chunk in thirty that is wrongly classified as a success may pass a
check of single chunks, and still end half of all long rollouts that should have failed.

Shapes: M rollouts, D depths in chunks; see `data.py` for the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from accerl_lerobot.world_model import metrics
from accerl_lerobot.world_model.config import ValidationConfig
from accerl_lerobot.world_model.contract import Context, WorldModel, select_rows
from accerl_lerobot.world_model.data import (
    Episode,
    Windows,
    WindowStart,
    cut_windows,
    hold_last_action,
    longest_rollout,
)
from accerl_lerobot.world_model.success_plugin.modeling_success_pairs import (
    SuccessPairsRewardModel,
    probabilities,
)

BATCH = 64
"""Rollouts at once."""
FOLDS = 4
"""Folds of the episodes, see `outcome_metrics`."""


class Predictions(NamedTuple):
    """Predictions of M windows."""

    frames: np.ndarray
    """uint8 (M, D, V, H, W, 3)."""
    robot: np.ndarray
    """float32 (M, D, S)."""
    uncertainty: np.ndarray
    """float32 (M, D)."""
    ends: np.ndarray
    """uint8 (M, D, V, H, W, 3): frames if the chunk at a depth were the one in `ends` of `predict`."""


def context_of(windows: Windows, rows: slice = slice(None)) -> Context:
    """A world model's context at the first frame of some windows."""
    length = windows.context
    return Context(
        frames=torch.from_numpy(windows.frames[rows, :length]),
        robot=torch.from_numpy(windows.state[rows, :length]),
        actions=torch.from_numpy(windows.before[rows]),
        commanded_sum=torch.from_numpy(windows.commanded_sum[rows]),
        initial_state=torch.from_numpy(windows.initial_state[rows]),
    )


def predict(
    model: WorldModel,
    windows: Windows,
    actions: np.ndarray,
    ends: np.ndarray | None = None,
    lengths: np.ndarray | None = None,
) -> Predictions:
    """Predicts from the first frame of each window.

    Args:
        model: in eval mode.
        windows: where the predictions begin.
        actions: (M, D, K, A).
        ends: (M, D, K, A), alternatives of the last chunk; None: the same.
        lengths: int (M,), chunks of each rollout, zeros follow; None: D.
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
                state, alive = select_rows(state, np.flatnonzero(going)), alive[going]
            if not len(alive):
                break
            seeds = [int(start + i + 1_000_003 * d) for i in alive]
            chunk = actions[start + alive, d]
            prediction = model.step(state, torch.from_numpy(chunk), seeds)
            for name in ("frames", "robot", "uncertainty"):
                getattr(part, name)[alive, d] = getattr(prediction, name).cpu().numpy()
            part.ends[alive, d] = part.frames[alive, d]
            if ends is not None:
                other = ends[start + alive, d]
                differ = np.flatnonzero((chunk != other).any((1, 2)))
                if len(differ):
                    chosen = [seeds[i] for i in differ]
                    again = model.step(select_rows(state, differ), torch.from_numpy(other[differ]), chosen)
                    part.ends[alive[differ], d] = again.frames.cpu().numpy()
            state = prediction.state
        parts.append(part)
    return Predictions(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _blank(model: WorldModel, count: int, depth: int) -> Predictions:
    shape = (count, depth, len(model.spec.cameras), *model.spec.image_size, 3)
    return Predictions(
        frames=np.zeros(shape, np.uint8),
        robot=np.zeros((count, depth, model.spec.state_dim), np.float32),
        uncertainty=np.zeros((count, depth), np.float32),
        ends=np.zeros(shape, np.uint8),
    )


class Replayed(NamedTuple):
    """Windows, and their predictions with the executed actions."""

    windows: Windows
    predictions: Predictions
    newest: np.ndarray
    """uint8 (M, V, H, W, 3), the first frames of the windows."""
    executed: np.ndarray
    """bool (M, D), see `executed_chunks`."""

    def before(self, d: int) -> np.ndarray:
        """uint8 (M, V, H, W, 3), the frame before the chunk at depth d, counted from 0."""
        return self.newest if d == 0 else self.predictions.frames[:, d - 1]


def replay(
    model: WorldModel,
    episodes: Sequence[Episode],
    at: Sequence[WindowStart],
    depth: int,
    rng: np.random.Generator | None = None,
) -> Replayed:
    """Predicts episodes from there on, whole chunks at a time, until each has ended or for `depth` chunks.

    With `rng`, `Predictions.ends` are of chunks that are cut short alike in successes and failures.
    """
    spec = model.spec
    windows = cut_windows(episodes, at, chunk=spec.chunk, context=spec.context, chunks=depth)
    ends = None
    if rng is not None:
        steps = match_cut_lengths(windows.steps, windows.success, rng)
        ends = hold_last_action(windows.actions, steps)
    executed, actions = executed_chunks(windows), hold_last_action(windows.actions, windows.steps)
    predictions = predict(model, windows, actions, ends, executed.sum(1))
    return Replayed(windows, predictions, windows.frames[:, spec.context - 1], executed)


def executed_chunks(windows: Windows) -> np.ndarray:
    """bool (M, D), chunks that were executed until the task was achieved or the episode ended."""
    before = np.cumsum(windows.success, axis=1) - windows.success
    return (windows.valid | windows.success) & (before == 0)


def match_cut_lengths(steps: np.ndarray, success: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Shortens failed chunks (M, D) at random so that they are cut short as often as successful ones.

    Each failure of a column gets the steps of one of its successes, if these are fewer.
    """
    shortened = steps.copy()
    for d in range(steps.shape[1]):
        of = steps[success[:, d], d]
        if len(of):
            failed = ~success[:, d]
            shortened[failed, d] = np.minimum(steps[failed, d], rng.choice(of, int(failed.sum())))
    return shortened


# Outcomes of whole episodes.


class Scores(NamedTuple):
    """Scores of M rollouts."""

    imagined: np.ndarray
    """Highest P(success) with the executed actions, until the real success."""
    idle: np.ndarray
    """Highest P(success) without any action, until the longest episode's end."""
    real: np.ndarray
    """Highest P(success) of the real frames."""
    achieved: np.ndarray
    """bool, True if the real episode achieved the task."""
    episode: np.ndarray
    """int64, index of the episode."""


def score_episodes(
    model: WorldModel,
    success: SuccessPairsRewardModel,
    episodes: Sequence[Episode],
    config: ValidationConfig,
    seed: int,
) -> Scores:
    """Imagines the episodes to their ends, each from its first and one later frame, `max_windows` at most."""
    rng = np.random.default_rng((seed, 5))
    chunk, context = model.spec.chunk, model.spec.context
    counts = [episode.starts for episode in episodes]
    at = [WindowStart(e, f) for e, n in enumerate(counts) if n for f in {0, int(rng.integers(n))}]
    at = subsample(episodes, at, config.max_windows, rng)
    depth = longest_rollout(episodes, chunk)
    replayed = replay(model, episodes, at, depth)
    windows, executed = replayed.windows, replayed.executed
    # Without actions, every rollout has as much time as the longest episode.
    begun = np.array([int(episodes[e].times[f]) // chunk for e, f in at])
    left = np.arange(depth) < (depth - begun)[:, None]
    idle = predict(model, windows, np.zeros_like(windows.actions), lengths=left.sum(1)).frames
    best = {name: np.zeros(len(at)) for name in ("imagined", "idle", "real")}
    for d in range(depth):
        before = {
            "imagined": replayed.before(d),
            "idle": replayed.newest if d == 0 else idle[:, d - 1],
            "real": windows.frames[:, context - 1 + d],
        }
        after = {
            "imagined": replayed.predictions.frames[:, d],
            "idle": idle[:, d],
            "real": windows.frames[:, context + d],
        }
        for name, highest in best.items():
            rows = np.flatnonzero((left if name == "idle" else executed)[:, d])
            probability = probabilities(success, before[name][rows], after[name][rows])
            highest[rows] = np.maximum(highest[rows], probability)
    return Scores(**best, achieved=(windows.success & executed).any(1), episode=windows.episode)


def subsample(
    episodes: Sequence[Episode], at: Sequence[WindowStart], most: int, rng: np.random.Generator
) -> list[WindowStart]:
    """At most so many of these, in their order; those in the policy's own episodes before others."""
    if len(at) <= most:
        return list(at)
    own = np.array([episodes[start.episode].source == "online" for start in at])
    first = rng.permutation(len(at))
    first = first[np.argsort(~own[first], kind="stable")]
    return [at[i] for i in sorted(first[:most].tolist())]


def spaced_frames(times: np.ndarray, stride: int) -> list[int]:
    """Frames that another follows, each at least `stride` env steps after the one before."""
    chosen: list[int] = []
    for frame, time in enumerate(times[:-1]):
        if not chosen or time >= times[chosen[-1]] + stride:
            chosen.append(frame)
    return chosen


def concatenate(*parts: Scores) -> Scores:
    """Concatenates scores of different episodes."""
    count, columns = 0, []
    for part in parts:
        columns.append(part._replace(episode=part.episode + count))
        count += int(part.episode.max(initial=-1)) + 1
    return Scores(*(np.concatenate(column) for column in zip(*columns, strict=True)))


def choose_threshold(scores: Scores, own: np.ndarray, config: ValidationConfig) -> float | None:
    """Chooses the lowest score that counts as a success.

    Of the thresholds that let no larger share of failures through than `ValidationConfig.false_positives`,
    the one with the largest share of successes less share of failures above it. The strictest would be safe,
    and a policy that never sees a success learns nothing.

    Scores are of episodes that were not trained on, as others flatter. `own`, bool (M,), is True for the
    policy's own episodes; only their failures count if there are any.

    Returns:
        At least 0.5; None if there is no failure.
    """
    failed = _failures(scores, own)
    if not failed.any():
        return None
    failures = scores.imagined[failed]
    least = metrics.threshold_at(failures, config.false_positives)
    least = float(np.clip(least, 0.5, 1 - 1e-6))
    own_successes = scores.achieved & own
    successes = scores.imagined[own_successes if own_successes.any() else scores.achieved]
    if not len(successes):
        return least
    # Only thresholds just above a failure are worth trying.
    candidates = sorted({least, *np.nextafter(failures[failures >= least], np.inf).tolist()})
    gains = [(successes > t).mean() - (failures > t).mean() for t in candidates]
    return min(float(candidates[int(np.argmax(gains))]), 1 - 1e-6)


def outcome_metrics(
    scores: Scores, own: np.ndarray, config: ValidationConfig, threshold: float | None = None
) -> dict[str, Any]:
    """Compares the outcomes of imagined rollouts with the real ones.

    Where `threshold` is None, that of each fold of the episodes is chosen on the others.

    Returns:
        Numbers of ``rollouts``, ``successes`` and ``failures``; ``auroc``, ``auroc_real`` (of real frames),
        ``false_success`` (share of failures above the threshold), ``false_success_idle`` (of all, without any
        action), and ``recall`` (share of successes above it).
    """
    failed = _failures(scores, own)
    thresholds = np.full(len(scores.achieved), 0.5 if threshold is None else threshold)
    fold = np.unique(scores.episode, return_inverse=True)[1] % FOLDS
    for i in range(FOLDS if threshold is None else 0):
        others = Scores(*(part[fold != i] for part in scores))
        thresholds[fold == i] = choose_threshold(others, own[fold != i], config) or 0.5

    def share(values: np.ndarray, of: np.ndarray) -> float:
        return float((values[of] > thresholds[of]).mean()) if of.any() else float("nan")

    return {
        "rollouts": len(scores.achieved),
        "successes": int(scores.achieved.sum()),
        "failures": int(failed.sum()),
        "auroc": metrics.auroc_estimate(scores.imagined, scores.achieved, scores.episode)._asdict(),
        "auroc_real": metrics.auroc(scores.real, scores.achieved),
        "false_success": share(scores.imagined, failed),
        "false_success_idle": share(scores.idle, np.ones(len(failed), bool)),
        "recall": share(scores.imagined, scores.achieved),
    }


def _failures(scores: Scores, own: np.ndarray) -> np.ndarray:
    """Failures of the policy, or else all failures."""
    failed = ~scores.achieved
    return failed & own if (failed & own).any() else failed
