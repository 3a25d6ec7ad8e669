# SPDX-License-Identifier: Apache-2.0
"""The curve and the video that people look at."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pytest

from accerl_lerobot import evaluation
from accerl_lerobot.evaluation import GAP, before_after, success_curve
from accerl_lerobot.rollout.runner import EpisodePlan, EpisodeResult


def evaluated(env_steps: float, successes: int, n: int) -> dict[str, Any]:
    ci95 = list(evaluation.Rate(successes=successes, n=n).interval())
    return {"env_steps": env_steps, "success": successes / n, "n": n, "ci95": ci95}


def clip(frames: int, colour: tuple[int, int, int], side: int = 32) -> list[np.ndarray]:
    return [np.full((side, side, 3), colour, np.uint8) for _ in range(frames)]


def result(index: int, success: bool, frames: list[np.ndarray]) -> EpisodeResult:
    plan = EpisodePlan(task="t", seed=index, explore=False, index=index)
    return EpisodeResult(
        plan=plan, success=success, episode_return=0.0, steps=1, decisions=1, versions=(0, 0), frames=frames,
    )  # fmt: skip


def read(path: Path) -> np.ndarray:
    return np.stack([np.asarray(frame) for frame in imageio.get_reader(path)])


def test_the_curve_is_drawn(tmp_path: Path) -> None:
    """Pixels of rates and intervals are as far apart as the rates are, and exploration is there in grey."""

    def drawn(e: dict[str, Any], training: list[tuple[float, float]]) -> tuple[np.ndarray, np.ndarray]:
        success_curve(tmp_path / "curve.png", [e, e | {"env_steps": 5000}], training)
        image = np.asarray(imageio.imread(tmp_path / "curve.png"))[..., :3].astype(int)
        assert image.shape == (480, 840, 3)
        return abs(image - (31, 119, 180)).sum(-1) < 30, abs(image - 178).sum(-1) < 30

    rates = [evaluated(0, *of) for of in ((50, 100), (5, 10), (90, 100))]
    ends = [np.flatnonzero(drawn(e, [])[0][:, :300].any(1))[[0, -1]] for e in rates]
    tall = [bottom - top for top, bottom in ends]
    scale = [pixels / (e["ci95"][1] - e["ci95"][0]) for pixels, e in zip(tall, rates, strict=True)]
    assert scale == pytest.approx([scale[0]] * 3, rel=0.06) and 300 < scale[0] < 480
    higher = ends[0].mean() - ends[2].mean()
    assert higher == pytest.approx(scale[0] * (np.mean(rates[2]["ci95"]) - 0.5), rel=0.06)
    grey = [drawn(rates[0], training)[1].sum() for training in ([], [(0, 0.2), (5000, 0.8)])]
    assert grey[1] > grey[0] + 500


def test_before_beside_after_with_outcomes(tmp_path: Path) -> None:
    grey = clip(3, (120, 120, 120), side=64)
    before = [result(i, i == 0, grey) for i in (1, 0, 2)] + [result(3, True, [])]
    after = [result(i, i != 2, grey) for i in range(4)]
    before_after(tmp_path / "film.mp4", before, after, fps=4)
    film = read(tmp_path / "film.mp4").astype(int)
    half = 2 * 64 + GAP
    assert film.shape[1:3] == (half, 2 * half + 4 * GAP)

    def edge(frame: int, row: int, column: int) -> str:
        left = column % 2 * (64 + GAP) + column // 2 * (half + 4 * GAP)
        red, green, _ = film[frame, row * (64 + GAP) + 61, left + 20 : left + 44].mean(0)
        return "red" if red > green + 60 else "green" if green > red + 60 else "none"

    assert [edge(0, r, c) for r in (0, 1) for c in range(4)] == ["none"] * 8
    ends = [edge(-1, r, c) for r in (0, 1) for c in range(4)]
    assert ends == ["green", "red", "green", "green", "red", "none", "red", "none"]
    assert (film[:, 80:, 80:half] > 150).all(), "no fourth episode"


def test_what_cannot_be_drawn_is_left_out_with_a_warning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    nowhere = tmp_path / "missing"
    success_curve(nowhere / "curve.png", [evaluated(0, 1, 2)], [])
    sizes = ([result(0, True, clip(1, (0, 0, 0), side))] for side in (32, 16))
    before_after(tmp_path / "both.mp4", *sizes, fps=4)
    starts = ("success_curve.png", "film (")
    assert all(m.startswith(f"there is no {s}") for m, s in zip(caplog.messages, starts, strict=True))
    before_after(tmp_path / "film.mp4", [], [], fps=4)
    assert list(tmp_path.iterdir()) == [], "without frames there is no video"
