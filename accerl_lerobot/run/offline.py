# SPDX-License-Identifier: Apache-2.0
"""Learning from recorded episodes alone, a real robot's for instance: no environment, no rollout workers.

LeRobotDataset with `next.success` or `next.reward` → the trainer's memory → steps of an off-policy algorithm
"""

from __future__ import annotations

import contextlib
import logging
import math
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from accerl_lerobot.algorithms import ChunkCriticConfig, OffPolicyConfig
from accerl_lerobot.checkpoint import layout
from accerl_lerobot.config.parsing import encode
from accerl_lerobot.console import Console
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import ENVIRONMENT_STATE
from accerl_lerobot.metrics import MetricsLog, plain
from accerl_lerobot.run.adapter import make_adapter
from accerl_lerobot.seeds import torch_seeded
from accerl_lerobot.world_model.config import SimulatorStateConfig, default_state_model

if TYPE_CHECKING:
    from accerl_lerobot.cli.configs import OfflineRun

logger = logging.getLogger(__name__)

BYTES = 4 * 1024**3  # observations that are kept in memory at most
LOG_EVERY = 25  # updates between two records of metrics, which are means over them
COMPARED = 64  # decisions of successes, and of failures, whose imitation loss is measured before and after


def learn_offline(config: OfflineRun, directory: Path, console: Console) -> dict[str, Any]:
    """Learn, and write ``checkpoints/NNNNNN`` and ``summary.json`` into `directory`; returns the summary."""
    from accerl_lerobot.algorithms.update import make_update
    from accerl_lerobot.demos.dataset_files import open_metadata
    from accerl_lerobot.policies.loading import dry_run_config

    started = time.monotonic()
    torch.manual_seed(config.seed)
    torch.set_num_threads(config.trainer.num_threads)
    policy = dry_run_config(config.policy, learns=True)
    meta = open_metadata(config.dataset)
    shapes = _check(config, policy, meta)
    # One step for each update, instead of so many for each new decision.
    assert isinstance(config.algorithm, OffPolicyConfig)
    algorithm = replace(config.algorithm, policy_steps=1.0)
    if isinstance(algorithm, ChunkCriticConfig):
        algorithm = replace(algorithm, critic_steps=algorithm.critic_steps or 1.0)
    model = config.world_model or default_state_model(ENVIRONMENT_STATE in shapes)
    numbers = math.prod(shapes.get(ENVIRONMENT_STATE, (0,)))
    adapter = make_adapter(
        algorithm, model, config.policy, environment_state=numbers, remembered=None, load=None
    )
    update: Any = make_update(adapter, algorithm, config.trainer)
    counts = _remember(config, update, meta, shapes, console)
    losses = {"before": _imitation(update)}
    _learn(config, update, directory, console)

    def write(folder: Path) -> int:
        update.adapter.save(folder / layout.PRETRAINED)
        shutil.copyfile(directory / layout.CONFIG, folder / layout.CONFIG)
        return int(update.version)

    checkpoints = directory / layout.CHECKPOINTS
    layout.save_checkpoint(checkpoints, write)
    losses["after"] = _imitation(update)
    summary: dict[str, Any] = counts | {
        "algorithm": algorithm.type,
        "updates": update.version,
        "imitation_loss": losses,
        "wall_s": time.monotonic() - started,
        "policy": str(checkpoints / layout.LAST / layout.PRETRAINED),
    }
    summary = plain(summary)
    layout.write_json(directory / layout.SUMMARY, summary)
    return summary


def _learn(config: OfflineRun, update: Any, directory: Path, console: Console) -> None:
    """Make all updates, and log the means of their metrics."""
    last = config.trainer.updates
    recent: dict[str, list[float]] = {}
    with (
        contextlib.closing(MetricsLog(directory, config.wandb, encode(config))) as log,
        console.stage(f"offline ({config.algorithm.type})", total=last) as stage,
    ):
        while update.version < last:
            for name, value in update.learn(1).items():
                recent.setdefault(name, []).append(value)
            update.version += 1
            if update.version % LOG_EVERY == 0 or update.version == last:
                means = {name: float(np.mean(values)) for name, values in recent.items()}
                log.write("train", update.version, means)
                loss = means.get("imitation_loss", math.nan)
                stage.update(update.version, f"imitation loss {loss:.4f}")
                recent = {}


