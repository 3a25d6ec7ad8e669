# SPDX-License-Identifier: Apache-2.0
"""Pre-training of a world model on LeRobotDatasets, and its held-out validation; ``accerl world-model``.

<output_dir>/
  world_model/     see `store.py`
  validation.json  results
  preview.mp4      real, predicted, and predicted with another episode's actions; of a policy's episodes
                   preview_online.mp4
  metrics.jsonl    training losses
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.console import Console
from accerl_lerobot.envs import EnvConfig, make_world
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.loading import resolve_device
from accerl_lerobot.world_model.config import WorldModelConfig
from accerl_lerobot.world_model.contract import (
    LearnableWorldModel,
    WorldModelSpec,
    learnable_class,
)
from accerl_lerobot.world_model.data import (
    Episode,
    count_episodes,
    fingerprint,
    load_episodes,
    split_episodes,
)
from accerl_lerobot.world_model.learners import (
    Examples,
    SuccessLearner,
    new_success_model,
    train_from_scratch,
)
from accerl_lerobot.world_model.store import SUCCESS, Source, save_world_model
from accerl_lerobot.world_model.success_plugin.modeling_success_pairs import SuccessPairsRewardModel
from accerl_lerobot.world_model.validation import (
    DATASET,
    HELD_OUT,
    ONLINE,
    RESULT,
    check_disjoint,
    dataset_sections,
    fit_uncertainty_scale,
    name_section,
    open_datasets,
    validate_datasets,
)

if TYPE_CHECKING:
    from accerl_lerobot.cli.verbs import WorldModelRun

LOG_EVERY = 20
"""Steps between two lines of training losses."""
METRICS = "metrics.jsonl"


def world_spec(config: WorldModelConfig, env: EnvConfig) -> WorldModelSpec:
    """Spec of a model of this environment."""
    world = make_world(env)
    try:
        spec = world.spec
    finally:
        world.close()
    return WorldModelSpec(
        cameras=tuple(spec.images),
        image_size=(config.image_size, config.image_size),
        state_dim=spec.state_dim,
        action_dim=spec.action_dim,
        chunk=config.chunk,
        context=config.model.context,
        fps=spec.fps,
        provides=config.model.provides(spec.state_dim),
    )


class _Split(NamedTuple):
    """One dataset's episodes."""

    learn: list[Episode]
    held_out: list[Episode]
    source: Source


def pretrain(run: WorldModelRun, directory: Path, console: Console) -> dict[str, Any]:
    """Trains, validates and saves a world model; `directory` exists and is empty.

    Returns:
        See `validate_datasets`, with ``seconds`` of the training and how many ``episodes`` and ``env_steps``
        were ``learnt`` and ``held_out``; also in ``validation.json``.

    Raises:
        InputError: no such device or class of world models; a dataset is named twice or of another
            environment; nothing can be learned from it, see `load_episodes`, or nothing would be left to
            validate on; an episode is in both; the environment lacks the task of one.
    """
    device = resolve_device(run.device, "device")
    config, seed = run.world_model, run.seed
    learnable_class(config.model)
    spec, rng = world_spec(config, run.env), np.random.default_rng((seed, 0))
    sections = dataset_sections(run)
    metas = open_datasets(sections, spec)
    parts: dict[str, _Split] = {}
    every: list[Episode] = []
    with console.stage("episodes"):
        for section, dataset in sections.items():
            name, source = (HELD_OUT, "demo") if section == DATASET else (ONLINE, ONLINE)
            with name_section(section):
                episodes = load_episodes(dataset, spec, source)
                check_disjoint(dataset, episodes, every)
                parts[name] = _split(dataset, metas[section], episodes, config, rng)
            every += episodes
    learn = [episode for part in parts.values() for episode in part.learn]
    held_out = {name: part.held_out for name, part in parts.items()}
    all_held_out = [episode for part in held_out.values() for episode in part]
    spec = replace(spec, tasks=_tasks(run.env, every))
    started = time.monotonic()
    serving, success = _train(run, spec, learn, device, directory, console)
    seconds = time.monotonic() - started
    save_world_model(directory / "world_model", serving, None, [part.source for part in parts.values()])
    # The threshold is chosen on the policy's failures, where there are any, as demonstrations fail otherwise.
    *_, fresh = held_out
    with console.stage("validation"):
        result = validate_datasets(
            serving,
            held_out,
            config.validation,
            success,
            directory,
            trained_on=held_out,
            fresh=fresh,
            keep_threshold=True,
            seed=seed,
        )
    result |= {
        "seconds": seconds,
        "learnt": count_episodes(learn),
        "held_out": count_episodes(all_held_out),
    }
    (directory / RESULT).write_text(json.dumps(result, indent=2) + "\n")
    success.save_pretrained(directory / "world_model" / SUCCESS)  # with its threshold
    return result


