# SPDX-License-Identifier: Apache-2.0
"""Scripted experts in parallel processes, recorded as one LeRobotDataset.

Worker processes simulate and send arrays; the parent writes. An episode's seed follows from its place in the
dataset, so the content does not depend on how many processes worked on it.
"""

from __future__ import annotations

import importlib.metadata
import json
import logging
import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import draccus
import numpy as np
from rich.progress import Progress

from accerl_lerobot.config.ranges import DatasetName, NewFolder, Range, Section, Seed, Share
from accerl_lerobot.demos.expert import Episode, make_expert, play
from accerl_lerobot.demos.writing import (
    appearing,
    check_free,
    in_order,
    new_dataset,
    simulators,
)
from accerl_lerobot.envs import make_world
from accerl_lerobot.envs.base import EnvConfig, World, WorldSpec
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import ENVIRONMENT_STATE, REWARD, SUCCESS
from accerl_lerobot.seeds import demo_seed

SIDECAR = Path("meta") / "accerl_demos.json"
"""Inside the dataset: the two configs, what came of them, and the versions that decide on the physics."""

_logger = logging.getLogger(__name__)
_MAX_EPISODES = 10_000
_MAX_TRIES = 50
_VERSIONS = {name: name for name in ("lerobot", "metaworld", "robosuite", "mujoco", "numpy")}
_VERSIONS |= {"libero": "hf-libero"}
"""Module → distribution."""


@dataclass(frozen=True, kw_only=True)
class DemosConfig(Section, section="demos"):
    """How many demonstrations, how disturbed, written where.

    Example:
        >>> record_demos(MetaWorldConfig(), DemosConfig(episodes=25, root="outputs/drawer"))
    """

    episodes: Annotated[int, Range("[1, 10000]")] = 25
    """Episodes in the dataset; spread evenly over the tasks."""
    action_noise: Share = 0.1
    """Standard deviation of the Gaussian added to the expert's action before clipping. The noisy
    action is executed and recorded, so the dataset also shows how to recover."""
    push: Annotated[float, Range("[0, 2]")] = 0.0
    """Largest length of a constant vector, drawn anew for each episode, that is added to the expert's action
    before the noise. An expert that is pushed aside misses narrowly, as a policy does, and drifting
    does not; use it with `keep_failures`, for success and world models."""
    failure_share: Share = 0.0
    """Share of episodes that drift at random from early on and fail; for success and world models."""
    keep_failures: bool = False
    """Keep expert episodes that failed; otherwise they are tried again with another seed."""
    shifted: bool = False
    """Apply ``env.shift`` to the demonstrations too; otherwise they show the world without it."""
    seed: Seed = 0
    """Disjoint demonstrations for different seeds."""
    processes: Annotated[int, Range("[1, 64]")] = 2
    """Simulator processes; does not change the content."""
    repo_id: DatasetName = "accerl/demos"
    """Name of the dataset, ``owner/name``; also its place on the Hub if it is pushed."""
    root: NewFolder = "outputs/demos"
    """Folder to create; must not exist."""


def record_demos(env_config: EnvConfig, config: DemosConfig) -> Path:
    """Records demonstrations.

    The dataset appears at ``config.root`` only when it is complete.

    Returns:
        The dataset's folder; open it with ``LeRobotDataset(config.repo_id, root=...)``.
    """
    root = check_free(config.root, "demos.")
    if not config.shifted:
        env_config = env_config.nominal()
    world = make_world(env_config)
    spec = world.spec
    for task in spec.tasks:
        make_expert(env_config, world, task)  # refuses a task without an expert before any work
    world.close()
    with appearing(root) as partial:
        tally = _write(env_config, config, spec, partial)
        sidecar = {
            "env": draccus.encode(env_config, EnvConfig),
            "demos": {k: v for k, v in draccus.encode(config).items() if k not in ("root", "processes")},
            **tally,
            "versions": {k: importlib.metadata.version(v) for k, v in _VERSIONS.items() if find_spec(k)},
        }
        (partial / SIDECAR).write_text(json.dumps(sidecar, indent=2) + "\n")
    _logger.info("%s: %s", root, tally)
    return root


