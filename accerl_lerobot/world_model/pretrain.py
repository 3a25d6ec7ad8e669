# SPDX-License-Identifier: Apache-2.0
"""Pre-training of a world model on LeRobotDatasets, and its held-out validation; ``accerl world-model``.

<output_dir>/
  world_model/     see `store.py`
  metrics.jsonl    training losses
and the results of the validation, see `validation.py`.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.console import Console, Stage
from accerl_lerobot.envs import EnvConfig, make_environment
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.loading import resolve_device
from accerl_lerobot.world_model import data, learners, store, validation
from accerl_lerobot.world_model.config import WorldModelConfig
from accerl_lerobot.world_model.contract import WorldModelSpec, new_model
from accerl_lerobot.world_model.data import Episode

if TYPE_CHECKING:
    from accerl_lerobot.cli.configs import WorldModelRun

LOG_EVERY = 20  # steps between two lines of training losses
METRICS = "metrics.jsonl"


def world_spec(config: WorldModelConfig, env: EnvConfig) -> WorldModelSpec:
    """Spec of a model of this environment."""
    with closing(make_environment(env)) as environment:
        spec = environment.spec
    return WorldModelSpec(
        cameras=tuple(spec.images), image_size=(config.image_size, config.image_size),
        state_dim=spec.state_dim, action_dim=spec.action_dim, chunk=config.chunk,
        context=config.model.context, fps=spec.fps,
    )  # fmt: skip


def pretrain(run: WorldModelRun, directory: Path, console: Console) -> dict[str, Any]:
    """Trains, validates and saves a world model; `directory` exists and is empty.

    Returns:
        See `validate_datasets`, with ``seconds`` of the training and how many ``episodes`` and ``env_steps``
        were ``learnt`` and ``held_out``.
    """
    device = resolve_device(run.device, "device")
    config, rng = run.world_model, np.random.default_rng((run.seed, 0))
    spec = world_spec(config, run.env)
    learnt: list[Episode] = []
    held_out: dict[str, list[Episode]] = {}
    with console.stage("episodes"):
        loaded = data.load_datasets({data.DATASET: run.dataset, data.ONLINE: run.online}, spec)
        for section, episodes in loaded.items():
            learn, held_out[section] = data.split_episodes(episodes, config.held_out, rng)
            with data.name_section(section):
                _check_split(getattr(run, section), learn, held_out[section], config)
            learnt += learn
    held = [episode for part in held_out.values() for episode in part]
    spec = replace(spec, tasks=_tasks(run.env, learnt + held))

    def on_step(stage: Stage, kind: str, step: int, metrics: dict[str, float]) -> None:
        stage.update(step, " ".join(f"{k} {v:.3f}" for k, v in [*metrics.items()][:2]))
        if step % LOG_EVERY == 0:
            with (directory / METRICS).open("a") as log:
                log.write(json.dumps({"kind": kind, "step": step} | metrics) + "\n")

    started = time.monotonic()
    examples = learners.Examples(learnt, config.chunk)
    torch.manual_seed(run.seed)
    # Both networks are initialised on the CPU, so alike on every device.
    model = new_model(spec, config.model).to(device)
    with console.stage("world model", total=config.learn.steps) as stage:
        say = partial(on_step, stage, "world_model")
        serving = learners.train_from_scratch(model, learnt, config, run.seed, say).serving
    validation.fit_uncertainty_scale(serving, learnt, config.validation, run.seed)
    success = learners.new_success_model(config.chunk).to(device)
    learner = learners.SuccessLearner(success, config, run.seed)
    with console.stage("success model", total=config.success.steps) as stage:
        for step in range(1, config.success.steps + 1):
            on_step(stage, "success_model", step, learner.step(examples, serving))
    success.eval()
    seconds = time.monotonic() - started

    roles = {e.key: store.HELD_OUT for e in held} | {e.key: store.LEARNT for e in learnt}
    store.save_world_model(directory / "world_model", serving, success, roles)
    with console.stage("validation"):
        found = validation.validate_datasets(serving, held_out, config.validation, success, run.seed)
        validation.preview_videos(directory, serving, held_out, config.validation, run.seed)
    failed = (name for name, check in found["checks"].items() if not check["holds"])
    store.note_failed(directory / "world_model", failed)
    # The threshold is chosen on the policy's failures, where there are any, as demonstrations fail otherwise.
    success.config.threshold = list(found["datasets"].values())[-1]["threshold"]
    success.save_pretrained(directory / "world_model" / store.SUCCESS)
    counts = {"learnt": data.count_episodes(learnt), "held_out": data.count_episodes(held)}
    return found | counts | {"seconds": seconds}


def _tasks(env: EnvConfig, episodes: Sequence[Episode]) -> tuple[str, ...]:
    """Names of the environment's tasks that the episodes have, matched by their instructions."""
    with closing(make_environment(env)) as environment:
        instructions = {name: str(environment.reset(0, name)["task"]) for name in environment.spec.tasks}
    recorded = {episode.task for episode in episodes}
    if unknown := sorted(recorded - set(instructions.values())):
        hint = f"an episode's task is {unknown[0][:80]!r}, which none of these is; name its task"
        raise InputError("env.task", ", ".join(instructions), hint)
    return tuple(name for name, task in instructions.items() if task in recorded)


def _check_split(
    dataset: DatasetConfig, learnt: Sequence[Episode], held_out: Sequence[Episode], config: WorldModelConfig
) -> None:
    """Refuses a split that could not be validated, before the training."""
    if any({episode.success for episode in part} != {True, False} for part in (learnt, held_out)):
        hint = "at least two successes and two failures (demos.failure_share) are needed, to hold out one"
        raise InputError("dataset.repo_id", dataset.repo_id, hint)
    needed = config.chunk * config.validation.depth + 1
    longest = max(len(episode.frames) for episode in held_out)
    if longest < needed:
        hint = f"held-out episodes have at most {longest} frames, and rollouts of this depth need {needed}"
        raise InputError("world_model.validation.depth", config.validation.depth, hint)
