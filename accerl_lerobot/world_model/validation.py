# SPDX-License-Identifier: Apache-2.0
"""Validation of a world model on held-out episodes.

From each window some chunks are predicted with the executed actions, and with another episode's. A model
must be better than a copy of the last frame where something moves, and worse with wrong actions; and whole
imagined rollouts must end as the real episodes did, see `rollout_eval.py`.

Predictions are of whole chunks. Where an episode ended within one, its last action is held.

Depths are counted in chunks, from 1. Shapes: M windows, D depths; see `data.py` for the others.

Held-out evaluation of a world model on one or two datasets; ``accerl world-model-eval``.

held out    episodes of the dataset it was trained on that were held out; or dataset: all of another one
online      a policy's episodes, as ``accerl export`` writes them; of those, too, the held-out ones

<output_dir>/
  validation.json            results on the first; under ``datasets`` on the other
  preview.mp4                real, predicted, and predicted with another episode's actions
  preview_<dataset>.mp4      the same of the other
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from accerl_lerobot.console import Console
from accerl_lerobot.demos.dataset_files import open_metadata
from accerl_lerobot.errors import InputError
from accerl_lerobot.evaluation import write_video
from accerl_lerobot.policies.loading import resolve_device
from accerl_lerobot.world_model import metrics
from accerl_lerobot.world_model.config import ValidationConfig
from accerl_lerobot.world_model.contract import LearnableWorldModel, WorldModel
from accerl_lerobot.world_model.data import (
    Episode,
    Windows,
    WindowStart,
    check_metadata,
    count_episodes,
    cut_windows,
    fingerprint,
    hold_last_action,
    load_episodes,
)
from accerl_lerobot.world_model.rollout_eval import (
    choose_threshold,
    outcome_metrics,
    predict,
    score_episodes,
    spaced_frames,
    subsample,
)
from accerl_lerobot.world_model.store import (
    Source,
    find_source,
    load_sources,
    load_world_model,
    rehearse_world_model,
)
from accerl_lerobot.world_model.success_plugin.modeling_success_pairs import SuccessPairsRewardModel

if TYPE_CHECKING:
    from accerl_lerobot.cli.verbs import WorldModelEvalRun, WorldModelRun
    from accerl_lerobot.config.ranges import DatasetConfig
    from accerl_lerobot.world_model.contract import WorldModelSpec


PREVIEW_ROWS = 4
SCALE = 3
"""Enlargement of videos."""
FPS = 4
"""Chunks per second of video."""


def validation_windows(
    episodes: Sequence[Episode], model: WorldModel, config: ValidationConfig, seed: int
) -> Windows:
    """Windows of D chunks every `stride` env steps; chunks beyond an episode's end are not valid, but filled
    up with its last action."""
    starts = [
        WindowStart(e, f)
        for e, episode in enumerate(episodes)
        for f in spaced_frames(episode.times, config.stride)
    ]
    at = subsample(episodes, starts, config.max_windows, np.random.default_rng(seed))
    spec = model.spec
    windows = cut_windows(episodes, at, chunk=spec.chunk, context=spec.context, chunks=config.depth)
    return replace(windows, actions=hold_last_action(windows.actions, windows.steps))


def shuffled_actions(windows: Windows, rng: np.random.Generator) -> np.ndarray:
    """(M, D, K, A), the actions of windows of other episodes."""
    return windows.actions[metrics.shuffle_across_groups(len(windows), windows.episode.tolist(), rng)]


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
    success: SuccessPairsRewardModel | None = None,
    seed: int = 0,
    fresh: bool = False,
) -> dict[str, Any]:
    """Validates a model on episodes that it was not trained on.

    Without a success model, outcomes are not checked. If it is `fresh`, its threshold is chosen on these
    episodes.

    Returns:
        ``depths``: a row per depth with estimates of skill and sensitivity, and errors of pixels and state;
        with a success model its ``threshold``, and ``outcomes``, see `outcome_metrics`; ``checks``: each with
        its value and whether it holds; ``passed``; numbers of ``windows`` and ``episodes``.
    """
    rng = np.random.default_rng((seed, 1))
    ended: dict[str, Any] = {}
    if success is not None:
        scores = score_episodes(model, success, episodes, config, seed)
        own = np.array([episodes[e].source == "online" for e in scores.episode])
        if fresh:
            success.config.threshold = choose_threshold(scores, own, config) or 0.5
        threshold = success.config.threshold
        ended["outcomes"] = outcome_metrics(scores, own, config, None if fresh else threshold)
        ended["threshold"] = threshold
    windows = validation_windows(episodes, model, config, seed)
    predicted = predict(model, windows, windows.actions)
    shuffled = predict(model, windows, shuffled_actions(windows, rng)).frames
    context = model.spec.context
    newest = windows.frames[:, context - 1]
    rows = []
    # A chunk cut short by the episode's end is not the one that was predicted, nor are those after it.
    whole = np.cumprod(windows.steps == model.spec.chunk, axis=1).astype(bool)
    for d in range(config.depth):
        fits = whole[:, d]
        row: dict[str, Any] = {"depth": d + 1, "windows": int(fits.sum())}
        if fits.sum() >= 2:
            frames = predicted.frames[fits, d], shuffled[fits, d]
            real = windows.frames[fits, context + d]
            row |= _frame_metrics(*frames, newest[fits], real, windows.episode[fits])
            robots = predicted.robot[fits, d]
            if robots.shape[1]:
                state = windows.state[fits, context + d]
                row["state_error"] = float(np.abs(robots - state).mean())
                row["state_error_copy"] = float(np.abs(windows.state[fits, context - 1] - state).mean())
            row["uncertainty"] = float(predicted.uncertainty[fits, d].mean())
        rows.append(row)
    checks = _checks(rows, config, ended.get("outcomes"))
    return ended | {
        "windows": len(windows),
        "episodes": len(np.unique(windows.episode)),
        "depths": rows,
        "checks": checks,
        "passed": all(check["holds"] for check in checks.values()),
    }


def _frame_metrics(
    predicted: np.ndarray, shuffled: np.ndarray, newest: np.ndarray, real: np.ndarray, episode: np.ndarray
) -> dict[str, Any]:
    """Metrics of frames (M, V, H, W, 3) predicted with the executed actions and with another episode's."""
    moved = metrics.changed(newest, real)
    error, copy = (metrics.squared_errors(frames, real) for frames in (predicted, newest))
    error_moved, copy_moved = (metrics.squared_errors(frames, real, moved) for frames in (predicted, newest))
    mse = metrics.mean_error(error)
    return {
        "mse": mse,
        "mse_copy": metrics.mean_error(copy),
        "psnr": float(10 * np.log10(255**2 / max(mse, 1e-9))),
        "skill": metrics.skill(error, copy, episode)._asdict(),
        "skill_changed": metrics.skill(error_moved, copy_moved, episode)._asdict(),
        "sensitivity_shuffled": metrics.sensitivity(
            error, metrics.squared_errors(shuffled, real), episode
        )._asdict(),
    }