def _write(env_config: EnvConfig, config: DemosConfig, spec: WorldSpec, root: Path) -> dict[str, Any]:
    tally = {"episodes": 0, "frames": 0, "successes": 0, "discarded": 0}
    with (
        simulators(config.processes, _start, env_config, config) as pool,
        Progress(transient=True) as progress,
    ):
        # The first episodes are already being simulated while LeRobot is imported.
        episodes = in_order(pool, _record_one, range(config.episodes), ahead=2 * config.processes)
        table = features(spec, env_config.state_size)
        with new_dataset(root, config.repo_id, spec.fps, env_config.type, table) as dataset:
            bar = progress.add_task("recording", total=config.episodes)
            for episode, discarded in episodes:
                for frame in frames(episode):
                    dataset.add_frame(frame)
                dataset.save_episode()
                tally["episodes"] += 1
                tally["frames"] += len(episode)
                tally["successes"] += episode.success
                tally["discarded"] += discarded
                progress.advance(bar)
    return tally


def features(spec: WorldSpec, environment_state: int) -> dict[str, dict[str, Any]]:
    """LeRobot's feature table for a world; reward, done and success under LeRobot's own names.

    Args:
        spec: of the world.
        environment_state: numbers of its ``observation.environment_state``; 0: it offers none.
    """
    table: dict[str, dict[str, Any]] = {
        key: {"dtype": "image", "shape": shape, "names": ["height", "width", "channels"]}
        for key, shape in spec.images.items()
    }
    vectors = {"observation.state": ("state", spec.state_dim), "action": ("action", spec.action_dim)}
    if environment_state:
        vectors[ENVIRONMENT_STATE] = ("environment_state", environment_state)
    for key, (name, size) in vectors.items():
        table[key] = {"dtype": "float32", "shape": (size,), "names": [f"{name}_{i}" for i in range(size)]}
    table[REWARD] = {"dtype": "float32", "shape": (1,), "names": None}
    table["next.done"] = {"dtype": "bool", "shape": (1,), "names": None}
    table[SUCCESS] = {"dtype": "bool", "shape": (1,), "names": None}
    return table


def frames(episode: Episode) -> Iterator[dict[str, Any]]:
    """The rows of `episode` as ``LeRobotDataset.add_frame`` takes them."""
    for t in range(len(episode)):
        yield {
            **{key: rows[t] for key, rows in episode.observations.items()},
            "action": episode.actions[t],
            REWARD: episode.rewards[t : t + 1],
            "next.done": np.array([episode.done and t == len(episode) - 1]),
            SUCCESS: np.array([episode.success and t >= episode.success_at]),
            "task": episode.task,
        }


_world: World
_env_config: EnvConfig
_config: DemosConfig


def _start(env_config: EnvConfig, config: DemosConfig) -> None:
    """Makes a worker process ready: one world for all its episodes."""
    global _world, _env_config, _config
    # The experts' gains are too high on purpose, and `play` clips.
    warnings.filterwarnings("ignore", message="Constant.s. may be too high", category=UserWarning)
    _world, _env_config, _config = make_world(env_config), env_config, config


def _record_one(slot: int) -> tuple[Episode, int]:
    """The episode at place `slot` of the dataset, and how many tries were thrown away for it."""
    tasks = _world.spec.tasks
    task, rank = tasks[slot % len(tasks)], slot // len(tasks)
    share = _config.failure_share
    fail = math.floor((rank + 1) * share) > math.floor(rank * share)
    for attempt in range(_MAX_TRIES):
        episode = play(
            _world,
            make_expert(_env_config, _world, task),
            task=task,
            seed=demo_seed(_config.seed, slot + attempt * _MAX_EPISODES),
            noise=_config.action_noise,
            push=_config.push,
            fail=fail,
        )
        if episode.success != fail or (_config.keep_failures and not fail):
            return episode, attempt
    raise InputError(
        "demos.failure_share" if fail else "demos.action_noise",
        share if fail else _config.action_noise,
        f"{_MAX_TRIES} tries of {task} in a row did not {'fail' if fail else 'succeed'}; "
        "lower it, or allow more env steps (env.max_steps)",
    )
