# SPDX-License-Identifier: Apache-2.0
"""Scripted experts in parallel processes, recorded as one LeRobotDataset.

Worker processes simulate and send arrays; the parent writes. An episode's seed follows from its place in the
dataset, so the content does not depend on how many processes worked on it.
"""

from __future__ import annotations

import collections
import concurrent.futures
import importlib.metadata
import json
import logging
import math
import multiprocessing
import shutil
import signal
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

import draccus
import numpy as np
from rich.progress import Progress

from accerl_lerobot import guardian
from accerl_lerobot.config.parsing import imported
from accerl_lerobot.config.ranges import Range, Section, Share
from accerl_lerobot.envs import make_world
from accerl_lerobot.envs.base import EnvConfig, World, WorldSpec
from accerl_lerobot.envs.metaworld import MetaWorld, expert_name, import_mujoco
from accerl_lerobot.envs.simulated import SimulatedWorld
from accerl_lerobot.errors import InputError, check_absent, expanded
from accerl_lerobot.experience import ENVIRONMENT_STATE, REWARD, SUCCESS, Observation
from accerl_lerobot.seeds import demo_seed

REPO_ID = "accerl/demos"
"""Name of a recorded dataset, which is where its folder is."""
SIDECAR = Path("meta") / "accerl_demos.json"
"""Inside the dataset: the two configs, what came of them, and the versions that decide on the physics."""

_logger = logging.getLogger(__name__)
_MAX_EPISODES = 10_000
_MAX_TRIES = 50
_VERSIONS = {name: name for name in ("lerobot", "metaworld", "robosuite", "mujoco", "numpy")}
_VERSIONS |= {"libero": "hf-libero"}
"""Module → distribution."""

Expert = Callable[[], np.ndarray]
"""Gives the next action for the state its world is in."""

_DRIFT_MEMORY = 0.9
_DRIFT_SCALE = 0.5
_DRIFT_FROM = 60


@dataclass(kw_only=True)
class Episode:
    """One recorded episode; every array has one row per env step."""

    observations: dict[str, np.ndarray]
    """Before each step, under LeRobot's names."""
    actions: np.ndarray
    """float32 (T, A), as executed: noise included, clipped to the world's bounds."""
    rewards: np.ndarray
    task: str
    done: bool
    success_at: int
    """Index of the first step after which the task was achieved; -1 for never."""
    seed: int

    @property
    def success(self) -> bool:
        return self.success_at >= 0

    def __len__(self) -> int:
        return len(self.rewards)


def make_expert(config: EnvConfig, world: World, task: str) -> Expert:
    """The scripted expert of `task`, reading the simulator's own state."""
    if config.expert is None:
        names = ", ".join(name for name, kind in config.get_known_choices().items() if kind.expert)
        raise InputError("env.type", config.type, f"scripted experts exist for: {names}")
    expert: Expert = imported(config.expert)(world, task)
    return expert


def play(
    world: World, expert: Expert, *, task: str, seed: int, noise: float, push: float, fail: bool
) -> Episode:
    """Plays one episode to its end; equal arguments give equal episodes.

    With `fail`, actions are a random drift from a random early step on; for the others see `DemosConfig`.
    """
    rng = np.random.default_rng((seed, 1))
    low, high = world.spec.action_low, world.spec.action_high
    pushed = _push(world.spec.action_dim, push, seed)
    drift_from = int(rng.integers(0, _DRIFT_FROM)) if fail else world.spec.max_steps
    drift: np.ndarray = np.zeros(world.spec.action_dim)
    observation, done, success_at = world.reset(seed, task), False, -1
    seen: list[Observation] = []
    actions: list[np.ndarray] = []
    rewards: list[float] = []
    while not done:
        if len(actions) < drift_from:
            wanted = np.clip(np.asarray(expert(), np.float64), low, high) + pushed
        else:
            drift = _DRIFT_MEMORY * drift + _DRIFT_SCALE * rng.standard_normal(len(drift))
            wanted = np.clip(drift, low, high)
        action = np.clip(wanted + noise * rng.standard_normal(len(wanted)), low, high).astype(np.float32)
        result = world.step_chunk(action[None])
        seen.append(observation)
        actions.append(action)
        rewards.append(result.rewards[0])
        if result.success and success_at < 0:
            success_at = len(actions) - 1
        observation, done = result.observation, result.done
    return Episode(
        observations={key: np.stack([row[key] for row in seen]) for key in seen[0] if key != "task"},
        actions=np.stack(actions),
        rewards=np.asarray(rewards, np.float32),
        task=str(seen[0]["task"]),
        done=done,
        success_at=success_at,
        seed=seed,
    )


