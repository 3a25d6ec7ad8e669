# SPDX-License-Identifier: Apache-2.0
"""Three numbers of a pixel world model, on episodes that it was not trained on.

    skill          1 − MSE / MSE of a copy of the last frame, after one chunk, where pixels changed
    sensitivity    MSE with another episode's actions / MSE with the executed ones, after one chunk
    auroc          of the highest P(success) in an imagined replay of an episode, and its real outcome

Better pixels than a copy prove nothing: a model may learn to blur what moves and ignore the actions. And
whole imagined episodes must end as the real ones did, as an imagined episode ends with its first success.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.table import Table
from torch import Tensor

from accerl_lerobot.evaluation import write_video
from accerl_lerobot.experience import task_codes
from accerl_lerobot.world_model.contract import Windows, replay
from accerl_lerobot.world_model.data import Episode, WindowStart, cut_windows
from accerl_lerobot.world_model.imagined import World
from accerl_lerobot.world_model.training import whole_windows

BOUNDS = {"skill": 0.3, "sensitivity": 1.2, "auroc": 0.9}  # numbers that a world model must exceed
MOST_WINDOWS, MOST_REPLAYS = 400, 200
CHANGED = 16  # a pixel counts as changed if one of its colours differs by more, of 255
FALSE_POSITIVES = 0.1  # largest share of failures that may pass for successes
PREVIEWED, SCALE, FPS = 4, 3, 4  # episodes in the video, its enlargement, and its chunks per second


def check(world: World, episodes: Sequence[Episode], seed: int = 0) -> dict[str, Any]:
    """Checks a world.

    Returns:
        ``checks``: value, bound and outcome of each of the three numbers; ``passed``; ``threshold`` of the
        success model, chosen on these episodes; numbers of ``episodes`` and ``env_steps``.
    """
    rng, chunk = np.random.default_rng((seed, 1)), world.model.spec.chunk
    at = []
    for e, episode in enumerate(episodes):
        followed = np.flatnonzero(episode.times + chunk <= episode.times[-1])
        at += [WindowStart(e, int(frame)) for frame in followed]
    chosen = rng.permutation(len(at))[:MOST_WINDOWS]
    values = {"skill": float("nan"), "sensitivity": float("nan")}
    if len(chosen):
        windows = cut_windows(episodes, [at[i] for i in chosen], world.model.spec, 1)
        values = skill_and_sensitivity(world, windows)
    scores, achieved = replay_scores(world, episodes[:MOST_REPLAYS])
    values["auroc"] = auroc(scores, achieved)
    checks = {
        name: {"value": value, "above": BOUNDS[name], "holds": value > BOUNDS[name]}  # NaN passes nothing
        for name, value in values.items()
    }
    return {
        "passed": all(outcome["holds"] for outcome in checks.values()),
        "checks": checks,
        "threshold": choose_threshold(scores, achieved),
        "episodes": len(episodes),
        "env_steps": sum(map(len, episodes)),
    }


def skill_and_sensitivity(world: World, windows: Windows) -> dict[str, float]:
    """Both numbers, on the first chunk of windows."""
    recorded, newest = windows.frames[:, 0], windows.context.frames[:, -1]
    other = replace(windows, actions=windows.actions[donors(windows.episode)])
    predicted, misled = replay(world.model, windows)[:, 0], replay(world.model, other)[:, 0]
    changed = (recorded.int() - newest.int()).abs().amax(-1) > CHANGED
    errors, copied = squared_errors(predicted, recorded), squared_errors(newest, recorded)
    misled_error = squared_errors(misled, recorded).mean()
    skill = 1 - errors[changed].mean() / copied[changed].mean()  # NaN where nothing changes
    return {"skill": float(skill), "sensitivity": float(misled_error / errors.mean().clamp(min=1e-9))}


def squared_errors(frames: Tensor, target: Tensor) -> Tensor:
    """Mean squared error of each pixel's colours, of uint8 frames (..., 3)."""
    return (frames.float() - target.float()).square().mean(-1)


def donors(episode: Tensor) -> Tensor:
    """For each row another row, of another episode where no episode has more than half of the rows."""
    order = torch.argsort(episode, stable=True)
    largest = int(torch.bincount(episode).max())
    chosen = torch.empty_like(order)
    chosen[order] = order.roll(-largest)
    return chosen


def replay_scores(world: World, episodes: Sequence[Episode]) -> tuple[np.ndarray, np.ndarray]:
    """Highest P(success) in each episode's imagined replay, until it really ended, and the real outcome."""
    windows = whole_windows(episodes, [WindowStart(e, 0) for e in range(len(episodes))], world)
    known, frames = windows.known, replay(world.model, windows)
    codes = torch.from_numpy(task_codes(windows.tasks))
    codes = codes[:, None].expand(-1, known.shape[1], -1)
    probabilities = torch.zeros(known.shape)
    probabilities[known] = world.success.probabilities(frames[known], codes[known])
    return probabilities.amax(1).numpy(), windows.success.any(1).numpy()


def choose_threshold(scores: np.ndarray, achieved: np.ndarray) -> float:
    """Chooses the score above which a replay counts as a success, at least 0.5.

    Of the thresholds that let at most `FALSE_POSITIVES` of the failures through, the threshold with the
    largest share of successes less share of failures above it. The strictest would be safe, and a policy that
    never sees a success learns nothing.
    """
    failures, successes = scores[~achieved], scores[achieved]
    # Only thresholds just above a failure are worth trying.
    candidates = [0.5, *np.nextafter(failures[failures >= 0.5], np.inf, dtype=np.float32).tolist()]
    allowed = [least for least in candidates if share_above(failures, least) <= FALSE_POSITIVES]
    best = max(allowed, key=lambda least: share_above(successes, least) - share_above(failures, least))
    return min(float(best), 1 - 1e-6)


def share_above(scores: np.ndarray, threshold: float) -> float:
    return float((scores > threshold).mean()) if len(scores) else 0.0


def auroc(scores: np.ndarray, labels: np.ndarray) -> float:
    """Chance that a success scores above a failure, ties counting half; NaN without both."""
    difference = scores[labels][:, None] - scores[~labels]
    if not difference.size:
        return float("nan")
    return float(((difference > 0) + 0.5 * (difference == 0)).mean())


def preview(video: Path, world: World, episodes: Sequence[Episode]) -> None:
    """Films recorded episodes in the first row, and their imagined replays in the second."""
    at = [WindowStart(e, 0) for e in range(min(PREVIEWED, len(episodes)))]
    windows = whole_windows(episodes, at, world)
    lines = []
    for frames in (windows.frames, replay(world.model, windows)):
        clips = frames.repeat_interleave(SCALE, 3).repeat_interleave(SCALE, 4)
        beside = torch.cat(list(clips.unbind(2)), dim=3)  # cameras beside each other
        lines.append([list(clip) for clip in beside.numpy()])
    write_video(video, lines, fps=FPS)


def checks_table(found: dict[str, Any]) -> Table:
    """Outcome of `check` for people."""
    title = f"{'passed' if found['passed'] else 'FAILED'} on {found['episodes']} episodes"
    table = Table("check", "above", "value", title=title)
    for name, outcome in found["checks"].items():
        value = f"{outcome['value']:.2f}{'' if outcome['holds'] else ' FAILS'}"
        table.add_row(name, f"{outcome['above']:g}", value)
    return table
