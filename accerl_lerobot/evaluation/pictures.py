# SPDX-License-Identifier: Apache-2.0
"""Pictures for people: the success curve, and the policy before and after."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from accerl_lerobot.rollout.runner import EpisodeResult

GAP = 4
"""Pixels of white between two clips."""
BORDER = 5
"""Width, in pixels, of the frame that tells how an episode ended."""


@contextmanager
def drawing(path: Path, size: tuple[float, float] = (7, 4)) -> Iterator[Any]:
    """Axes to draw on, with a grid, which are a PNG when the context is left.

    Args:
        path: of it.
        size: in inches of 120 pixels.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=size, dpi=120)
    axes.grid(alpha=0.3)
    try:
        yield axes
        figure.tight_layout()
        figure.savefig(path)
    finally:
        plt.close(figure)


def success_curve(
    path: Path, evaluations: Sequence[dict[str, Any]], training: Sequence[tuple[float, float]]
) -> None:
    """Draws evaluation success with intervals over env steps, and the exploring policy's success behind it.

    Args:
        path: PNG to write.
        evaluations: `summarise` results with an ``env_steps`` entry.
        training: (env steps, share of successful exploring episodes) pairs.
    """
    with drawing(path) as axes:
        if training:
            steps, share = zip(*training, strict=True)
            axes.plot(steps, share, color="0.7", lw=1.5, label="while exploring")
        evaluations = sorted(evaluations, key=lambda e: e["env_steps"])
        x = [e["env_steps"] for e in evaluations]
        y = [e["success"] for e in evaluations]
        # Rounding may leave the rate a hair outside its interval, and matplotlib refuses negative lengths.
        low = [max(0.0, e["success"] - e["ci95"][0]) for e in evaluations]
        high = [max(0.0, e["ci95"][1] - e["success"]) for e in evaluations]
        axes.errorbar(
            x, y, yerr=[low, high], marker="o", capsize=3, color="C0", label="evaluation, 95 % Wilson"
        )
        for e in (evaluations[0], evaluations[-1]):
            place = (e["env_steps"], e["success"])
            axes.annotate(f"n={e['n']}", place, textcoords="offset points", xytext=(6, -12), fontsize=8)
        axes.set(xlabel="env steps of online experience", ylabel="success", ylim=(-0.02, 1.02))
        axes.legend(loc="lower right")


