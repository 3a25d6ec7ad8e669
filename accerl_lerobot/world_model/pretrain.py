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
from collections.abc import Sequence
from contextlib import closing
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
    WindowStart,
    cut_windows,
    load_episodes,
    replay,
    spec_of,
    starts_of,
)
from accerl_lerobot.world_model.imagined import World, load_world, new_world, save_world
from accerl_lerobot.world_model.training import Trainer

if TYPE_CHECKING:
    from accerl_lerobot.cli.configs import WorldModelEvalRun

LOG_EVERY = 20  # steps between two lines of training losses
VALIDATION = "validation.json"
HELD_OUT = 0.2  # share of the episodes that a world model is checked on
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
    """Trains, checks and saves a world model; `directory` exists. Returns what `check` returns."""
    torch_device = resolve_device(device, "device")
    with closing(make_environment(env)) as environment:
        spec = spec_of(environment.spec, config.image_size, config.chunk)
    torch.manual_seed(seed)
    # The networks are initialised on the CPU, so that they are equal on every device.
    world = new_world(spec, config.model).to(torch_device)
    with console.stage("episodes"):
        episodes = load_episodes(dataset, spec)
    rng = np.random.default_rng(seed)
    learnt: list[Episode] = []
    held_out: list[Episode] = []
    for outcome in (False, True):
        of_outcome = shuffled([episode for episode in episodes if episode.success == outcome], rng)
        if len(of_outcome) < 2:
            hint = "it needs at least two successes and two failures, to hold out one of each; record more"
            raise InputError("dataset.repo_id", dataset.repo_id, hint)
        count = max(1, round(HELD_OUT * len(of_outcome)))
        held_out += of_outcome[:count]
        learnt += of_outcome[count:]
    world.tasks = sorted({episode.task for episode in episodes})
    world.learnt = sorted(episode.key for episode in learnt)
    trainer = Trainer(world, learnt, config.lr, config.steps)
    trainer.fit_statistics()
    with (
        console.stage("world model", total=config.steps) as stage,
        (directory / "metrics.jsonl").open("w") as log,
    ):
        for step in range(1, config.steps + 1):
            metrics = trainer.step()
            stage.update(step, " ".join(f"{name} {value:.3f}" for name, value in metrics.items()))
            if step % LOG_EVERY == 0:
                log.write(json.dumps({"step": step} | metrics) + "\n")
    world = trainer.serving
    found = _validate(world, held_out, seed, directory, console)
    world.success.threshold.fill_(found["threshold"])
    world.failed_checks = found["failed"]
    save_world(directory / "world_model", world)
    return found


def evaluate(run: WorldModelEvalRun, directory: Path, console: Console) -> dict[str, Any]:
    """Checks a saved world model on episodes that it was not trained on."""
    device = resolve_device(run.device, "device")
    world = load_world(expanded(str(run.path), "path"), run.discover_packages_path).to(device)
    with console.stage("episodes"):
        episodes = load_episodes(run.dataset, world.model.spec)
    kept = [episode for episode in episodes if episode.key not in world.learnt]
    if not kept:
        hint = "the world model was trained on every episode of it; give another dataset"
        raise InputError("dataset.repo_id", run.dataset.repo_id, hint)
    return _validate(world, kept, run.seed, directory, console)


def _validate(
    world: World, episodes: Sequence[Episode], seed: int, directory: Path, console: Console
) -> dict[str, Any]:
    """Check a world, and write the outcome and the video."""
    # Of a merged dataset not its first part, and the same for every order of the episodes.
    ordered = sorted(episodes, key=lambda episode: episode.key)
    chosen = shuffled(ordered, np.random.default_rng(seed))
    with console.stage("check"):
        found = check(world, chosen)
        preview(directory / "preview.mp4", world, chosen[:PREVIEWED])
    write_atomically(directory / VALIDATION, json.dumps(plain(found), indent=2) + "\n")
    return found


def shuffled(episodes: Sequence[Episode], rng: np.random.Generator) -> list[Episode]:
    return [episodes[i] for i in rng.permutation(len(episodes))]


def show(found: dict[str, Any], directory: Path, console: Console) -> None:
    """Show people the outcome of a check."""
    for name, bound in BOUNDS.items():
        verdict = ", FAILED" if name in found["failed"] else ""
        console.say(f"{name} {found[name]:.2f}, to be above {bound:g}{verdict}")
    verdict = "FAILED" if found["failed"] else "passed"
    console.say(f"{verdict} on {found['episodes']} episodes; see {directory / 'preview.mp4'}")


def check(world: World, episodes: Sequence[Episode]) -> dict[str, Any]:
    """Checks a world on some of these episodes, whose order is by chance.

    Returns:
        ``skill``, ``sensitivity``, ``auroc``; ``failed``, the names of those that are not above their bound;
        ``threshold`` of the success model, chosen on these episodes; number of ``episodes``.
    """
    found: dict[str, Any] = skill_and_sensitivity(world, episodes)
    scores, achieved = replay_scores(world, episodes[:MOST_REPLAYS])
    found["auroc"] = auroc(scores, achieved)
    # NaN passes nothing.
    found["failed"] = [name for name, bound in BOUNDS.items() if not found[name] > bound]
    found["threshold"] = choose_threshold(scores, achieved)
    found["episodes"] = len(episodes)
    return found


def skill_and_sensitivity(world: World, episodes: Sequence[Episode]) -> dict[str, float]:
    """Both numbers, on windows of one chunk, spread evenly over the episodes."""
    chunk = world.model.spec.chunk
    at = []
    for start in starts_of(episodes):
        times = start.episode.times
        if times[start.frame] + chunk <= times[-1]:
            at.append(start)
    if not at:
        return {"skill": np.nan, "sensitivity": np.nan}
    at = at[:: 1 + len(at) // MOST_WINDOWS]
    windows = cut_windows(at, world.model.spec, 1, world.device)
    # They lie together by episode, so half of them further on is another episode's.
    other = windows._replace(actions=windows.actions.roll(len(at) // 2, 0))
    recorded = windows.frames[:, 0]
    newest = windows.context.frames[:, -1]
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


def replay_scores(world: World, episodes: Sequence[Episode]) -> tuple[np.ndarray, np.ndarray]:
    """Highest P(success) in each episode's imagined replay, until it really ended, and the real outcome."""
    at = [WindowStart(episode, 0) for episode in episodes]
    windows = cut_windows(at, world.model.spec, device=world.device)
    known = windows.known
    frames = replay(world.model, windows)
    probabilities = torch.zeros(known.shape, device=known.device)
    probabilities[known] = world.success.probabilities(frames[known], windows.known_codes)
    return probabilities.amax(1).cpu().numpy(), np.array([episode.success for episode in episodes])


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
    at = [WindowStart(episode, 0) for episode in episodes]
    windows = cut_windows(at, world.model.spec, device=world.device)
    lines = []
    for frames in (windows.frames, replay(world.model, windows)):
        clips = frames.repeat_interleave(SCALE, 3).repeat_interleave(SCALE, 4)
        beside = torch.cat(list(clips.unbind(2)), dim=3)  # cameras beside each other
        lines.append([list(clip) for clip in beside.cpu().numpy()])
    write_video(video, lines, fps=FPS)
