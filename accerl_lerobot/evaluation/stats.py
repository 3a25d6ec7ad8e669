# SPDX-License-Identifier: Apache-2.0
"""Intervals of success rates, and comparisons of two policies.

A success rate is never reported without n and an interval. Two policies are compared on the *same* (task,
seed) episodes: what both solve or both fail says nothing about the difference, and leaving it out is what
makes small comparisons possible.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist

Outcomes = Mapping[tuple[str, int], bool]
"""(task, seed) → success, one entry per episode."""


@dataclass(frozen=True, kw_only=True)
class Interval:
    """Both ends as fractions."""

    low: float
    high: float

    def __contains__(self, x: float) -> bool:
        return self.low <= x <= self.high


@dataclass(frozen=True, kw_only=True)
class Rate:
    """Successes out of n.

    Example:
        >>> str(Rate(successes=93, n=100))
        '93.0 % [86.3, 96.6] n=100'

    Raises:
        ValueError: more successes than episodes, or fewer than none.
    """

    successes: int
    n: int

    def __post_init__(self) -> None:
        if not 0 <= self.successes <= self.n:
            raise ValueError(f"{self.successes} successes in {self.n} episodes")

    @property
    def value(self) -> float:
        """The observed fraction; NaN for n = 0."""
        return self.successes / self.n if self.n else math.nan

    def interval(self, confidence: float = 0.95) -> Interval:
        """`wilson_interval` of this rate."""
        return wilson_interval(self.successes, self.n, confidence)

    def __str__(self) -> str:
        return format_rate(self.successes, self.n)


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Policy a against policy b on the same episodes."""

    n: int
    wins: int
    """Episodes only a solved."""
    losses: int
    """Episodes only b solved."""
    difference: float
    """Rate of a minus rate of b, in [−1, 1]."""
    interval: Interval
    """Interval of the difference."""
    p_value: float
    """Two-sided, of the exact McNemar test: how often chance alone splits the disagreements this unevenly."""

    def __str__(self) -> str:
        low, high = 100 * self.interval.low, 100 * self.interval.high
        return (
            f"{100 * self.difference:+.1f} points [{low:+.1f}, {high:+.1f}] "
            f"n={self.n} ({self.wins} won, {self.losses} lost) p={self.p_value:.2g}"
        )


def wilson_interval(successes: int, n: int, confidence: float = 0.95) -> Interval:
    """Wilson's score interval of a proportion (Wilson 1927; Brown, Cai and DasGupta 2001, section 3.1.1).

        z = Φ⁻¹((1 + confidence) / 2),  p = successes / n
        (p + z²/2n ± z √(p(1 − p)/n + z²/4n²)) / (1 + z²/n)

    Unlike p ± z√(p(1 − p)/n) it has width at 0 and at n successes and stays inside [0, 1].

    Args:
        successes: 0 to n.
        n: episodes; 0 gives [0, 1], as nothing is known.
        confidence: above 0 and below 1.

    Raises:
        ValueError: a count or the confidence is out of range.
    """
    if not 0 <= successes <= n:
        raise ValueError(f"{successes} successes in {n} episodes")
    z = _quantile(confidence)
    if n == 0:
        return Interval(low=0.0, high=1.0)
    p, share = successes / n, z * z / n
    centre = (p + share / 2) / (1 + share)
    half = z * math.sqrt(p * (1 - p) / n + share / (4 * n)) / (1 + share)
    low = 0.0 if successes == 0 else centre - half
    high = 1.0 if successes == n else centre + half
    return Interval(low=low, high=high)


def mcnemar_p(wins: int, losses: int) -> float:
    """Exact two-sided p-value of McNemar's test (1947): the sign test on the pairs that disagree.

    min(1, 2 · P[Binomial(wins + losses, ½) ≤ min(wins, losses)]); 1 if no pair disagrees.

    Raises:
        ValueError: a count is negative.
    """
    if wins < 0 or losses < 0:
        raise ValueError(f"{wins} wins and {losses} losses")
    discordant = wins + losses
    tail = sum(math.comb(discordant, k) for k in range(min(wins, losses) + 1))
    return min(1.0, 2 * tail / 2**discordant)  # integers: exact for any count


