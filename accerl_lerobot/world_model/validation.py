# SPDX-License-Identifier: Apache-2.0
"""Validation of a world model on held-out episodes; ``accerl world-model-eval``.

    skill          1 − MSE(model) / MSE(copy of the last frame), on all pixels or on those that changed
    sensitivity    MSE(with another episode's actions) / MSE(with the executed ones); 1 if they are ignored

Better pixels than a copy prove nothing: a model may learn to blur what moves and ignore the actions. And
whole imagined rollouts must end as the real episodes did, see `rollout_eval.py`.

Predictions are of whole chunks: where an episode ended within one, its last action is held. Depths are
counted in chunks, from 1. Shapes: M windows, D depths; see `data.py` for the others.

<output_dir>/
  validation.json    results
  preview.mp4        real, predicted, and predicted with another episode's actions; of a policy's episodes
                     preview_online.mp4
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from accerl_lerobot.console import Console
from accerl_lerobot.errors import InputError, expanded
from accerl_lerobot.evaluation import write_video
from accerl_lerobot.policies.loading import resolve_device
from accerl_lerobot.world_model import data, store
from accerl_lerobot.world_model.config import ValidationConfig
from accerl_lerobot.world_model.contract import LearnableWorldModel, Windows, WorldModel
from accerl_lerobot.world_model.data import DATASET, ONLINE, Episode, WindowStart
from accerl_lerobot.world_model.rollout_eval import (
    auroc,
    bootstrap,
    choose_threshold,
    predict,
    score_episodes,
    subsample,
)
from accerl_lerobot.world_model.success_model import SuccessPairsRewardModel

if TYPE_CHECKING:
    from accerl_lerobot.cli.configs import WorldModelEvalRun

CHANGED = 16  # a pixel counts as changed if one of its colours differs by more, of 255
PREVIEW_ROWS, SCALE, FPS = 4, 3, 4  # windows in a video, its enlargement, and its chunks per second


def validation_windows(
    episodes: Sequence[Episode], model: WorldModel, config: ValidationConfig, seed: int
) -> Windows:
    """Windows of D chunks every `stride` env steps; chunks beyond an episode's end are not valid, but filled
    up with its last action."""
    starts = []
    for e, episode in enumerate(episodes):
        due = 0
        for f, time in enumerate(episode.times[:-1].tolist()):
            if time >= due:
                starts.append(WindowStart(e, f))
                due = time + config.stride
    at = subsample(episodes, starts, config.max_windows, np.random.default_rng(seed))
    windows = data.cut_windows(episodes, at, model.spec, config.depth)
    return replace(windows, actions=data.hold_last_action(windows.actions, windows.steps))


def squared_errors(frames: np.ndarray, target: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    """(M, 2) sums of squared errors and of pixels, of uint8 frames (M, V, H, W, 3), where `mask` holds."""
    errors = np.square(frames.astype(np.float64) - target).mean(-1)
    counted = np.ones(errors.shape) if mask is None else mask.astype(np.float64)
    sums: np.ndarray = np.stack([(errors * counted).sum((1, 2, 3)), counted.sum((1, 2, 3))], 1)
    return sums


def mean_error(sums: np.ndarray) -> float:
    """Mean squared error of `squared_errors` rows; NaN without a pixel."""
    total, count = sums.sum(0)
    return float(total / count) if count else float("nan")


def skill(model: np.ndarray, copy: np.ndarray, groups: np.ndarray) -> dict[str, float]:
    """1 − MSE(model)/MSE(copy), from `squared_errors` of both (M, 2)."""

    def of(rows: np.ndarray) -> float:
        copied = mean_error(copy[rows])
        return 1 - mean_error(model[rows]) / copied if copied > 0 else float("nan")

    return bootstrap(groups, of)


def sensitivity(true: np.ndarray, other: np.ndarray, groups: np.ndarray) -> dict[str, float]:
    """MSE(other actions)/MSE(true actions), from `squared_errors` of both (M, 2); of two exact ones 1."""

    def of(rows: np.ndarray) -> float:
        right, wrong = mean_error(true[rows]), mean_error(other[rows])
        if right > 0:
            return wrong / right
        return float("inf") if wrong > 0 else 1.0

    return bootstrap(groups, of)


def fit_uncertainty_scale(
    model: LearnableWorldModel, episodes: Sequence[Episode], config: ValidationConfig, seed: int
) -> None:
    """Scales the uncertainty so that 1 is the 95th percentile after one whole chunk of these episodes."""
    windows = validation_windows(episodes, model, config, seed + 1)
    uncertainty = predict(model, windows, windows.actions[:, :1]).uncertainty[:, 0]
    uncertainty = uncertainty[windows.steps[:, 0] == model.spec.chunk]
    usual = float(np.quantile(uncertainty, 0.95)) if len(uncertainty) else math.nan
    if math.isfinite(usual):  # a model without a state has no uncertainty
        model.uncertainty_scale.mul_(max(usual, 1e-6))


def validate(
    model: WorldModel,
    episodes: Sequence[Episode],
    config: ValidationConfig,
    success: SuccessPairsRewardModel,
    seed: int = 0,
) -> dict[str, Any]:
    """Validates a model on episodes that it was not trained on.

    Returns:
        ``depths``: a row per depth with estimates of skill and sensitivity, and errors of the state;
        ``threshold`` of the success model, chosen on these episodes; ``checks``: each with its value and
        whether it holds; numbers of ``episodes`` and ``env_steps``.
    """
    rng = np.random.default_rng((seed, 1))
    scores = score_episodes(model, success, episodes, config, seed)
    windows = validation_windows(episodes, model, config, seed)
    predicted = predict(model, windows, windows.actions)
    shuffled = predict(model, windows, data.shuffle_actions(windows, rng).actions).frames
    now = model.spec.context - 1
    rows = []
    # A chunk cut short by the episode's end is not the one that was predicted, nor are those after it.
    whole = np.cumprod(windows.steps == model.spec.chunk, axis=1).astype(bool)
    for depth, fits in enumerate(whole.T, start=1):
        row: dict[str, Any] = {"depth": depth, "windows": int(fits.sum())}
        if fits.sum() >= 2:
            newest, real = windows.frames[fits, now], windows.frames[fits, now + depth]
            made, groups = predicted.frames[fits, depth], windows.episode[fits]
            moved = np.abs(newest.astype(np.int16) - real).max(-1) > CHANGED
            error = partial(squared_errors, target=real)
            row["skill"] = skill(error(made), error(newest), groups)
            row["skill_changed"] = skill(error(made, mask=moved), error(newest, mask=moved), groups)
            row["sensitivity"] = sensitivity(error(made), error(shuffled[fits, depth]), groups)
            if model.spec.state_dim:
                state = windows.state[fits, now + depth]
                row["state_error"] = float(np.abs(predicted.robot[fits, depth - 1] - state).mean())
        rows.append(row)
    nothing = {"value": math.nan, "low": math.nan}
    outcomes = bootstrap(scores.episode, lambda of: auroc(scores.imagined[of], scores.achieved[of]))
    values = {
        "skill": (rows[0].get("skill_changed", nothing)["value"], config.skill),
        "sensitivity": (rows[0].get("sensitivity", nothing)["low"], config.sensitivity),
        "auroc": (outcomes["low"], config.auroc),
    }
    checks = {
        name: {"value": value, "above": bound, "holds": bool(value > bound)}  # NaN passes nothing
        for name, (value, bound) in values.items()
    }
    return data.count_episodes(episodes) | {
        "depths": rows,
        "threshold": choose_threshold(scores, config) or 0.5,
        "checks": checks,
        "passed": all(check["holds"] for check in checks.values()),
    }


def preview_videos(
    folder: Path, model: WorldModel, datasets: dict[str, list[Episode]], config: ValidationConfig, seed: int
) -> None:
    """Real frames, predicted ones, and those predicted with another episode's actions, one row each."""
    for name, episodes in datasets.items():
        rng = np.random.default_rng((seed, 3))
        windows = validation_windows(episodes, model, replace(config, max_windows=PREVIEW_ROWS), seed)
        lines = [windows.frames[:, windows.context - 1 :]]
        for of in (windows, data.shuffle_actions(windows, rng)):
            lines.append(predict(model, windows, of.actions).frames)
        video = folder / ("preview.mp4" if name == DATASET else f"preview_{name}.mp4")
        write_video(video, [[list(_enlarge(clip)) for clip in line] for line in lines], fps=FPS)


