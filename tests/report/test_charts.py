# SPDX-License-Identifier: Apache-2.0
"""Geometry by hand, and what must hold of any chart."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from accerl_lerobot.report.charts import (
    SPANS,
    Chart,
    Series,
    draw,
    drawable,
    limit,
    line,
    rates,
    ticks,
)


def chart(*series: Series, **fields: object) -> Chart:
    return Chart(title="Lag", x_label="updates", series=series, **fields)  # type: ignore[arg-type]


def test_thinning_keeps_every_extreme_and_the_mean() -> None:
    generator = np.random.default_rng(0)
    y = generator.standard_normal(10_000)
    y[1234], y[9876] = 50.0, -50.0
    thinned = line("a", np.arange(10_000.0), y)
    assert len(thinned.x) == SPANS and thinned.low is not None and thinned.high is not None
    assert thinned.high.max() == 50.0 and thinned.low.min() == -50.0
    assert (thinned.low <= thinned.y).all() and (thinned.y <= thinned.high).all()
    assert thinned.y.mean() == pytest.approx(y.mean())  # spans hold as many points each
    assert line("a", np.arange(10_000.0), y, how="max").y.max() == 50.0


def test_thinning_by_hand() -> None:
    """Twice as many points as spans: each span is a pair."""
    thinned = line("a", np.arange(2.0 * SPANS), np.tile([1.0, 3.0], SPANS))
    assert np.allclose(thinned.y, 2) and thinned.low is not None and thinned.high is not None
    assert np.allclose(thinned.low, 1) and np.allclose(thinned.high, 3)
    assert thinned.x[:2].tolist() == [0.5, 2.5] and thinned.reach == (0.0, 2.0 * SPANS - 1)


def test_short_lines_stay_as_they_are_without_their_gaps() -> None:
    kept = line("a", np.array([1.0, 2.0, 3.0]), np.array([5.0, np.nan, 7.0]))
    assert kept.x.tolist() == [1, 3] and kept.y.tolist() == [5, 7] and kept.low is None


def test_uneven_points_leave_no_empty_span() -> None:
    x = np.concatenate([np.linspace(0, 1, 400), [1000.0]])
    thinned = line("a", x, np.ones(401))
    assert len(thinned.x) == 2 and np.isfinite(thinned.y).all()


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(0, 1, [0, 0.2, 0.4, 0.6, 0.8, 1]), (0, 169_121, [0, 50_000, 100_000, 150_000]), (-3, 4, [-2, 0, 2, 4])],
)
def test_ticks(low: float, high: float, expected: list[float]) -> None:
    found, _ = ticks(low, high, 5)
    assert found == pytest.approx(expected)


@pytest.mark.parametrize(
    ("top", "texts"),
    [
        (1e-4, ["0", "2e-5", "4e-5", "6e-5", "8e-5", "1e-4"]),
        (0.004, ["0", "0.001", "0.002", "0.003", "0.004"]),
        (250_000, ["0", "50 k", "100 k", "150 k", "200 k", "250 k"]),
        (1200, ["0", "200", "400", "600", "800", "1.0 k", "1.2 k"]),
    ],
)
def test_labels_of_an_axis(top: float, texts: list[str]) -> None:
    drawn = draw(chart(line("a", np.arange(2.0), np.array([0.0, top])), limits=(0.0, top)))
    assert [tick.text for tick in drawn.y_ticks] == texts


def test_a_line_from_corner_to_corner() -> None:
    drawn = draw(chart(line("a", np.array([0.0, 10.0]), np.array([0.0, 1.0])), limits=(0.0, 1.0)))
    (shape,) = drawn.shapes
    assert shape.path == "M0 400L1000 0" and shape.style == "c0 line"
    assert [(tick.at, tick.text) for tick in drawn.x_ticks] == [
        (0, "0"), (20, "2"), (40, "4"), (60, "6"), (80, "8"), (100, "10"),
    ]  # fmt: skip
    assert drawn.y_ticks[0].at == 100 and drawn.y_ticks[-1].at == 0


def test_points_have_intervals_and_dots() -> None:
    half = np.array([0.5, 0.5])
    points = Series(
        name="a", x=np.array([0.0, 50.0]), y=half, low=half - 0.25, high=half + 0.25, kind="points", colour=9
    )
    shapes = {shape.style: shape.path for shape in draw(chart(points, limits=(0.0, 1.0), share=True)).shapes}
    assert set(shapes) == {f"c1 dashed {kind}" for kind in ("interval", "points", "dot")}
    at = 1000 * 1 / 52  # two per cent of room on both sides
    assert shapes["c1 dashed interval"].startswith(f"M{at:.1f} 300V100")
    assert shapes["c1 dashed dot"].startswith(f"M{at:.1f} 200h0")


def test_a_limit_goes_across_and_is_within_sight() -> None:
    drawn = draw(chart(line("a", np.arange(5.0), np.ones(5)), limit("bound", 20.0), limits=(0.0, None)))
    (across,) = [shape for shape in drawn.shapes if "limit" in shape.style]
    height = re.fullmatch(r"M0 ([\d.]+)H1000", across.path)
    assert height and 0 < float(height[1]) < 40
    assert "bound: 20." in drawn.label


def test_a_chart_of_one_value_can_be_drawn() -> None:
    drawn = draw(chart(line("a", np.array([1.0, 2.0]), np.array([3.0, 3.0]))))
    assert drawn.y_ticks and "nan" not in drawn.shapes[0].path


def test_nothing_that_counts_from_zero_up_goes_below() -> None:
    drawn = draw(chart(line("a", np.arange(3.0), np.array([0.0, 5.0, 9.0]))))
    assert drawn.hover["y"][0] == 0


def test_words_for_those_who_do_not_see_it() -> None:
    drawn = draw(chart(line("mean", np.arange(3.0), np.array([0.1, 0.9, 0.5])), share=True))
    assert drawn.label == "Lag over updates. mean: from 10\xa0% to 50\xa0%, between 10\xa0% and 90\xa0%."


def test_what_the_page_is_told_is_json_in_the_strict_sense() -> None:
    gaps = Series(name="a", x=np.array([0.0, 1.0]), y=np.array([1.0, 2.0]), kind="points")
    drawn = draw(chart(gaps, limit("b", 3.0)))
    json.dumps(drawn.hover, allow_nan=False)


def test_rates_by_hand() -> None:
    """10 a second for a minute, then 40 a second for a minute."""
    seconds = np.array([0.0, 60.0, 120.0])
    grown = rates("a", seconds, np.array([0.0, 600.0, 3000.0]), spans=2)
    assert grown.x.tolist() == [0.5, 1.5] and grown.y.tolist() == [10.0, 40.0]
    assert len(rates("a", seconds[:1], np.array([5.0])).x) == 0


def test_drawable() -> None:
    assert not drawable(chart(line("a", np.array([1.0]), np.array([1.0])), limit("b", 2.0)))
    assert drawable(chart(Series(name="a", x=np.array([1.0]), y=np.array([1.0]), kind="points")))