def paired_interval(wins: int, losses: int, n: int, confidence: float = 0.95) -> Interval:
    """Interval of a paired difference of rates, after Bonett and Price (2012): Wald with one pair added to
    each side.

        a = (wins + 1) / (n + 2),  b = (losses + 1) / (n + 2)
        a − b ± z √((a + b − (a − b)²) / (n + 2)),  cut to [−1, 1]

    It needs no resampling, and keeps its coverage where a bootstrap collapses to a point: with few or no
    disagreements.

    Raises:
        ValueError: more disagreements than pairs, or a confidence out of range.
    """
    if wins < 0 or losses < 0 or wins + losses > n:
        raise ValueError(f"{wins} wins and {losses} losses in {n} pairs")
    a, b = (wins + 1) / (n + 2), (losses + 1) / (n + 2)
    half = _quantile(confidence) * math.sqrt((a + b - (a - b) ** 2) / (n + 2))
    return Interval(low=max(-1.0, a - b - half), high=min(1.0, a - b + half))


def mean_interval(values: Sequence[float], confidence: float = 0.95) -> Interval:
    """Interval of the mean of what differs from run to run, by Student's t (1908).

        m ± t · s / √k,  s² = Σ (x − m)² / (k − 1),  t of k − 1 degrees of freedom

    Policies of several seeds differ by more than their episodes do, so all their episodes together, as if one
    policy had played them, would say too much.

    Args:
        values: one of each run, at least two; not cut to any range.
        confidence: above 0 and below 1.

    Raises:
        ValueError: fewer than two values, or a confidence out of range.
    """
    if len(values) < 2:
        raise ValueError(f"{len(values)} values: use at least two")
    _quantile(confidence)
    from scipy.special import stdtrit

    count, mean = len(values), math.fsum(values) / len(values)
    spread = math.sqrt(math.fsum((x - mean) ** 2 for x in values) / (count - 1))
    half = float(stdtrit(count - 1, (1 + confidence) / 2)) * spread / math.sqrt(count)
    return Interval(low=mean - half, high=mean + half)


def compare(a: Outcomes, b: Outcomes, confidence: float = 0.95) -> Comparison:
    """True if a is better than b, episode by episode.

    Args:
        a: outcomes of one policy.
        b: outcomes of the other, on exactly the same (task, seed) pairs.
        confidence: of the interval.

    Raises:
        ValueError: the episodes differ, or there are none.
    """
    unpaired = sorted(a.keys() ^ b.keys())
    if unpaired:
        raise ValueError(f"{len(unpaired)} episodes have no partner, such as {unpaired[0]}")
    if not a:
        raise ValueError("no episodes to compare")
    wins = sum(a[k] and not b[k] for k in a)
    losses = sum(b[k] and not a[k] for k in a)
    return Comparison(
        n=len(a),
        wins=wins,
        losses=losses,
        difference=(wins - losses) / len(a),
        interval=paired_interval(wins, losses, len(a), confidence),
        p_value=mcnemar_p(wins, losses),
    )


def total(outcomes: Outcomes) -> Rate:
    """All episodes together."""
    return Rate(successes=sum(map(bool, outcomes.values())), n=len(outcomes))


def per_task(outcomes: Outcomes) -> dict[str, Rate]:
    """One rate per task, in alphabetical order."""
    tasks = sorted({task for task, _ in outcomes})
    return {task: total({k: v for k, v in outcomes.items() if k[0] == task}) for task in tasks}


def task_mean(rates: Mapping[str, Rate]) -> float:
    """Mean of the task rates, each task counting alike whatever its n; NaN without tasks.

    Raises:
        ValueError: a task has no episode.
    """
    empty = [task for task, rate in rates.items() if rate.n == 0]
    if empty:
        raise ValueError(f"{empty[0]} has no episode")
    return sum(rate.value for rate in rates.values()) / len(rates) if rates else math.nan


def format_rate(successes: int, n: int, confidence: float = 0.95) -> str:
    """``93.0 % [86.3, 96.6] n=100``: rate, `wilson_interval` and n."""
    if n == 0:
        return "no episodes"
    interval = wilson_interval(successes, n, confidence)
    return f"{100 * successes / n:.1f} % [{100 * interval.low:.1f}, {100 * interval.high:.1f}] n={n}"


def _quantile(confidence: float) -> float:
    """z such that a standard normal is within ±z with this probability."""
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence {confidence}: use a number between 0 and 1")
    return NormalDist().inv_cdf((1 + confidence) / 2)
