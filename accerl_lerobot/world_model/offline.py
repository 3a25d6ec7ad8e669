# SPDX-License-Identifier: Apache-2.0
"""A world model from a dataset: learnt, tried on episodes it has not seen, filmed and saved.

<output_dir>/
  world_model/     what `store.py` writes
  trial.json       what became of it
  preview.mp4      what happened, what it dreamt with those actions, and with another episode's; of a policy's
                   episodes preview_online.mp4
  metrics.jsonl    losses, of what is learnt and of what is held out
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

from accerl_lerobot.config.dataset import DatasetConfig
from accerl_lerobot.console import Console
from accerl_lerobot.envs import EnvConfig, make_world
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.loading import resolve_device
from accerl_lerobot.world_model.config import WorldModelConfig
from accerl_lerobot.world_model.contract import (
    LearnableWorldModel,
    WorldModelSpec,
    learnable_class,
    new_learnable,
)
from accerl_lerobot.world_model.dataset import fingerprint, load_episodes
from accerl_lerobot.world_model.episodes import Episode, amount, split
from accerl_lerobot.world_model.learn import pretrain
from accerl_lerobot.world_model.sources import (
    HELD_OUT,
    ONLINE,
    check_apart,
    named,
    open_rooms,
    rooms_of,
    try_sources,
)
from accerl_lerobot.world_model.store import SUCCESS, Source, save_world_model
from accerl_lerobot.world_model.success import Examples, SuccessLearner, new_success_model, validated
from accerl_lerobot.world_model.success_plugin.modeling_success_pairs import SuccessPairsRewardModel
from accerl_lerobot.world_model.trial import calibrate

if TYPE_CHECKING:
    from accerl_lerobot.cli.configs import WorldModelRun

EVERY = 20
"""Steps between two lines of losses of what is learnt."""
METRICS = "metrics.jsonl"


def world_spec(config: WorldModelConfig, env: EnvConfig) -> WorldModelSpec:
    """Spec of the model to be learnt."""
    world = make_world(env)
    try:
        seen = world.spec
    finally:
        world.close()
    return WorldModelSpec(
        cameras=tuple(seen.images),
        image_size=(config.image_size, config.image_size),
        state_dim=seen.state_dim,
        action_dim=seen.action_dim,
        chunk=config.chunk,
        context=config.model.context,
        fps=seen.fps,
        provides=config.model.provides(seen.state_dim),
    )


class _Split(NamedTuple):
    """One dataset's episodes."""

    learn: list[Episode]
    held: list[Episode]
    source: Source


def learn_world_model(run: WorldModelRun, directory: Path, console: Console) -> dict[str, Any]:
    """Does all of it; `directory` exists and is empty.

    Returns:
        What `try_sources` found, with ``seconds`` of the learning and how many ``episodes`` and ``env_steps``
        were learnt from and held out; also in ``trial.json``.

    Raises:
        InputError: no such device or class of world models; a dataset is named twice or of another world;
            nothing can be learnt from it, see `load_episodes`, or nothing would be left to judge; an episode
            is in both; the world has not the task of one.
    """
    device = resolve_device(run.device, "device")
    config, seed = run.world_model, run.seed
    learnable_class(config.model)
    spec, rng = world_spec(config, run.env), _rng(seed)
    rooms = rooms_of(run)
    metas = open_rooms(rooms, spec)
    parts: dict[str, _Split] = {}
    every: list[Episode] = []
    with console.stage("episodes"):
        for room, dataset in rooms.items():
            name, source = (HELD_OUT, "demo") if room == "dataset" else (ONLINE, ONLINE)
            with named(room):
                episodes = load_episodes(dataset, spec, source)
                check_apart(dataset, episodes, every)
                parts[name] = _split(dataset, metas[room], episodes, config, rng)
            every += episodes
    learn = [episode for part in parts.values() for episode in part.learn]
    held = {name: part.held for name, part in parts.items()}
    spec = replace(spec, tasks=_tasks(run.env, every))
    tried = [episode for part in held.values() for episode in part]
    started = time.monotonic()
    serving, success = _learn(run, spec, learn, tried, device, directory, console)
    seconds = time.monotonic() - started
    save_world_model(directory / "world_model", serving, None, [part.source for part in parts.values()])
    # The threshold is that of a policy's failures, where there are any: demonstrations fail otherwise.
    *_, fresh = held
    found = try_sources(
        serving, held, config.trial, success, directory, console,
        learnt=held, fresh=fresh, kept=True, seed=seed,
    )  # fmt: skip
    found |= {"seconds": seconds, "learnt": amount(learn), "held_out": amount(tried)}
    (directory / "trial.json").write_text(json.dumps(found, indent=2) + "\n")
    success.save_pretrained(directory / "world_model" / SUCCESS)  # with its threshold
    return found


