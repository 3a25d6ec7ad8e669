# SPDX-License-Identifier: Apache-2.0
"""Real episodes replayed in a world model with the executed actions, and how that ends.

An episode is imagined to its end, and the highest P(success) on the way is the rollout's *score*: an imagined
rollout ends with its first success. One chunk in thirty that is wrongly classified as a success may pass a
check of single chunks, and still end half of all long rollouts that should have failed.

Shapes: M rollouts, D depths in chunks; see `data.py` for the others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch

from accerl_lerobot.experience import task_codes
from accerl_lerobot.world_model.config import ValidationConfig
from accerl_lerobot.world_model.contract import Windows, WorldModel, context_of, select_rows
from accerl_lerobot.world_model.data import Episode, WindowStart, cut_windows, hold_last_action
from accerl_lerobot.world_model.success_model import SuccessPairsRewardModel

BATCH = 64  # rollouts at once
DRAWS = 1000  # resamples of an interval


class Predictions(NamedTuple):
    """Predictions of M windows."""

    frames: np.ndarray  # uint8 (M, D + 1, V, H, W, 3): the window's first frame, then one after each chunk
    robot: np.ndarray  # float32 (M, D, S)
    uncertainty: np.ndarray  # float32 (M, D)
    ends: np.ndarray  # uint8 (M, D, V, H, W, 3): those after each chunk, if it were the one in `ends`


def predict(
    model: WorldModel,
    windows: Windows,
    actions: np.ndarray,
    ends: np.ndarray | None = None,
    lengths: np.ndarray | None = None,
) -> Predictions:
    """Predicts from the first frame of each window.

    `actions` and `ends`, alternatives of the last chunk, are (M, D, K, A). `lengths`, int (M,), are chunks of
    each rollout, which zeros follow; None: D.
    """
    count, depth = actions.shape[:2]
    lengths = np.full(count, depth) if lengths is None else lengths
    spec = model.spec
    frames = np.zeros((count, depth + 1, len(spec.cameras), *spec.image_size, 3), np.uint8)
    frames[:, 0] = windows.frames[:, windows.context - 1]
    made = Predictions(
        frames=frames,
        robot=np.zeros((count, depth, spec.state_dim), np.float32),
        uncertainty=np.zeros((count, depth), np.float32),
        ends=frames[:, 1:] if ends is None else np.zeros_like(frames[:, 1:]),
    )
    for start in range(0, count, BATCH):
        of = slice(start, start + BATCH)
        state, rows = model.begin(context_of(windows, of), windows.task[of]), np.arange(count)[of]
        for d in range(int(lengths[of].max())):
            going = lengths[rows] > d
            if not going.all():
                state, rows = select_rows(state, np.flatnonzero(going)), rows[going]
            seeds, chunk = rows + 1_000_003 * d, actions[rows, d]
            prediction = model.step(state, torch.from_numpy(chunk), seeds.tolist())
            made.frames[rows, d + 1] = made.ends[rows, d] = prediction.frames.cpu().numpy()
            made.robot[rows, d] = prediction.robot.cpu().numpy()
            made.uncertainty[rows, d] = prediction.uncertainty.cpu().numpy()
            if ends is not None:
                other = ends[rows, d]
                if len(differ := np.flatnonzero((chunk != other).any((1, 2)))):
                    chosen = select_rows(state, differ)
                    again = model.step(chosen, torch.from_numpy(other[differ]), seeds[differ].tolist())
                    made.ends[rows[differ], d] = again.frames.cpu().numpy()
            state = prediction.state
    return made


def replay(
    model: WorldModel,
    episodes: Sequence[Episode],
    at: Sequence[WindowStart],
    depth: int,
    rng: np.random.Generator | None = None,
) -> tuple[Windows, Predictions, np.ndarray]:
    """Predicts episodes from there on, whole chunks at a time, until each has ended or for `depth` chunks.

    With `rng`, `Predictions.ends` are of chunks that are cut short alike in successes and failures.

    Returns:
        Windows; their predictions with the executed actions; bool (M, D), chunks that were executed until the
        task was achieved or the episode ended.
    """
    windows = cut_windows(episodes, at, model.spec, depth)
    ends = None
    if rng is not None:
        steps = match_cut_lengths(windows.steps, windows.success, rng)
        ends = hold_last_action(windows.actions, steps)
    achieved_before = np.cumsum(windows.success, axis=1) - windows.success
    executed = (windows.valid | windows.success) & (achieved_before == 0)
    actions = hold_last_action(windows.actions, windows.steps)
    return windows, predict(model, windows, actions, ends, executed.sum(1)), executed


def match_cut_lengths(steps: np.ndarray, success: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Shortens failed chunks (M, D) at random so that they are cut short as often as successful ones.

    Each failure of a column gets the steps of one of its successes, if these are fewer.
    """
    shortened = steps.copy()
    for d, succeeded in enumerate(success.T):
        if succeeded.any():
            drawn = rng.choice(steps[succeeded, d], int((~succeeded).sum()))
            shortened[~succeeded, d] = np.minimum(steps[~succeeded, d], drawn)
    return shortened


