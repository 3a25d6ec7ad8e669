# SPDX-License-Identifier: Apache-2.0
"""Numbers as people read them."""

from __future__ import annotations

import math

import pytest

from accerl_lerobot.console import count, duration, number, percent, rate


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (math.nan, "–"), (136266.0, "136,266"), (0.0512345, "0.05123"), (0.0, "0"), (-2.5, "-2.5")],
)
def test_numbers(value: float | None, text: str) -> None:
    assert number(value) == text


def test_rates_have_their_interval() -> None:
    assert rate(0.46, [0.3656, 0.5574]) == "46\xa0% [37, 56]"
    assert rate(0.61333, (0.5, 0.7)) == "61.3\xa0% [50, 70]"
    assert rate(None, None) == "–" and percent(1.0) == "100\xa0%"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(3.21, "3.21 s"), (59.96, "60 s"), (593.0, "9 min 53 s"), (7500.0, "2 h 05 min"), (None, "–")],
)
def test_durations(seconds: float | None, text: str) -> None:
    assert duration(seconds) == text


def test_counts() -> None:
    assert (count(1, "run"), count(1234, "run")) == ("1 run", "1,234 runs")
