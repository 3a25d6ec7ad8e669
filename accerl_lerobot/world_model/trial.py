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
"""Open-loop trials of a world model on held-out episodes: what it dreams beside what happened.

Every trial begins at a real frame and dreams some chunks with the actions that were really made, and again
with actions that were not: another episode's, none, and the opposite. A model must be better than a copy of
the last frame where something moves, and worse with wrong actions; and its successes must be judged as the
real ones were.

Depths are counted in chunks, from 1. Shapes: M trials, D depths; see `episodes.py` for the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from accerl_lerobot.world_model import judge
from accerl_lerobot.world_model.config import TrialConfig
from accerl_lerobot.world_model.contract import WorldModel
from accerl_lerobot.world_model.episodes import Episode, Place, Windows, cut
from accerl_lerobot.world_model.success import as_floats
from accerl_lerobot.world_model.success_plugin.modeling_success_pairs import SuccessPairsRewardModel

BATCH = 64
"""Trials that are dreamt at once."""
ARMS = ("true", "shuffled", "zero", "opposite")
"""Which actions are dreamt with."""


def trial_windows(episodes: Sequence[Episode], model: WorldModel, config: TrialConfig, seed: int) -> Windows:
    """Every so many frames of each episode, at most so many; chunks beyond an episode's end are not valid."""
    at = [
        Place(e, f)
        for e, episode in enumerate(episodes)
        for f in range(0, len(episode.frames) - 1, config.every)
    ]
    rng = np.random.default_rng(seed)
    if len(at) > config.most:
        at = [at[i] for i in sorted(rng.choice(len(at), config.most, replace=False))]
    return cut(episodes, at, chunk=model.spec.chunk, context=model.spec.context, chunks=config.depth)


class Dreams(NamedTuple):
    """Of M trials."""

    frames: np.ndarray
    """uint8 (M, D, V, H, W, 3)."""
    robot: np.ndarray
    """float32 (M, D, S)."""
    uncertainty: np.ndarray
    """float32 (M, D)."""