class Scores(NamedTuple):
    """Scores of M rollouts."""

    imagined: np.ndarray  # highest P(success) with the executed actions, until the real success
    achieved: np.ndarray  # bool, True if the real episode achieved the task
    episode: np.ndarray  # int64, index of the episode
    own: np.ndarray  # bool, see `Episode`

    def of_own(self, chosen: np.ndarray) -> np.ndarray:
        """Selection of the policy's own episodes, or else of all."""
        return chosen & self.own if (chosen & self.own).any() else chosen


def score_episodes(
    model: WorldModel,
    success: SuccessPairsRewardModel,
    episodes: Sequence[Episode],
    config: ValidationConfig,
    seed: int,
) -> Scores:
    """Imagines the episodes to their ends, each from its first and one later frame, `max_windows` at most."""
    rng = np.random.default_rng((seed, 5))
    chunk = model.spec.chunk
    counts = [episode.starts for episode in episodes]
    at = [WindowStart(e, f) for e, n in enumerate(counts) if n for f in {0, int(rng.integers(n))}]
    at = subsample(episodes, at, config.max_windows, rng)
    depth = max(-(-len(episode) // chunk) for episode in episodes)
    windows, predictions, executed = replay(model, episodes, at, depth)
    codes = task_codes(windows.task)
    highest = np.zeros(len(at))
    for d in range(depth):
        rows = np.flatnonzero(executed[:, d])
        frames = predictions.frames[rows]
        probability = success.probabilities(frames[:, d], frames[:, d + 1], codes[rows])
        highest[rows] = np.maximum(highest[rows], probability)
    return Scores(
        imagined=highest,
        achieved=(windows.success & executed).any(1),
        episode=windows.episode,
        own=np.array([episodes[e].own for e in windows.episode], bool),
    )


def subsample(
    episodes: Sequence[Episode], at: Sequence[WindowStart], most: int, rng: np.random.Generator
) -> list[WindowStart]:
    """At most so many of these, in their order; those in the policy's own episodes before others."""
    if len(at) <= most:
        return list(at)
    own = np.array([episodes[start.episode].own for start in at])
    first = rng.permutation(len(at))
    first = first[np.argsort(~own[first], kind="stable")]
    return [at[i] for i in sorted(first[:most].tolist())]


def choose_threshold(scores: Scores, config: ValidationConfig) -> float | None:
    """Chooses the lowest score that counts as a success, at least 0.5; None if there is no failure.

    Of the thresholds that let no larger share of failures through than `ValidationConfig.false_positives`,
    the one with the largest share of successes less share of failures above it. The strictest would be safe,
    and a policy that never sees a success learns nothing. Failures and successes are those of the policy's
    own episodes, if there are any.
    """
    failures = scores.imagined[scores.of_own(~scores.achieved)]
    successes = scores.imagined[scores.of_own(scores.achieved)]
    if not len(failures):
        return None
    passing = np.sort(failures)[::-1][int(config.false_positives * len(failures))]
    least = float(np.clip(np.nextafter(passing, np.inf), 0.5, 1 - 1e-6))
    if not len(successes):
        return least
    # Only thresholds just above a failure are worth trying.
    candidates = sorted({least, *np.nextafter(failures[failures >= least], np.inf).tolist()})
    gains = [(successes > t).mean() - (failures > t).mean() for t in candidates]
    return min(float(candidates[int(np.argmax(gains))]), 1 - 1e-6)


def bootstrap(groups: np.ndarray, statistic: Callable[[np.ndarray], float]) -> dict[str, float]:
    """``value`` of a statistic of row indices, and its 95 % interval ``low`` to ``high``.

    It is a percentile bootstrap over groups (M,), the episodes, as windows of one are alike. Draws for which
    the statistic is NaN are left out.
    """
    rng = np.random.default_rng(0)
    order = np.argsort(groups, kind="stable")
    rows = np.split(order, np.flatnonzero(np.diff(groups[order])) + 1)
    draws = (rng.integers(len(rows), size=len(rows)) for _ in range(DRAWS))
    values = np.array([statistic(np.concatenate([rows[i] for i in drawn])) for drawn in draws])
    values = values[~np.isnan(values)]
    # The nearest draw, since between two infinite ones there is nothing to interpolate.
    low, high = np.quantile(values, [0.025, 0.975], method="nearest") if len(values) else (np.nan, np.nan)
    return {"value": statistic(np.arange(len(groups))), "low": float(low), "high": float(high)}


def auroc(scores: np.ndarray, labels: np.ndarray) -> float:
    """Chance that a success scores above a failure, ties counting half; NaN without both."""
    difference = scores[labels][:, None] - scores[~labels]
    if not difference.size:
        return float("nan")
    return float(((difference > 0) + 0.5 * (difference == 0)).mean())