def write_video(
    path: Path,
    rows: Sequence[Sequence[Sequence[np.ndarray]]],
    fps: int,
    above: Callable[[int], np.ndarray] | None = None,
) -> None:
    """Writes a grid of clips; one that ends early holds its last frame.

    Args:
        path: .mp4 to write.
        rows: rows of clips, as many in each; frames of a clip are uint8 (H, W, 3), all of one size in a row.
        fps: frames per second.
        above: number of a frame → what is put above the grid in it, as wide as that.

    Raises:
        ValueError: no clip, one without frames, or rows of unequal length.
    """
    import imageio.v2 as imageio

    clips = [clip for row in rows for clip in row]
    if not clips or not all(map(len, clips)):
        raise ValueError("every clip needs a frame")
    if len({len(row) for row in rows}) != 1:
        raise ValueError("every row needs as many clips")
    length = max(len(clip) for clip in clips)
    # The pixel format every player knows, at the price of even sides: an odd last row or column is left out.
    writer: Any = imageio.get_writer(
        path, fps=fps, macro_block_size=1, codec="libx264", pixelformat="yuv420p"
    )
    with writer:
        for i in range(length + fps):
            lines = [_joined([clip[min(i, len(clip) - 1)] for clip in row], axis=1) for row in rows]
            picture = _joined([*([] if above is None else [above(i)]), *lines], axis=0)
            writer.append_data(picture[: picture.shape[0] // 2 * 2, : picture.shape[1] // 2 * 2])


def before_after(
    path: Path,
    before: tuple[Sequence[EpisodeResult], dict[str, Any] | None],
    after: tuple[Sequence[EpisodeResult], dict[str, Any] | None],
    fps: int,
) -> None:
    """Films the same episodes twice, before training on the left and after it on the right.

    Above each half stand the evaluation's numbers, and how many of the filmed episodes have succeeded so far;
    the frame of an episode that has ended is green for a success and red for a failure.

    Args:
        path: .mp4 to write; nothing is written when no episode was filmed.
        before: results, of which those with frames are shown, and their summary by `summary.summarise`.
        after: the same of the same plans.
        fps: frames per second.
    """
    filmed = [{r.plan.index: r for r in results if r.frames} for results, _ in (before, after)]
    both = sorted(filmed[0].keys() & filmed[1].keys())
    if not both:
        return
    columns = math.ceil(math.sqrt(len(both)))
    blank = np.full_like(filmed[0][both[0]].frames[0], 255)
    gap = np.full((len(blank), 2 * GAP, 3), 255, np.uint8)
    halves = [
        [captioned(half[i].frames, "", half[i].success) for i in both]
        + [[blank]] * (-len(both) % columns)
        for half in filmed
    ]  # fmt: skip
    left, right = ([half[i : i + columns] for i in range(0, len(half), columns)] for half in halves)
    rows = [[*one, [gap], *two] for one, two in zip(left, right, strict=True)]
    width = columns * (blank.shape[1] + GAP) - GAP

    def above(number: int) -> np.ndarray:
        lines = []
        for name, half, (_, summary) in zip(("before", "after"), filmed, (before, after), strict=True):
            ended = sum(half[i].success and number >= len(half[i].frames) for i in both)
            count = f"{ended} of these {len(both)} succeeded"
            lines.append([f"{name} RL: {_rate(summary)}", count])
        return _caption(lines, width, gap.shape[1] + 2 * GAP)

    write_video(path, rows, fps, above)


def _rate(summary: dict[str, Any] | None) -> str:
    if summary is None:
        return "not evaluated"
    low, high = summary["ci95"]
    return f"{summary['success']:.0%} success [{low:.0%}, {high:.0%}], n = {summary['n']}"


def _caption(halves: Sequence[Sequence[str]], width: int, gap: int) -> np.ndarray:
    """Lines of black text over each half of a picture, 8 to 20 pixels high, as large as they fit.

    Args:
        halves: as many lines for each.
        width: of a half in pixels.
        gap: between them.
    """
    from PIL import Image, ImageDraw, ImageFont

    longest = max((line for lines in halves for line in lines), key=len)
    size = 20
    while size > 8 and ImageFont.load_default(size).getlength(longest) > width - 8:
        size -= 1
    step, font = size + 6, ImageFont.load_default(size)
    image = Image.new("RGB", (len(halves) * (width + gap) - gap, step * len(halves[0]) + 6), "white")
    draw = ImageDraw.Draw(image)
    for half, lines in enumerate(halves):
        for i, line in enumerate(lines):
            draw.text((half * (width + gap) + 4, 4 + step * i), line, fill="black", font=font)
    return np.asarray(image)


def captioned(frames: Sequence[np.ndarray], name: str, success: bool) -> list[np.ndarray]:
    """Frames uint8 (H, W, 3) under a name, and one more that tells the end by the colour of its frame."""
    from PIL import Image, ImageDraw

    told = []
    for i in range(len(frames) + 1):
        image = Image.fromarray(frames[min(i, len(frames) - 1)])
        draw = ImageDraw.Draw(image)
        draw.text((6, 4), name, fill=(255, 255, 255), stroke_width=1, stroke_fill=(0, 0, 0))
        if i == len(frames):
            colour = (40, 160, 60) if success else (200, 40, 40)
            draw.rectangle((0, 0, image.width - 1, image.height - 1), outline=colour, width=BORDER)
        told.append(np.asarray(image))
    return told


def _joined(pictures: Sequence[np.ndarray], axis: int) -> np.ndarray:
    """Pictures beside (axis 1) or below (axis 0) each other, white between them."""
    shape = list(pictures[0].shape)
    shape[axis] = GAP
    gap = np.full(shape, 255, np.uint8)
    return np.concatenate([part for picture in pictures for part in (picture, gap)][:-1], axis=axis)
