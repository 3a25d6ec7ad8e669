# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""What people look at: the success curve, and the policy before and after."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

GAP = 4
"""Columns of white between two clips."""


def success_curve(
    path: Path, evaluations: Sequence[dict[str, Any]], training: Sequence[tuple[float, float]]
) -> None:
    """Draws evaluation success with intervals over env steps, and the exploring policy's success behind it.

    Args:
        path: PNG to write.
        evaluations: `summarise` results with an ``env_steps`` entry.
        training: (env steps, share of successful exploring episodes) pairs.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4), dpi=120)
    if training:
        steps, share = zip(*training, strict=True)
        axes.plot(steps, share, color="0.7", lw=1.5, label="while exploring")
    evaluations = sorted(evaluations, key=lambda e: e["env_steps"])
    x = [e["env_steps"] for e in evaluations]
    y = [e["success"] for e in evaluations]
    # Rounding may leave the rate a hair outside its interval, and matplotlib refuses negative lengths.
    low = [max(0.0, e["success"] - e["ci95"][0]) for e in evaluations]
    high = [max(0.0, e["ci95"][1] - e["success"]) for e in evaluations]
    axes.errorbar(x, y, yerr=[low, high], marker="o", capsize=3, color="C0", label="evaluation, 95 % Wilson")
    for e in (evaluations[0], evaluations[-1]):
        place = (e["env_steps"], e["success"])
        axes.annotate(f"n={e['n']}", place, textcoords="offset points", xytext=(6, -12), fontsize=8)
    axes.set(xlabel="env steps of online experience", ylabel="success", ylim=(-0.02, 1.02))
    axes.grid(alpha=0.3)
    axes.legend(loc="lower right")
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


def write_video(path: Path, clips: Sequence[Sequence[np.ndarray]], fps: int) -> None:
    """Writes clips side by side; one that ends early holds its last frame.

    Args:
        path: .mp4 to write.
        clips: frames of each, uint8 (H, W, 3), all of one size.
        fps: frames per second.

    Raises:
        ValueError: no clip, or one without frames.
    """
    import imageio.v2 as imageio

    if not clips or not all(clips):
        raise ValueError("every clip needs a frame")
    length = max(len(clip) for clip in clips)
    gap = np.full((clips[0][0].shape[0], GAP, 3), 255, np.uint8)
    # The pixel format every player knows, at the price of even sides: an odd last row or column is left out.
    writer: Any = imageio.get_writer(
        path, fps=fps, macro_block_size=1, codec="libx264", pixelformat="yuv420p"
    )
    with writer:
        for i in range(length + fps // 2):
            tiles: list[np.ndarray] = []
            for clip in clips:
                tiles += [clip[min(i, len(clip) - 1)], gap]
            row = np.concatenate(tiles[:-1], axis=1)
            writer.append_data(row[: row.shape[0] // 2 * 2, : row.shape[1] // 2 * 2])