def _push(size: int, longest: float, seed: int) -> np.ndarray:
    """In any direction, and of any length up to the longest."""
    rng = np.random.default_rng((seed, 2))
    direction = rng.standard_normal(size)
    pushed: np.ndarray = longest * rng.random() * direction / np.linalg.norm(direction)
    return pushed


def metaworld_expert(world: World, task: str) -> Expert:
    """MetaWorld's own policy for the task."""
    import_mujoco()
    from metaworld import policies

    assert isinstance(world, MetaWorld)
    policy = getattr(policies, expert_name(task))()
    return lambda: policy.get_action(world.raw_observation)


def simulated_expert(world: World, task: str) -> Expert:
    """Holds the action that solves the episode."""
    assert isinstance(world, SimulatedWorld)
    return lambda: world.solution


def check_free(root: str) -> Path:
    """The folder of a dataset that is to be written; an existing one is refused."""
    folder = expanded(root, "root")
    check_absent(folder, "root")
    return folder


@contextmanager
def appearing(root: Path) -> Iterator[Path]:
    """A folder to be filled, which becomes `root` when the context is left, or goes if there was an error."""
    partial = root.with_name(f"{root.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    guardian.remove(partial)
    try:
        yield partial
        partial.rename(root)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


@contextmanager
def simulators(
    processes: int, start: Callable[..., None], *arguments: Any
) -> Iterator[concurrent.futures.ProcessPoolExecutor]:
    """So many processes, each made ready by `start`; an error inside ends them at once."""
    context = multiprocessing.get_context("spawn")
    before = set(multiprocessing.active_children())
    with concurrent.futures.ProcessPoolExecutor(
        processes, context, initializer=_ready, initargs=(start, *arguments)
    ) as pool:
        try:
            yield pool
        except BaseException:
            for process in set(multiprocessing.active_children()) - before:
                process.kill()
            raise


def _ready(start: Callable[..., None], *arguments: Any) -> None:
    """Makes a process ready; Ctrl-C on the terminal is for its parent, which ends it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    start(*arguments)


def in_order[Item, Result](
    pool: concurrent.futures.Executor, work: Callable[[Item], Result], items: Iterable[Item], ahead: int
) -> Iterator[Result]:
    """Results of `work`, in the order of `items`, with at most `ahead` finished ones waiting in memory.

    The first are already under way when this returns.
    """
    left = iter(items)
    waiting = collections.deque(pool.submit(work, item) for item in islice(left, ahead))

    def results() -> Iterator[Result]:
        while waiting:
            result = waiting.popleft().result()
            waiting.extend(pool.submit(work, item) for item in islice(left, 1))
            yield result

    return results()


@contextmanager
def new_dataset(
    root: Path, repo_id: str, fps: int, robot_type: str, features: dict[str, Any]
) -> Iterator[Any]:
    """A LeRobotDataset to be filled; complete when the context has been left."""
    from datasets.utils.logging import disable_progress_bar
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    disable_progress_bar()  # one per episode would bury ours
    dataset = LeRobotDataset.create(
        repo_id,
        fps=fps,
        features=features,
        root=root,
        robot_type=robot_type,
        use_videos=False,
        video_backend="pyav",  # unused, but the default probes for FFmpeg and complains at length
    )
    yield dataset
    dataset.finalize()
    # The pictures are inside the parquet files; LeRobot leaves the folders they were collected in.
    shutil.rmtree(root / "images", ignore_errors=True)


@dataclass(frozen=True, kw_only=True)
class DemosConfig(Section, section="demos"):
    """How many demonstrations, and how disturbed."""

    episodes: Annotated[int, Range("[1, 10000]")] = 25
    """Episodes in the dataset; spread evenly over the tasks."""
    action_noise: Share = 0.1
    """Standard deviation of the Gaussian added to the expert's action before clipping. The noisy
    action is executed and recorded, so the dataset also shows how to recover."""
    push: Annotated[float, Range("[0, 2]")] = 0.0
    """Largest length of a constant vector, drawn anew for each episode, that is added to the expert's action
    before the noise. An expert that is pushed aside misses narrowly, as a policy does, and one that drifts
    does not; episodes that fail so are kept, for success and world models."""
    failure_share: Share = 0.0
    """Share of episodes that drift at random from early on and fail; for success and world models. Without a
    push, other episodes that fail are tried again with another seed."""
    shifted: bool = False
    """Apply ``env.shift`` to the demonstrations too; otherwise they show the world without it."""
    processes: Annotated[int, Range("[1, 64]")] = 2
    """Simulator processes; does not change the content."""


def record_demos(env_config: EnvConfig, config: DemosConfig, root: str, seed: int = 0) -> Path:
    """Records demonstrations, disjoint ones for different seeds.

    The dataset appears at `root` only when it is complete.

    Returns:
        The dataset's folder; open it with ``LeRobotDataset(REPO_ID, root=...)``.
    """
    folder = check_free(root)
    if not config.shifted:
        env_config = env_config.nominal()
    world = make_world(env_config)
    spec = world.spec
    for task in spec.tasks:
        make_expert(env_config, world, task)  # refuses a task without an expert before any work
    world.close()
    with appearing(folder) as partial:
        tally = _write(env_config, config, spec, partial, seed)
        sidecar = {
            "env": draccus.encode(env_config, EnvConfig),
            "demos": {k: v for k, v in draccus.encode(config).items() if k != "processes"} | {"seed": seed},
            **tally,
            "versions": {k: importlib.metadata.version(v) for k, v in _VERSIONS.items() if find_spec(k)},
        }
        (partial / SIDECAR).write_text(json.dumps(sidecar, indent=2) + "\n")
    _logger.info("%s: %s", folder, tally)
    return folder


def _write(
    env_config: EnvConfig, config: DemosConfig, spec: WorldSpec, root: Path, seed: int
) -> dict[str, Any]:
    tally = {"episodes": 0, "frames": 0, "successes": 0, "discarded": 0}
    with (
        simulators(config.processes, _start, env_config, config, seed) as pool,
        Progress(transient=True) as progress,
    ):
        # The first episodes are already being simulated while LeRobot is imported.
        episodes = in_order(pool, _record_one, range(config.episodes), ahead=2 * config.processes)
        table = features(spec, env_config.state_size)
        with new_dataset(root, REPO_ID, spec.fps, env_config.type, table) as dataset:
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

    `environment_state` is the size of its ``observation.environment_state``; 0: it offers none.
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
_seed: int


def _start(env_config: EnvConfig, config: DemosConfig, seed: int) -> None:
    """Makes a worker process ready: one world for all its episodes."""
    global _world, _env_config, _config, _seed
    # The experts' gains are too high on purpose, and `play` clips.
    warnings.filterwarnings("ignore", message="Constant.s. may be too high", category=UserWarning)
    _world, _env_config, _config, _seed = make_world(env_config), env_config, config, seed


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
            seed=demo_seed(_seed, slot + attempt * _MAX_EPISODES),
            noise=_config.action_noise,
            push=_config.push,
            fail=fail,
        )
        if episode.success != fail or (_config.push and not fail):
            return episode, attempt
    raise InputError(
        "demos.failure_share" if fail else "demos.action_noise",
        share if fail else _config.action_noise,
        f"{_MAX_TRIES} tries of {task} in a row did not {'fail' if fail else 'succeed'}; "
        "lower it, or allow more env steps (env.max_steps)",
    )
