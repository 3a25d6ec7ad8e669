# SPDX-License-Identifier: Apache-2.0
"""Films of dreams beside what happened."""

from __future__ import annotations

from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest

from accerl_lerobot.evaluation.pictures import GAP
from accerl_lerobot.world_model.films import SCALE, TrialFilms, beside
from accerl_lerobot.world_model.success import new_success_model
from tests.world_model.test_pixels import SIZE, K, dots
from tests.world_model.test_trial import Deterministic, with_successes

LARGE = SCALE * SIZE


def film(path: Path) -> np.ndarray:
    return np.stack(imageio.mimread(path))


def halves(path: Path) -> tuple[np.ndarray, np.ndarray]:
    frames = film(path)
    assert frames.shape[1:] == (2 * LARGE + GAP, LARGE, 3)
    return frames[:, :LARGE], frames[:, LARGE + GAP :]


@pytest.mark.parametrize("kind", ["exact", "copy"])
def test_above_is_what_happened_and_below_what_was_dreamt(kind: str, tmp_path: Path):
    episode = dots(1, steps=13, seed=5)[0]
    beside(tmp_path / "film.mp4", Deterministic(kind), None, episode, scale=SCALE)
    above, below = halves(tmp_path / "film.mp4")
    shown = episode.frames[::K, 0].repeat(SCALE, 1).repeat(SCALE, 2).astype(int)
    assert len(above) > len(shown) == 7
    for t, expected in enumerate(shown):
        mask = slice(16, None)  # below the name
        assert np.abs(above[t][mask] - expected[mask]).mean() < 12
        dreamt = expected if kind == "exact" else shown[0]
        assert np.abs(below[t][mask] - dreamt[mask]).mean() < 12
    assert [p.name for p in tmp_path.iterdir()] == ["film.mp4"]


def test_the_colour_of_the_end_tells_how_it_went(tmp_path: Path):
    success = new_success_model(K).eval()
    failure = dots(1, seed=3)[0]
    achieved = next(e for e in with_successes(dots(20, seed=1)) if e.success)
    colours = []
    for episode in (failure, achieved):
        for success.config.threshold in (0.0, 1.0):
            beside(tmp_path / "film.mp4", Deterministic("exact"), success, episode)
            borders = [part[-1][-2, 4:-4].mean(0) for part in halves(tmp_path / "film.mp4")]
            colours.append(["green" if b[1] > b[0] else "red" for b in borders])
    assert colours == [["red", "green"], ["red", "red"], ["green", "green"], ["green", "red"]]


def test_every_so_many_trials_are_filmed(tmp_path: Path):
    films = TrialFilms(tmp_path / "dreams", every=3)
    for number in range(1, 6):
        films(Deterministic("exact"), new_success_model(K).eval(), dots(1)[0], number, number == 4)
    assert sorted(p.name for p in films.folder.iterdir()) == ["0001_failed.mp4", "0004_passed.mp4"]