def dream(model: WorldModel, windows: Windows, actions: np.ndarray) -> Dreams:
    """Dreams all windows with these actions (M, D, K, A)."""
    context = model.spec.context
    parts: list[list[np.ndarray]] = []
    for start in range(0, len(windows), BATCH):
        rows = slice(start, start + BATCH)
        frames = torch.from_numpy(windows.frames[rows, :context])
        state = model.begin(frames, torch.from_numpy(windows.state[rows, 0]), windows.task[rows])
        dreams = []
        for depth in range(actions.shape[1]):
            seeds = [start + i + 1_000_003 * depth for i in range(len(frames))]
            dreams.append(model.step(state, torch.from_numpy(actions[rows, depth]), seeds))
            state = dreams[-1].state
        parts.append([np.stack([getattr(d, k).cpu().numpy() for d in dreams], 1) for k in Dreams._fields])
    return Dreams(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def wrong_actions(windows: Windows, arm: str, rng: np.random.Generator) -> np.ndarray:
    """(M, D, K, A) of one of `ARMS`."""
    actions = windows.actions
    if arm == "shuffled":
        return actions[judge.shuffled(len(windows), windows.episode.tolist(), rng)]
    return {"true": actions, "zero": np.zeros_like(actions), "opposite": -actions}[arm]


def scores(success: SuccessPairsRewardModel, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """P(success) of each pair of frames (M, V, H, W, 3)."""
    device = success.out.weight.device
    parts = []
    with torch.no_grad():
        for i in range(0, len(before), BATCH):
            rows = slice(i, i + BATCH)
            said, _ = success.logits(as_floats(before[rows], device), as_floats(after[rows], device))
            parts.append(torch.sigmoid(said))
    return torch.cat(parts).cpu().numpy()


def try_out(
    model: WorldModel,
    episodes: Sequence[Episode],
    config: TrialConfig,
    success: SuccessPairsRewardModel | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """Tries a model on episodes it has not learnt from.

    Returns:
        ``depths``: a row per depth with `judge`'s estimates of skill and sensitivity, errors in pixels, state
        and, with a success model, AUROC on real and dreamt pairs and the share of dreams taken for a success
        under each arm's actions; ``gates``: each with its value and whether it holds; ``passed``; ``trials``.
    """
    windows = trial_windows(episodes, model, config, seed)
    rng = np.random.default_rng((seed, 1))
    arms = {arm: dream(model, windows, wrong_actions(windows, arm, rng)) for arm in ARMS}
    context = model.spec.context
    newest = windows.frames[:, context - 1]
    rows = []
    # Until something is not as it was: a chunk cut short by the end is not what was dreamt.
    whole = np.cumprod(windows.steps == model.spec.chunk, axis=1).astype(bool)
    for d in range(config.depth):
        fits, real = whole[:, d], windows.frames[:, context + d]
        row: dict[str, Any] = {"depth": d + 1, "trials": int(fits.sum())}
        if fits.sum() >= 2:
            row |= _pixels(arms, newest[fits], real[fits], fits, d)
            robots = arms["true"].robot[fits, d]
            if robots.shape[1]:
                there = windows.state[fits, d + 1]
                row["state_error"] = float(np.abs(robots - there).mean())
                row["state_error_copy"] = float(np.abs(windows.state[fits, 0] - there).mean())
            row["uncertainty"] = float(arms["true"].uncertainty[fits, d].mean())
        if success is not None:
            row |= _judged(success, arms, windows, newest, d)
        rows.append(row)
    gates = _gates(rows, config, success is not None)
    return {
        "trials": len(windows),
        "depths": rows,
        "gates": gates,
        "passed": all(gate["holds"] for gate in gates.values()),
    }


def _pixels(
    arms: dict[str, Dreams],
    newest: np.ndarray,
    real: np.ndarray,
    fits: np.ndarray,
    d: int,
) -> dict[str, Any]:
    moved = judge.changed(newest, real)
    errors = {arm: judge.squared_errors(dreams.frames[fits, d], real) for arm, dreams in arms.items()}
    copy = judge.squared_errors(newest, real)
    where_moved = judge.squared_errors(arms["true"].frames[fits, d], real, moved)
    return {
        "mse": judge.mean_error(errors["true"]),
        "mse_copy": judge.mean_error(copy),
        "psnr": float(10 * np.log10(255**2 / max(judge.mean_error(errors["true"]), 1e-9))),
        "skill": judge.skill(errors["true"], copy)._asdict(),
        "skill_changed": judge.skill(where_moved, judge.squared_errors(newest, real, moved))._asdict(),
        **{
            f"sensitivity_{arm}": judge.sensitivity(errors["true"], errors[arm])._asdict() for arm in ARMS[1:]
        },
    }


def _judged(
    success: SuccessPairsRewardModel,
    arms: dict[str, Dreams],
    windows: Windows,
    newest: np.ndarray,
    d: int,
) -> dict[str, Any]:
    """What the success model makes of the chunk at this depth, real and dreamt."""
    # Chunks that were really made, until the task was achieved or the episode ended.
    made = windows.valid[:, d] | windows.success[:, d]
    labels = windows.success[made, d]
    context = windows.frames.shape[1] - windows.steps.shape[1]
    real = scores(success, windows.frames[made, context + d - 1], windows.frames[made, context + d])
    found: dict[str, Any] = {
        "successes": int(labels.sum()),
        "failures": int((~labels).sum()),
        "auroc_real": judge.auroc(real, labels),
    }
    for arm, dreams in arms.items():
        before = newest if d == 0 else dreams.frames[:, d - 1]
        said = scores(success, before[made], dreams.frames[made, d])
        if arm == "true":
            found["auroc_dreamt"] = judge.auroc(said, labels)
        wrong = ~labels if arm == "true" else np.ones(len(labels), bool)
        found[f"false_success_{arm}"] = float((said[wrong] > 0.5).mean()) if wrong.any() else float("nan")
    return found


def _gates(rows: list[dict[str, Any]], config: TrialConfig, judged: bool) -> dict[str, dict[str, Any]]:
    first, last = rows[0], rows[-1]

    def at(row: dict[str, Any], key: str, part: str = "value") -> float:
        return float(row[key][part]) if key in row else float("nan")

    wanted = {
        "skill_changed_first": (at(first, "skill_changed"), config.skill_first),
        "skill_changed_last": (at(last, "skill_changed"), config.skill_last),
        "sensitivity_low": (at(first, "sensitivity_shuffled", "low"), config.sensitivity),
    }
    if judged:
        wanted["auroc_last"] = (float(last["auroc_dreamt"]), config.auroc)
    # A number that could not be had passes nothing.
    return {
        name: {"value": value, "above": least, "holds": bool(value > least)}
        for name, (value, least) in wanted.items()
    }