def _check(config: OfflineRun, policy: Any, meta: Any) -> dict[str, tuple[int, ...]]:
    """Shapes of the observations that the policy reads, by the dataset's names, and of ``action``."""
    from accerl_lerobot.experience import REWARD, SUCCESS
    from accerl_lerobot.policies.features import (
        ACTION,
        check_features,
        dataset_features,
        dataset_shapes,
        policy_features,
    )
    from accerl_lerobot.run.preflight import check_imitates

    check_imitates(config.algorithm, config.policy, policy)
    offered = dataset_features(meta)
    renames = config.policy.rename_map
    check_features(policy_features(policy), offered, renames, "policy.path", config.policy.path, "dataset")
    if policy.n_obs_steps > 1:
        hint = "it sees several env steps at once, which offline learning does not; use accerl sft"
        raise InputError("policy.path", config.policy.path, hint)
    if not {SUCCESS, REWARD} & set(meta.features):
        hint = f"its episodes are labelled neither by {SUCCESS} nor {REWARD}; use accerl sft"
        raise InputError("dataset.repo_id", config.dataset.repo_id, hint)
    shapes = dataset_shapes(meta)
    read = policy_features(policy).shapes.keys() | {ACTION}
    if isinstance(config.algorithm, ChunkCriticConfig):
        read |= {ENVIRONMENT_STATE}
    if isinstance(config.world_model, SimulatorStateConfig) and ENVIRONMENT_STATE not in shapes:
        hint = f"the dataset has no {ENVIRONMENT_STATE}; use latent"
        raise InputError("world_model.type", config.world_model.type, hint)
    return {name: shape for name, shape in shapes.items() if renames.get(name, name) in read}


def _remember(
    config: OfflineRun, update: Any, meta: Any, shapes: dict[str, tuple[int, ...]], console: Console
) -> dict[str, Any]:
    """Fill the memory from the dataset; returns the numbers of its episodes, successes and decisions."""
    from accerl_lerobot.algorithms.chunk_critic import LEAST_TRANSITIONS
    from accerl_lerobot.policies.config import executed_rows
    from accerl_lerobot.run.adapter import recorded, some_of_each_task

    algorithm: Any = config.algorithm
    chunk = executed_rows(update.adapter.policy.config)
    size = 0  # bytes of a decision
    for shape in shapes.values():
        is_picture = len(shape) == 3
        size += math.prod(shape) * (1 if is_picture else 4)
    most = max(1, min(algorithm.memory, BYTES // size))
    longest = int(max(meta.episodes["length"]))
    outcomes: dict[int, bool] = {}  # episode → success
    totals: dict[int, float] = {}  # episode → reward of its first segment
    with console.stage("reading the dataset", total=meta.total_frames) as stage:
        frames = 0
        episodes, phases = some_of_each_task(meta, chunk, most, most)
        for segment in recorded(config.dataset, meta, shapes, chunk, episodes, longest, phases):
            update.remember(segment)
            episode = segment.origin.seed
            outcomes[episode] = segment.success
            totals.setdefault(episode, float(segment.reward.sum()))
            frames += int(segment.steps.sum())
            stage.update(frames)
    if len(outcomes) < meta.total_episodes:
        left = f"{len(outcomes)} of {meta.total_episodes} episodes fit into {most} decisions"
        logger.warning("%s, the others are left out", left)
    successes = sum(outcomes.values())
    counts = {"episodes": len(outcomes), "successes": successes, "decisions": len(update.memory)}
    graded = len(set(totals.values())) > 1 and not isinstance(algorithm, ChunkCriticConfig)
    if not len(update.imitable()) or not (successes or graded):
        hint = "none of its episodes is a success, or better than another; there is nothing to imitate"
        raise InputError("dataset.repo_id", config.dataset.repo_id, hint)
    if isinstance(algorithm, ChunkCriticConfig) and update.state_learner is not None:
        transitions = len(update.transitions())
        if transitions < LEAST_TRANSITIONS:
            why = f"{transitions} of its decisions are followed by another one in their episode"
            hint = f"{why}, and the world model learns from {LEAST_TRANSITIONS} or more"
            raise InputError("algorithm.type", algorithm.type, f"{hint}; lower policy.n_action_steps")
    console.say(", ".join(f"{number} {name}" for name, number in counts.items()))
    return counts


@torch.no_grad()
def _imitation(update: Any) -> dict[str, float | None]:
    """Mean imitation loss of some decisions of successes, and of failures; equal noise at every call."""
    losses: dict[str, float | None] = {}
    for name, outcome in (("successes", True), ("failures", False)):
        rows = np.flatnonzero(update.memory["success"] == outcome)
        rows = np.random.default_rng(0).permutation(rows)[:COMPARED]
        losses[name] = None
        if len(rows):
            with torch_seeded(0), update.adapter.autocast():
                observations = update.memory.observations(rows)
                chunks = update.tensor("chunk", rows)
                loss, _ = update.adapter.imitate(*observations, chunks)
            losses[name] = float(loss.float().mean())
    return losses