def _checks(
    rows: list[dict[str, Any]], config: ValidationConfig, outcomes: dict[str, Any] | None
) -> dict[str, dict[str, Any]]:
    first, last = rows[0], rows[-1]

    def at(row: dict[str, Any], key: str, part: str = "value") -> float:
        return float(row[key][part]) if key in row else float("nan")

    bounds = {
        "skill_changed_first": (at(first, "skill_changed"), "above", config.skill_first),
        "skill_changed_last": (at(last, "skill_changed"), "above", config.skill_last),
        "skill_last": (at(last, "skill"), "above", config.skill_last),
        "sensitivity_low": (at(first, "sensitivity_shuffled", "low"), "above", config.sensitivity),
    }
    if outcomes is not None:
        bounds["auroc"] = (float(outcomes["auroc"]["low"]), "above", config.auroc)
        for name in ("false_success", "false_success_idle"):
            bounds[name] = (outcomes[name], "at most", config.false_success)
        bounds["recall"] = (outcomes["recall"], "above", config.recall)
    # NaN passes nothing.
    return {
        name: {
            "value": value,
            "wanted": f"{how} {bound}",
            "holds": bool(value > bound if how == "above" else value <= bound),
        }
        for name, (value, how, bound) in bounds.items()
    }


def preview_video(
    path: Path, model: WorldModel, episodes: Sequence[Episode], config: ValidationConfig, seed: int
) -> None:
    """Real frames, predicted ones, and those predicted with another episode's actions, one row each."""
    windows = validation_windows(episodes, model, config, seed)
    rng = np.random.default_rng((seed, 3))
    rows = sorted(rng.choice(len(windows), min(PREVIEW_ROWS, len(windows)), replace=False).tolist())
    chosen, context = windows.rows(rows), model.spec.context
    lines = [chosen.frames[:, context - 1 :]]
    for actions in (windows.actions, shuffled_actions(windows, rng)):
        frames = predict(model, chosen, actions[rows]).frames
        lines.append(np.concatenate([chosen.frames[:, context - 1 : context], frames], 1))
    write_video(path, [[list(_enlarge(clip)) for clip in line] for line in lines], fps=FPS)