def _train(
    run: WorldModelRun,
    spec: WorldModelSpec,
    learn: Sequence[Episode],
    device: torch.device,
    directory: Path,
    console: Console,
) -> tuple[LearnableWorldModel, SuccessPairsRewardModel]:
    """Trains a world model and a success model."""
    config, seed = run.world_model, run.seed
    examples = Examples(learn, config.chunk)
    torch.manual_seed(seed)
    # Both networks are initialised on the CPU, so alike on every device.
    model = learnable_class(config.model)(spec, config.model).to(device)
    with (directory / METRICS).open("w") as log:

        def record(kind: str, step: int, metrics: dict[str, float]) -> None:
            log.write(json.dumps({"kind": kind, "step": step} | metrics) + "\n")

        with console.stage("world model", total=config.learn.steps) as stage:

            def on_step(step: int, metrics: dict[str, float]) -> None:
                stage.update(step, " ".join(f"{k} {v:.3f}" for k, v in [*metrics.items()][:2]))
                if step % LOG_EVERY == 0:
                    record("world_model", step, metrics)

            serving = train_from_scratch(
                model, learn, config.learn, seed, shuffle=config.shuffle_actions, on_step=on_step
            ).serving
        fit_uncertainty_scale(serving, learn, config.validation, seed)
        success = new_success_model(config.chunk).to(device)
        learner = SuccessLearner(success, config.success, seed)
        with console.stage("success model", total=config.success.steps) as stage:
            for step in range(1, config.success.steps + 1):
                metrics = learner.step(examples, serving)
                if step % LOG_EVERY == 0:
                    record("success_model", step, metrics)
                stage.update(step, f"loss {metrics['loss']:.3f}")
    return serving, success.eval()


def _split(
    dataset: DatasetConfig,
    meta: Any,
    episodes: Sequence[Episode],
    config: WorldModelConfig,
    rng: np.random.Generator,
) -> _Split:
    learnt, held_out = split_episodes(episodes, config.held_out, rng)
    learn, held = ([episodes[i] for i in part] for part in (learnt, held_out))
    _check_held_out(dataset, learn, held, config)
    source = Source(
        repo_id=dataset.repo_id or "",
        fingerprint=fingerprint(meta),
        learnt=tuple(learnt),
        held_out=tuple(held_out),
    )
    return _Split(learn, held, source)


def _tasks(env: EnvConfig, episodes: Sequence[Episode]) -> tuple[str, ...]:
    """Names of the environment's tasks that the episodes have, matched by their instructions."""
    world = make_world(env)
    try:
        instructions = {name: str(world.reset(0, name)["task"]) for name in world.spec.tasks}
    finally:
        world.close()
    recorded = {episode.task for episode in episodes}
    if unknown := sorted(recorded - set(instructions.values())):
        remedy = f"an episode's task is {unknown[0][:80]!r}, which none of these is; name its task"
        raise InputError("env.task", ", ".join(instructions), remedy)
    return tuple(name for name, task in instructions.items() if task in recorded)


def _check_held_out(
    dataset: DatasetConfig, learn: Sequence[Episode], held: Sequence[Episode], config: WorldModelConfig
) -> None:
    """Refuses a split that could not be validated, before the training."""
    counts = [sum(e.success for e in part) for part in (learn, held)]
    failures = [len(part) - count for part, count in zip((learn, held), counts, strict=True)]
    if min(*counts, *failures) < 1:
        remedy = "at least two successes and two failures are needed, to train on and to hold out"
        raise InputError("dataset.repo_id", dataset.repo_id, remedy)
    needed = config.chunk * config.validation.depth + 1
    longest = max(len(e.frames) for e in held)
    if longest < needed:
        remedy = f"held-out episodes have at most {longest} frames, and rollouts of this depth need {needed}"
        raise InputError("world_model.validation.depth", config.validation.depth, remedy)
