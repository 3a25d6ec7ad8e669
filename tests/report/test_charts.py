# SPDX-License-Identifier: Apache-2.0
"""Lines by hand, and what must hold of any picture."""

from __future__ import annotations

import base64
import re
from xml.etree import ElementTree

import numpy as np
import pytest

from accerl_lerobot.report.charts import COLOURS, POINTS, Chart, Series, line


def chart(*series: Series, **fields: object) -> Chart:
    return Chart("Lag", "", "updates", series, **fields)  # type: ignore[arg-type]


def heights(svg: str, colour: int = 0) -> list[float]:
    """Vertical positions along the first path of a colour, from the top."""
    path = re.search(rf'<path d="([^"]+)"[^>]*stroke: {COLOURS[colour]}', svg)
    assert path
    return [float(y) for y in re.findall(r"[ML] \S+ (\S+)", path[1])]


def test_thinning_keeps_every_extreme_and_the_mean() -> None:
    generator = np.random.default_rng(0)
    y = generator.standard_normal(10_000)
    y[1234], y[9876] = 50.0, -50.0
    thinned = line("a", np.arange(10_000.0), y)
    assert len(thinned.x) == POINTS and thinned.low is not None and thinned.high is not None
    assert thinned.high.max() == 50.0 and thinned.low.min() == -50.0
    assert (thinned.low <= thinned.y).all() and (thinned.y <= thinned.high).all()
    assert thinned.y.mean() == pytest.approx(y.mean(), abs=0.01)


def test_short_lines_stay_as_they_are_without_their_gaps() -> None:
    kept = line("a", np.array([1.0, 2.0, 3.0]), np.array([5.0, np.nan, 7.0]))
    assert kept.x.tolist() == [1, 3] and kept.y.tolist() == [5, 7] and kept.low is None


def test_the_picture_shows_the_numbers_and_no_text_of_a_run() -> None:
    rising = line("<b>hostile</b> $\\frac{", np.array([0.0, 5.0, 10.0]), np.array([0.0, 1.0, 0.5]))
    svg = base64.b64decode(chart(rising, share=True, bottom=0.0, top=1.0).svg()).decode()
    ElementTree.fromstring(svg)
    low, high, middle = heights(svg)
    assert high < middle < low and middle == pytest.approx((low + high) / 2, abs=0.01)
    assert "hostile" not in svg and "updates" in svg and "100\xa0%" in svg


def test_the_legend_has_first_and_last_values() -> None:
    x, y = np.arange(3.0), np.array([0.1, 0.9, 0.5])
    legend = chart(line("mean", x, y), line("none", x[:0], y[:0]), line("other", x, y)).legend
    assert legend == [(COLOURS[0], "mean", "0.1 → 0.5"), (COLOURS[2], "other", "0.1 → 0.5")]