def _enlarge(frames: np.ndarray) -> np.ndarray:
    """(D, V, H, W, 3) as (D, SCALE·H, V·SCALE·W, 3): cameras beside each other."""
    cameras = np.concatenate(list(frames.transpose(1, 0, 2, 3, 4)), axis=2)
    return cameras.repeat(SCALE, 1).repeat(SCALE, 2)


HELD_OUT, DATASET, ONLINE = "held out", "dataset", "online"
"""Names of datasets in the results."""
PREVIEW, RESULT = "preview.mp4", "validation.json"


def validate_datasets(
    model: LearnableWorldModel,
    datasets: dict[str, list[Episode]],
    config: ValidationConfig,
    success: SuccessPairsRewardModel | None,
    directory: Path,
    *,
    trained_on: Collection[str] = (),
    fresh: str | None = None,
    keep_threshold: bool = False,
    seed: int = 0,
) -> dict[str, Any]:
    """Validates a world model on each dataset and makes a video of it.

    Args:
        model: in eval mode.
        datasets: name → episodes that it was not trained on.
        config: data and checks.
        success: see `validate`.
        directory: receives the videos.
        trained_on: datasets of which the model was trained on other episodes. Their checks count, too.
        fresh: the dataset on which the success threshold is chosen: of each fold, on the others. All other
            datasets are judged by the present threshold.
        keep_threshold: keep the threshold that is chosen on all of `fresh`, for the other datasets too.
        seed: see `validate`.

    Returns:
        Results of `validate` on the first, with its ``name`` and how many episodes were ``tried``; and
        ``datasets``: name → the same of the others. Checks of others that count are among the first's, as
        ``<dataset>.<check>``, and ``passed`` is True if all hold.
    """
    first, *others = datasets
    results: dict[str, dict[str, Any]] = {}
    for name in sorted(datasets, key=lambda name: name != fresh):
        episodes = datasets[name]
        threshold = None if success is None else success.config.threshold
        result = validate(model, episodes, config, success, seed, name == fresh)
        results[name] = {"name": name} | result | {"tried": count_episodes(episodes)}
        video = directory / (PREVIEW if name == first else f"preview_{name}.mp4")
        preview_video(video, model, episodes, config, seed)
        if success is not None and threshold is not None and not keep_threshold:
            success.config.threshold = threshold
    checks = dict(results[first]["checks"])
    for name in others:
        if name in trained_on:
            checks |= {f"{name}.{check}": held for check, held in results[name]["checks"].items()}
    passed = all(check["holds"] for check in checks.values())
    rest = {name: results[name] for name in others}
    return results[first] | {"checks": checks, "passed": passed, "datasets": rest}


class _Part(NamedTuple):
    """A dataset's part in an evaluation."""

    source: Source | None
    """The record of it in the world model; None: it was not trained on it."""
    episodes: list[int]
    """Indices of those to evaluate on."""