def _learn(
    run: WorldModelRun,
    spec: WorldModelSpec,
    learn: Sequence[Episode],
    held: Sequence[Episode],
    device: torch.device,
    directory: Path,
    console: Console,
) -> tuple[LearnableWorldModel, SuccessPairsRewardModel]:
    """World model and success model of the episodes to `learn` from; those `held` out are only looked at."""
    config, seed = run.world_model, run.seed
    examples, others = (Examples(part, config.chunk) for part in (learn, held))
    torch.manual_seed(seed)
    # Both networks begin on the CPU, and so alike wherever they learn.
    model = new_learnable(spec, config.model).to(device)
    with (directory / METRICS).open("w") as log:

        def record(kind: str, step: int, metrics: dict[str, float]) -> None:
            log.write(json.dumps({"kind": kind, "step": step} | metrics) + "\n")

        with console.stage("world model", total=config.learn.steps) as stage:
            seen = ""

            def on_step(step: int, metrics: dict[str, float]) -> None:
                stage.update(step, _status(metrics) + seen)
                if step % EVERY == 0:
                    record("world_model", step, metrics)

            def on_held_out(step: int, metrics: dict[str, float]) -> None:
                nonlocal seen
                seen = f", held out {_status(metrics)}"
                record("world_model_held_out", step, metrics)

            serving = pretrain(
                model, learn, config.learn, seed, config.shuffle_actions, on_step, held, on_held_out
            ).serving
        calibrate(serving, learn, config.trial, seed)
        success = new_success_model(config.chunk).to(device)
        learner = SuccessLearner(success, config.success, seed)
        with console.stage("success model", total=config.success.steps) as stage:
            seen, every = "", config.success.validate_every
            for step in range(1, config.success.steps + 1):
                metrics = learner.step(examples, serving)
                if step % EVERY == 0:
                    record("success_model", step, metrics)
                if every and step % every == 0:
                    found = validated(success, others, seed)
                    seen = f", held out {found['loss']:.3f}"
                    record("success_model_held_out", step, found)
                stage.update(step, f"loss {metrics['loss']:.3f}{seen}")
    return serving, success.eval()


def _status(metrics: dict[str, float]) -> str:
    """The first two of them; those of our own models are ``image`` and ``state``."""
    return " ".join(f"{name} {value:.3f}" for name, value in [*metrics.items()][:2])


def _split(
    dataset: DatasetConfig,
    meta: Any,
    episodes: Sequence[Episode],
    config: WorldModelConfig,
    rng: np.random.Generator,
) -> _Split:
    learnt, held_out = split(episodes, config.held_out, rng)
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
    """Names of the world's tasks that the episodes are of, known by their instructions."""
    world = make_world(env)
    try:
        told = {name: str(world.reset(0, name)["task"]) for name in world.spec.tasks}
    finally:
        world.close()
    shown = {episode.task for episode in episodes}
    if unknown := sorted(shown - set(told.values())):
        remedy = f"an episode's task is {unknown[0][:80]!r}, which none of these is; name its task"
        raise InputError("env.task", ", ".join(told), remedy)
    return tuple(name for name, task in told.items() if task in shown)


def _check_held_out(
    dataset: DatasetConfig, learn: Sequence[Episode], held: Sequence[Episode], config: WorldModelConfig
) -> None:
    """Refuses a split that could not be judged, before anything is learnt."""
    counts = [sum(e.success for e in part) for part in (learn, held)]
    failures = [len(part) - count for part, count in zip((learn, held), counts, strict=True)]
    if min(*counts, *failures) < 1:
        remedy = "at least two successes and two failures are needed, to learn from and to be judged on"
        raise InputError("dataset.repo_id", dataset.repo_id, remedy)
    wanted = config.chunk * config.trial.depth + 1
    longest = max(len(e.frames) for e in held)
    if longest < wanted:
        remedy = f"held-out episodes have at most {longest} frames, and dreams of this depth need {wanted}"
        raise InputError("world_model.trial.depth", config.trial.depth, remedy)


def _rng(seed: int) -> np.random.Generator:
    return np.random.default_rng((seed, 0))
