# SPDX-License-Identifier: Apache-2.0
"""Training of a pixel world model before a run, and its check.

``accerl world-model`` trains on a LeRobotDataset, and `run.play` on what a run has recorded for it.

<output_dir>/
  world_model/       see `imagined.py`
  metrics.jsonl      training losses
  validation.json    the check
  preview.mp4        held-out episodes, recorded above imagined

The check is three numbers, on episodes that the model was not trained on:

    skill          1 − MSE / MSE of a copy of the last frame, after one chunk, where pixels changed
    sensitivity    MSE with another episode's actions / MSE with the executed ones, after one chunk
    auroc          of the highest P(success) in an imagined replay of an episode, and its real outcome

Better pixels than a copy prove nothing: a model may learn to blur what moves and ignore the actions. And
whole imagined episodes must end as the real ones did, as an imagined episode ends with its first success.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from accerl_lerobot.checkpoint.layout import write_atomically
from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.console import Console
from accerl_lerobot.envs import EnvConfig, make_environment
from accerl_lerobot.errors import InputError, expanded
from accerl_lerobot.evaluation import write_video
from accerl_lerobot.metrics import plain
from accerl_lerobot.policies.loading import resolve_device
from accerl_lerobot.world_model.config import WorldModelConfig
from accerl_lerobot.world_model.contract import (
    Episode,
    Windows,
    WindowStart,
    WorldModelSpec,
    cut_windows,
    load_episodes,
    new_model,
    replay,
    split_episodes,
)  # fmt: skip
from accerl_lerobot.world_model.imagined import World, load_world, read_content, save_world
from accerl_lerobot.world_model.training import Trainer, uniform, whole_windows

if TYPE_CHECKING:
    from accerl_lerobot.cli.configs import WorldModelEvalRun

LOG_EVERY = 20  # steps between two lines of training losses
VALIDATION = "validation.json"
BOUNDS = {"skill": 0.3, "sensitivity": 1.2, "auroc": 0.9}  # numbers that a world model must exceed
MOST_WINDOWS = 400
MOST_REPLAYS = 200
CHANGED = 16  # a pixel counts as changed if one of its colours differs by more, of 255
FALSE_POSITIVES = 0.1  # largest share of failures that may pass for successes
PREVIEWED = 4  # episodes in the video
SCALE = 3  # enlargement of the video
FPS = 4  # chunks per second of the video


def pretrain(
    config: WorldModelConfig,
    env: EnvConfig,
    dataset: DatasetConfig,
    directory: Path,
    console: Console,
    *,
    seed: int,
    device: str,
) -> dict[str, Any]:
    """Trains, checks and saves a world model; `directory` exists.

    Returns:
        What `check` returns, with ``seconds`` of the training and the number of ``learnt`` episodes.
    """
    torch_device = resolve_device(device, "device")
    with closing(make_environment(env)) as environment:
        sizes = environment.spec
    spec = WorldModelSpec(
        cameras=tuple(sizes.images), image_size=(config.image_size, config.image_size),
        state_dim=sizes.state_dim, action_dim=sizes.action_dim, chunk=config.chunk,
        context=config.model.context, fps=sizes.fps, labelled_fps=sizes.labelled_fps,
    )  # fmt: skip
    with console.stage("episodes"):
        episodes = load_episodes(dataset, spec)
    learnt, held_out = split_episodes(episodes, np.random.default_rng((seed, 0)))
    for part in (learnt, held_out):
        if {episode.success for episode in part} != {True, False}:
            hint = "it needs at least two successes and two failures, to hold out one of each; record more"
            raise InputError("dataset.repo_id", dataset.repo_id, hint)
    spec = replace(spec, tasks=tuple(sorted({episode.task for episode in episodes})))
    started = time.monotonic()
    torch.manual_seed(seed)
    # The networks are initialised on the CPU, so alike on every device.
    world = World(new_model(spec, config.model)).to(torch_device)
    trainer = Trainer(world, config.lr, seed, config.steps)
    weights = uniform(learnt)
    trainer.fit_statistics(learnt)
    with (
        console.stage("world model", total=config.steps) as stage,
        (directory / "metrics.jsonl").open("w") as log,
    ):
        for step in range(1, config.steps + 1):
            metrics = trainer.step(learnt, weights)
            stage.update(step, " ".join(f"{name} {value:.3f}" for name, value in metrics.items()))
            if step % LOG_EVERY == 0:
                log.write(json.dumps({"step": step} | metrics) + "\n")
    world = trainer.serving
    more = {"learnt": len(learnt), "seconds": time.monotonic() - started}
    found = _validate(world, held_out, seed, directory, console, more)
    world.success.threshold.fill_(found["threshold"])
    failed = [name for name, outcome in found["checks"].items() if not outcome["holds"]]
    save_world(directory / "world_model", world, [episode.key for episode in learnt], failed)
    return found


def evaluate(run: WorldModelEvalRun, directory: Path, console: Console) -> dict[str, Any]:
    """Checks a saved world model on episodes that it was not trained on."""
    device = resolve_device(run.device, "device")
    path = expanded(str(run.path), "path")
    world = load_world(path, run.discover_packages_path).to(device)
    learnt = read_content(path).get("learnt") or ()
    with console.stage("episodes"):
        episodes = load_episodes(run.dataset, world.model.spec)
    kept = [episode for episode in episodes if episode.key not in learnt]
    if not kept:
        hint = "the world model was trained on every episode of it; give another dataset"
        raise InputError("dataset.repo_id", run.dataset.repo_id, hint)
    return _validate(world, kept, run.seed, directory, console, {})


def _validate(
    world: World,
    episodes: Sequence[Episode],
    seed: int,
    directory: Path,
    console: Console,
    more: dict[str, Any],
) -> dict[str, Any]:
    """Check a world, and write the outcome, with `more` numbers, and the video."""
    with console.stage("check"):
        found = check(world, episodes, seed) | more
        preview(directory / "preview.mp4", world, episodes)
    write_atomically(directory / VALIDATION, json.dumps(plain(found), indent=2) + "\n")
    return found


def show(found: dict[str, Any], directory: Path, console: Console) -> None:
    """Show people the outcome of a check."""
    for name, outcome in found["checks"].items():
        line = f"{name} {outcome['value']:.2f}, to be above {outcome['above']:g}"
        if not outcome["holds"]:
            line += ", FAILED"
        console.say(line)
    verdict = "passed" if found["passed"] else "FAILED"
    console.say(f"{verdict} on {found['episodes']} episodes; see {directory / 'preview.mp4'}")


def check(world: World, episodes: Sequence[Episode], seed: int = 0) -> dict[str, Any]:
    """Checks a world.

    Returns:
        ``checks``: value, bound and outcome of each of the three numbers; ``passed``; ``threshold`` of the
        success model, chosen on these episodes; numbers of ``episodes`` and ``env_steps``.
    """
    rng = np.random.default_rng((seed, 1))
    chunk = world.model.spec.chunk
    at = []
    for e, episode in enumerate(episodes):
        followed = np.flatnonzero(episode.times + chunk <= episode.times[-1])
        at += [WindowStart(e, int(frame)) for frame in followed]
    chosen = rng.permutation(len(at))[:MOST_WINDOWS]
    values = {"skill": np.nan, "sensitivity": np.nan}
    if len(chosen):
        windows = cut_windows(episodes, [at[i] for i in chosen], world.model.spec, 1)
        values = skill_and_sensitivity(world, windows)
    replayed = sorted(rng.permutation(len(episodes))[:MOST_REPLAYS])  # of a merged dataset not its first part
    scores, achieved = replay_scores(world, [episodes[i] for i in replayed])
    values["auroc"] = auroc(scores, achieved)
    checks = {}
    for name, value in values.items():
        bound = BOUNDS[name]
        checks[name] = {"value": value, "above": bound, "holds": value > bound}  # NaN passes nothing
    return {
        "passed": all(outcome["holds"] for outcome in checks.values()),
        "checks": checks,
        "threshold": choose_threshold(scores, achieved),
        "episodes": len(episodes),
        "env_steps": sum(map(len, episodes)),
    }


def skill_and_sensitivity(world: World, windows: Windows) -> dict[str, float]:
    """Both numbers, on the first chunk of windows."""
    recorded = windows.frames[:, 0]
    newest = windows.context.frames[:, -1]
    other = replace(windows, actions=windows.actions[donors(windows.episode)])
    predicted = replay(world.model, windows)[:, 0]
    misled = replay(world.model, other)[:, 0]
    difference = (recorded.int() - newest.int()).abs()
    changed = difference.amax(-1) > CHANGED
    errors = squared_errors(predicted, recorded)
    copied = squared_errors(newest, recorded)
    misled_error = squared_errors(misled, recorded).mean()
    skill = 1 - errors[changed].mean() / copied[changed].mean()  # NaN where nothing changes
    sensitivity = misled_error / errors.mean().clamp(min=1e-9)
    return {"skill": float(skill), "sensitivity": float(sensitivity)}


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
    at = [WindowStart(e, 0) for e in range(len(episodes))]
    windows = whole_windows(episodes, at, world)
    known = windows.known
    frames = replay(world.model, windows)
    probabilities = torch.zeros(known.shape)
    probabilities[known] = world.success.probabilities(frames[known], windows.known_tasks)
    return probabilities.amax(1).numpy(), windows.success.any(1).numpy()


def choose_threshold(scores: np.ndarray, achieved: np.ndarray) -> float:
    """Chooses the score above which a replay counts as a success, at least 0.5.

    Of the thresholds that let at most `FALSE_POSITIVES` of the failures through, the threshold with the
    largest share of successes less share of failures above it. The strictest would be safe, and a policy that
    never sees a success learns nothing.
    """
    failures = scores[~achieved]
    successes = scores[achieved]
    # Only thresholds just above a failure are worth trying.
    candidates = [0.5, *np.nextafter(failures[failures >= 0.5], np.inf, dtype=np.float32).tolist()]
    margins = {}
    for least in candidates:
        false_positives = share_above(failures, least)
        if false_positives <= FALSE_POSITIVES:
            margins[least] = share_above(successes, least) - false_positives
    best = max(margins, key=margins.__getitem__)
    return min(float(best), 1 - 1e-6)


def share_above(scores: np.ndarray, threshold: float) -> float:
    if not len(scores):
        return 0.0
    return float((scores > threshold).mean())


def auroc(scores: np.ndarray, labels: np.ndarray) -> float:
    """Chance that a success scores above a failure, ties counting half; NaN without both."""
    difference = scores[labels][:, None] - scores[~labels]
    if not difference.size:
        return np.nan
    return float(((difference > 0) + 0.5 * (difference == 0)).mean())


def preview(video: Path, world: World, episodes: Sequence[Episode]) -> None:
    """Films recorded episodes in the first row, and their imagined replays in the second."""
    previewed = episodes[:PREVIEWED]
    at = [WindowStart(e, 0) for e in range(len(previewed))]
    windows = whole_windows(previewed, at, world)
    lines = []
    for frames in (windows.frames, replay(world.model, windows)):
        clips = frames.repeat_interleave(SCALE, 3).repeat_interleave(SCALE, 4)
        beside = torch.cat(list(clips.unbind(2)), dim=3)  # cameras beside each other
        lines.append([list(clip) for clip in beside.numpy()])
    write_video(video, lines, fps=FPS)