def _enlarge(frames: np.ndarray) -> np.ndarray:
    """(D, V, H, W, 3) as (D, SCALE·H, V·SCALE·W, 3): cameras beside each other."""
    cameras = np.concatenate(list(frames.transpose(1, 0, 2, 3, 4)), axis=2)
    return cameras.repeat(SCALE, 1).repeat(SCALE, 2)


def validate_datasets(
    model: LearnableWorldModel,
    datasets: dict[str, list[Episode]],
    config: ValidationConfig,
    success: SuccessPairsRewardModel,
    seed: int = 0,
) -> dict[str, Any]:
    """Validates a world model on each dataset, by its name.

    Returns:
        ``datasets``: name → what `validate` returns; ``checks``: those of the first, and of the others as
        ``<dataset>.<check>``; ``passed``: True if all hold.
    """
    results = {name: validate(model, of, config, success, seed) for name, of in datasets.items()}
    checks = {
        check if name == DATASET else f"{name}.{check}": outcome
        for name, result in results.items()
        for check, outcome in result["checks"].items()
    }
    passed = all(check["holds"] for check in checks.values())
    return {"passed": passed, "checks": checks, "datasets": results}


def checks_table(found: dict[str, Any]) -> Table:
    """Results of `validate_datasets`: a row per check, a column per dataset."""
    table = Table("check", "above", *found["datasets"], title="passed" if found["passed"] else "FAILED")
    results = list(found["datasets"].values())
    table.add_row("episodes", "", *(str(one["episodes"]) for one in results))
    for name, check in results[0]["checks"].items():
        held = [one["checks"][name] for one in results]
        cells = (f"{one['value']:.2f}{'' if one['holds'] else ' FAILS'}" for one in held)
        table.add_row(name, f"{check['above']:g}", *cells)
    return table


def evaluate(config: WorldModelEvalRun, directory: Path, console: Console) -> dict[str, Any]:
    """Evaluates a saved world model on episodes that it was not trained on, see `validate_datasets`."""
    device = resolve_device(config.device, "device")
    path = expanded(str(config.path), "path")
    model, success = store.load_world_model(path, config.discover_packages_path)
    store.check_predicts(path, model, success)
    roles = store.load_roles(path)
    with console.stage("episodes"):
        named = {DATASET: config.dataset, ONLINE: config.online}
        datasets = data.load_datasets(named, model.spec)
    for name, episodes in datasets.items():
        kept = [episode for episode in episodes if roles.get(episode.key) != store.LEARNT]
        if not kept:
            hint = "the world model was trained on every episode of it; give another dataset"
            raise InputError(f"{name}.repo_id", named[name].repo_id, hint)
        if trained_on := len(episodes) - len(kept):
            console.say(f"{name}: trained on {trained_on} episodes of it, evaluated on the other {len(kept)}")
        datasets[name] = kept
    with console.stage("validation"):
        preview_videos(directory, model.to(device), datasets, config.validation, config.seed)
        return validate_datasets(model, datasets, config.validation, success.to(device), config.seed)
