# SPDX-License-Identifier: Apache-2.0
"""Training of a pixel world model before a run.

``accerl world-model`` trains on a LeRobotDataset, and `run.play` on what a run has recorded for it.

<output_dir>/
  world_model/       see `imagined.py`
  metrics.jsonl      training losses
  validation.json    the check
  preview.mp4        held-out episodes, recorded above imagined
"""

from __future__ import annotations

import json
import time
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from accerl_lerobot.checkpoint.layout import write_atomically
from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.console import Console
from accerl_lerobot.envs import EnvConfig, make_environment
from accerl_lerobot.errors import InputError, expanded
from accerl_lerobot.metrics import plain
from accerl_lerobot.policies.loading import resolve_device
from accerl_lerobot.world_model.check import check, checks_table, preview
from accerl_lerobot.world_model.config import WorldModelConfig
from accerl_lerobot.world_model.contract import WorldModelSpec, new_model
from accerl_lerobot.world_model.data import load_episodes, split_episodes
from accerl_lerobot.world_model.imagined import World, load_world, read_content, save_world
from accerl_lerobot.world_model.training import Trainer, uniform

if TYPE_CHECKING:
    from accerl_lerobot.cli.configs import WorldModelEvalRun

LOG_EVERY = 20  # steps between two lines of training losses
VALIDATION = "validation.json"


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
        context=config.model.context, fps=sizes.fps,
    )  # fmt: skip
    with console.stage("episodes"):
        episodes = load_episodes(dataset, spec)
    learnt, held_out = split_episodes(episodes, np.random.default_rng((seed, 0)))
    if any({episode.success for episode in part} != {True, False} for part in (learnt, held_out)):
        hint = (
            "it needs at least two successes and two failures, to hold out one of each; record more episodes"
        )
        raise InputError("dataset.repo_id", dataset.repo_id, hint)
    spec = replace(spec, tasks=tuple(sorted({episode.task for episode in episodes})))
    started = time.monotonic()
    torch.manual_seed(seed)
    # The networks are initialised on the CPU, so alike on every device.
    world = World(new_model(spec, config.model)).to(torch_device)
    trainer, weights = Trainer(world, config.lr, seed, config.steps), uniform(learnt)
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
    seconds = time.monotonic() - started
    world = trainer.serving
    with console.stage("check"):
        found = check(world, held_out, seed)
        preview(directory / "preview.mp4", world, held_out)
    world.success.threshold.fill_(found["threshold"])
    failed = [name for name, outcome in found["checks"].items() if not outcome["holds"]]
    save_world(directory / "world_model", world, [episode.key for episode in learnt], failed)
    found = found | {"learnt": len(learnt), "seconds": seconds}
    write_atomically(directory / VALIDATION, json.dumps(plain(found), indent=2) + "\n")
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
    with console.stage("check"):
        found = check(world, kept, run.seed)
        preview(directory / "preview.mp4", world, kept)
    write_atomically(directory / VALIDATION, json.dumps(plain(found), indent=2) + "\n")
    return found


def show(found: dict[str, Any], directory: Path, console: Console) -> None:
    """Shows people the outcome of a check."""
    console.rich.print(checks_table(found))
    console.say(f"{'passed' if found['passed'] else 'FAILED'}; see {directory / 'preview.mp4'}")
