# SPDX-License-Identifier: Apache-2.0
"""Numbers as people read them."""

from __future__ import annotations

import math
from collections.abc import Sequence

ABSENT = "–"
UNBROKEN = "\N{NO-BREAK SPACE}"


def number(value: float | None, digits: int = 4) -> str:
    """At most so many significant digits, thousands apart; a dash where there is none.

    Example:
        >>> number(136266.0), number(0.0512345), number(None)
        ('136,266', '0.05123', '–')
    """
    if value is None or not math.isfinite(value):
        return ABSENT
    if value == int(value) or abs(value) >= 10**digits:
        return f"{value:,.0f}"
    return f"{value:.{digits}g}"


def percent(share: float | None) -> str:
    """A share as ``98 %``, with a decimal where it has one; no line breaks before the sign."""
    if share is None or not math.isfinite(share):
        return ABSENT
    return f"{100 * share:.3g}{UNBROKEN}%"


def rate(success: float | None, interval: Sequence[float] | None) -> str:
    """``46 % [37, 56]``; a dash where there is none."""
    if success is None or interval is None:
        return ABSENT
    low, high = (f"{100 * end:.0f}" for end in interval)
    return f"{percent(success)} [{low}, {high}]"


def duration(seconds: float | None) -> str:
    """``3.2 s``, ``9 min 53 s`` or ``2 h 05 min``."""
    if seconds is None or not math.isfinite(seconds):
        return ABSENT
    if seconds < 60:
        return f"{seconds:.3g} s"
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02} min"


def count(n: int, thing: str) -> str:
    """``1 run``, ``2 runs``."""
    return f"{n:,} {thing}{'' if n == 1 else 's'}"
