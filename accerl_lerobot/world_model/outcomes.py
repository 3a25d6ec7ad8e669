# SPDX-License-Identifier: Apache-2.0
"""Comparison of dreams' outcomes with reality's, under the actions that were really made.

An episode is dreamt to its end, and the highest P(success) on the way is the dream's *score*: one that is
once taken for a success ends there. One chunk in thirty that is wrongly taken for a success may pass a trial
of single chunks, and still be half of all long dreams that should have failed.

Shapes: M dreams, D depths in chunks.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from accerl_lerobot.world_model import judge
from accerl_lerobot.world_model.config import TrialConfig
from accerl_lerobot.world_model.contract import WorldModel
from accerl_lerobot.world_model.episodes import Episode, Place, longest
from accerl_lerobot.world_model.replayed import dream, replay
from accerl_lerobot.world_model.stand_in import SuccessModel
from accerl_lerobot.world_model.success import probabilities

FOLDS = 4
"""Parts of the episodes, see `judged`."""


class Scores(NamedTuple):
    """Scores of M dreams."""

    dreamt: np.ndarray
    """Highest P(success) on the way, until the task was really achieved."""
    still: np.ndarray
    """The same, had nothing been done until the longest episode's end."""
    seen: np.ndarray
    """The same, of the frames that were really seen."""
    achieved: np.ndarray
    """bool, whether the task really was."""
    episode: np.ndarray
    """int64, which each is of."""