def evaluate(config: WorldModelEvalRun, directory: Path, console: Console) -> dict[str, Any]:
    """Evaluates a saved world model; `directory` exists and is empty.

    Returns:
        See `validate_datasets`; also in ``validation.json``.

    Raises:
        InputError: no such device, no world model there, a dataset of another kind, or nothing was held out.
    """
    device = resolve_device(config.device, "device")
    path = Path(str(config.path)).expanduser()
    rehearse_world_model(path, config.discover_packages_path)
    model, success = load_world_model(path, config.discover_packages_path)
    model = model.to(device)
    if success is not None:
        success = success.to(device)
    spec, sources = model.spec, load_sources(path)
    parts: dict[str, _Part] = {}
    for section, meta in open_datasets(dataset_sections(config), spec).items():
        with name_section(section):
            parts[section] = _part(meta, sources)
    for section, part in parts.items():
        if part.source is not None:
            console.say(
                f"trained on {getattr(config, section).repo_id} ({section}): evaluated on its "
                f"{len(part.episodes)} held-out episodes"
            )
    names = {DATASET: DATASET if parts[DATASET].source is None else HELD_OUT, ONLINE: ONLINE}
    datasets: dict[str, list[Episode]] = {}
    with console.stage("episodes"):
        datasets[names[DATASET]] = load_episodes(
            config.dataset, spec, both=success is not None, only=parts[DATASET].episodes
        )
        if ONLINE in parts:
            with name_section(ONLINE):
                datasets[ONLINE] = load_episodes(
                    config.online, spec, ONLINE, both=False, only=parts[ONLINE].episodes
                )
    # The threshold was chosen on what was held out of the last source: there, it is chosen in folds.
    fresh = next((names[r] for r, part in parts.items() if sources[-1:] == (part.source,)), None)
    trained_on = [names[section] for section, part in parts.items() if part.source is not None]
    with console.stage("validation"):
        result = validate_datasets(
            model,
            datasets,
            config.validation,
            success,
            directory,
            trained_on=trained_on,
            fresh=fresh,
            seed=config.seed,
        )
    (directory / RESULT).write_text(json.dumps(result, indent=2) + "\n")
    return result


def _part(meta: Any, sources: Sequence[Source]) -> _Part:
    """The held-out episodes of a dataset that the model was trained on; of another one all."""
    source = find_source(sources, fingerprint(meta))
    if source is None:
        return _Part(None, list(range(meta.total_episodes)))
    if not source.held_out:
        remedy = "the world model was trained on every episode of it; give another dataset"
        raise InputError("dataset.repo_id", meta.repo_id, remedy)
    return _Part(source, list(source.held_out))


def dataset_sections(run: WorldModelRun | WorldModelEvalRun) -> dict[str, DatasetConfig]:
    """``dataset``, and ``online`` if it is named."""
    return {DATASET: run.dataset} | ({} if run.online.repo_id is None else {ONLINE: run.online})


def open_datasets(sections: dict[str, DatasetConfig], spec: WorldModelSpec) -> dict[str, Any]:
    """Opens the metadata of each dataset, by its config section, before any image is read.

    Raises:
        InputError: see `open_metadata` and `check_metadata`; or one is named twice.
    """
    opened: dict[str, Any] = {}
    prints: dict[str, str] = {}
    for section, dataset in sections.items():
        with name_section(section):
            meta = opened[section] = open_metadata(dataset)
            check_metadata(meta, str(dataset.repo_id), spec)
            same = prints.setdefault(fingerprint(meta), section)
            if same != section:
                raise InputError("dataset.repo_id", dataset.repo_id, f"it is the one in {same}; name another")
    return opened


def check_disjoint(dataset: DatasetConfig, episodes: Sequence[Episode], others: Sequence[Episode]) -> None:
    """Refuses a dataset that shares episodes with another, where they may be on the other side of a split.

    Raises:
        InputError: some are shared.
    """
    known = {episode.actions.tobytes() for episode in others}
    if twice := sum(episode.actions.tobytes() in known for episode in episodes):
        remedy = f"{twice} of its episodes are in the other dataset, too; name one that has only others"
        raise InputError("dataset.repo_id", dataset.repo_id, remedy)


@contextmanager
def name_section(section: str) -> Iterator[None]:
    """Puts the config section of a dataset into errors about it."""
    try:
        yield
    except InputError as error:
        field = error.field.replace("dataset.", f"{section}.", 1)
        raise InputError(field, error.value, error.remedy) from error