def scores(
    model: WorldModel,
    success: SuccessModel,
    episodes: Sequence[Episode],
    config: TrialConfig,
    seed: int,
) -> Scores:
    """Dreams the episodes to their ends, from the beginning and from one later place each, or only parts of
    them, as `TrialConfig.whole` says; at most `TrialConfig.most`.
    """
    rng = np.random.default_rng((seed, 5))
    chunk, context = model.spec.chunk, model.spec.context
    shown = [episode.times[: episode.starts + 1] for episode in episodes]
    if config.whole:
        at = [
            Place(e, f) for e, t in enumerate(shown) if len(t) > 1 for f in {0, int(rng.integers(len(t) - 1))}
        ]
        depth = longest(episodes, chunk)
    else:
        at = [Place(e, f) for e, times in enumerate(shown) for f in spaced(times, config.every)]
        depth = config.depth
    at = drawn(episodes, at, config.most, rng)
    replayed = replay(model, episodes, at, depth)
    windows, made = replayed.windows, replayed.made
    # Who does nothing has as much time as anybody.
    begun = np.array([int(episodes[e].times[f]) // chunk if config.whole else 0 for e, f in at])
    left = np.arange(depth) < (depth - begun)[:, None]
    still = dream(model, windows, np.zeros_like(windows.actions), lengths=left.sum(1)).frames
    best = {name: np.zeros(len(at)) for name in ("dreamt", "still", "seen")}
    for d in range(depth):
        before = {
            "dreamt": replayed.before(d),
            "still": replayed.newest if d == 0 else still[:, d - 1],
            "seen": windows.frames[:, context - 1 + d],
        }
        after = {
            "dreamt": replayed.dreams.frames[:, d],
            "still": still[:, d],
            "seen": windows.frames[:, context + d],
        }
        for name, highest in best.items():
            rows = np.flatnonzero((left if name == "still" else made)[:, d])
            said = probabilities(success, before[name][rows], after[name][rows])
            highest[rows] = np.maximum(highest[rows], said)
    achieved = (windows.success & made).any(1)
    return Scores(**best, achieved=achieved, episode=windows.episode)


def drawn(
    episodes: Sequence[Episode], at: Sequence[Place], most: int, rng: np.random.Generator
) -> list[Place]:
    """At most so many of these places, in their order; those in the policy's own episodes before others."""
    if len(at) <= most:
        return list(at)
    own = np.array([episodes[place.episode].source == "online" for place in at])
    first = rng.permutation(len(at))
    first = first[np.argsort(~own[first], kind="stable")]
    return [at[i] for i in sorted(first[:most].tolist())]


def together(*parts: Scores) -> Scores:
    """Scores of different episodes, in one."""
    count, columns = 0, []
    for part in parts:
        columns.append(part._replace(episode=part.episode + count))
        count += int(part.episode.max(initial=-1)) + 1
    return Scores(*(np.concatenate(column) for column in zip(*columns, strict=True)))


def threshold(found: Scores, theirs: np.ndarray, config: TrialConfig) -> float | None:
    """Lowest score that counts as a success.

    Of the thresholds that let no larger share of failures through than `TrialConfig.false_positives`, the one
    at which most successes, less failures, are taken for successes. The strictest would be safe, and a policy
    that is never told of a success learns nothing.

    Args:
        found: dreams; of episodes that were not learnt from, as what was learnt flatters.
        theirs: bool (M,), dreams of the policy's own episodes, whose failures count if there are any.
        config: see there.

    Returns:
        At least 0.5; None if there is no failure.
    """
    failed = _failures(found, theirs)
    if not failed.any():
        return None
    failures = found.dreamt[failed]
    least = judge.threshold(failures, np.zeros(len(failures), bool), config.false_positives)
    least = float(np.clip(least, 0.5, 1 - 1e-6))
    of_policy = found.achieved & theirs
    successes = found.dreamt[of_policy if of_policy.any() else found.achieved]
    if not len(successes):
        return least
    # Only just above a failure is a threshold worth trying.
    tried = sorted({least, *np.nextafter(failures[failures >= least], np.inf).tolist()})
    gained = [(successes > t).mean() - (failures > t).mean() for t in tried]
    return min(float(tried[int(np.argmax(gained))]), 1 - 1e-6)


def judged(
    found: Scores, theirs: np.ndarray, config: TrialConfig, given: float | None = None
) -> dict[str, Any]:
    """Judges dreams by their scores.

    Args:
        given: what counts as a success. None: what each part of the episodes is judged by is set on the
            others, as it cannot be set and tried on the same.
        found: of the dreams.
        theirs: bool (M,), see `threshold`.
        config: see there.

    Returns:
        How many ``successes`` and ``failures`` there are, ``auroc`` and ``auroc_real`` (of frames that were
        seen), ``false_success`` (failures taken for successes), ``false_success_still`` (of all, had nothing
        been done), and ``recall`` (successes that are taken for such).
    """
    failed = _failures(found, theirs)
    least = np.full(len(found.achieved), 0.5 if given is None else given)
    fold = np.unique(found.episode, return_inverse=True)[1] % FOLDS
    for i in range(FOLDS if given is None else 0):
        others = Scores(*(part[fold != i] for part in found))
        least[fold == i] = threshold(others, theirs[fold != i], config) or 0.5

    def share(scores: np.ndarray, of: np.ndarray) -> float:
        return float((scores[of] > least[of]).mean()) if of.any() else float("nan")

    return {
        "dreams": len(found.achieved),
        "successes": int(found.achieved.sum()),
        "failures": int(failed.sum()),
        "auroc": judge.separation(found.dreamt, found.achieved, found.episode)._asdict(),
        "auroc_real": judge.auroc(found.seen, found.achieved),
        "false_success": share(found.dreamt, failed),
        "false_success_still": share(found.still, np.ones(len(failed), bool)),
        "recall": share(found.dreamt, found.achieved),
    }


def _failures(found: Scores, theirs: np.ndarray) -> np.ndarray:
    """Where the policy has failed, or else where anybody has."""
    failed = ~found.achieved
    return failed & theirs if (failed & theirs).any() else failed


def spaced(times: np.ndarray, every: int) -> list[int]:
    """Frames that something follows, each at least so many env steps after the one before."""
    chosen: list[int] = []
    for frame, time in enumerate(times[:-1]):
        if not chosen or time >= times[chosen[-1]] + every:
            chosen.append(frame)
    return chosen
