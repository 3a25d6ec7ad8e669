# SPDX-License-Identifier: Apache-2.0
"""Scripted experts in parallel processes, recorded as one LeRobotDataset.

Worker processes simulate and send arrays; the parent writes. An episode's seed follows from its place in the
dataset, so the content does not depend on how many processes worked on it.
"""

from __future__ import annotations

import itertools
import math
import multiprocessing
import os
import shutil
import signal
import threading
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from accerl_lerobot.config.machine import SIMULATOR_GIB, free_memory_gib
from accerl_lerobot.config.parsing import imported
from accerl_lerobot.config.ranges import Range, Section, Share
from accerl_lerobot.console import Console
from accerl_lerobot.envs import make_environment
from accerl_lerobot.envs.base import ChunkResult, EnvConfig, Environment, EnvironmentSpec
from accerl_lerobot.envs.metaworld import MetaWorld, expert_name
from accerl_lerobot.envs.simulated import SimulatedEnvironment
from accerl_lerobot.errors import InputError, check_absent, expanded
from accerl_lerobot.experience import ENVIRONMENT_STATE, REWARD, SUCCESS, Observation
from accerl_lerobot.seeds import demo_seed

REPO_ID = "accerl/demos"  # name of a recorded dataset, which is where its folder is

_MAX_EPISODES = 10_000
_MAX_TRIES = 50
MOST_PROCESSES = 8  # a container may see more cores than it has

Expert = Callable[[], np.ndarray]  # gives the next action for the state its environment is in

_DRIFT_MEMORY = 0.9
_DRIFT_SCALE = 0.5
_DRIFT_FROM = 60


@dataclass(kw_only=True)
class Episode:
    """One recorded episode; every array has one row per env step."""

    observations: dict[str, np.ndarray]  # before each step, under LeRobot's names
    actions: np.ndarray  # float32 (T, A), as executed: noise included, clipped to the environment's bounds
    rewards: np.ndarray
    successes: np.ndarray  # bool; True from the step on that achieved the task
    task: str
    done: bool

    @property
    def success(self) -> bool:
        return bool(self.successes[-1])

    def __len__(self) -> int:
        return len(self.rewards)


def make_expert(config: EnvConfig, environment: Environment, task: str) -> Expert:
    """The scripted expert of `task`, reading the simulator's own state."""
    if config.expert is None:
        names = ", ".join(name for name, kind in config.get_known_choices().items() if kind.expert)
        raise InputError("env.type", config.type, f"scripted experts exist for: {names}")
    expert: Expert = imported(config.expert)(environment, task)
    return expert


PlayedStep = tuple[Observation, np.ndarray, ChunkResult]
"""The observation before an env step, the action, and the outcome."""


def played(environment: Environment, task: str, seed: int, actions: Iterable[np.ndarray]) -> Episode:
    """Plays actions, float32 (A,), until they or the episode end; each is asked for when it is its turn."""
    observation = environment.reset(seed, task)
    steps: list[PlayedStep] = []
    for action in actions:
        result = environment.step_chunk(action[None])
        steps.append((observation, action, result))
        observation = result.observation
        if result.done:
            break
    return episode_of(steps)


def episode_of(steps: Sequence[PlayedStep]) -> Episode:
    """The episode that consists of these env steps."""
    seen, actions, results = zip(*steps, strict=True)
    return Episode(
        observations={key: np.stack([each[key] for each in seen]) for key in seen[0] if key != "task"},
        actions=np.stack(actions),
        rewards=np.concatenate([result.rewards for result in results]),
        successes=np.array([result.success for result in results]),
        task=str(seen[0]["task"]),
        done=results[-1].done,
    )


def disturbed(
    expert: Expert, spec: EnvironmentSpec, seed: int, *, noise: float, push: float, fail: bool
) -> Iterator[np.ndarray]:
    """Actions of an expert, without end; equal arguments give equal ones.

    With `fail`, actions are a random drift from a random early step on; for the others see `DemosConfig`.
    """
    rng = np.random.default_rng((seed, 1))
    push_rng = np.random.default_rng((seed, 2))
    low = spec.action_low
    high = spec.action_high
    direction = push_rng.standard_normal(spec.action_dim)
    pushed = push * push_rng.random() * direction / np.linalg.norm(direction)
    drift_from = spec.max_steps
    if fail:
        drift_from = int(rng.integers(0, _DRIFT_FROM))
    drift: np.ndarray = np.zeros(spec.action_dim)
    for step in itertools.count():
        if step < drift_from:
            action = np.asarray(expert(), np.float64)
            wanted = np.clip(action, low, high) + pushed
        else:
            drift = _DRIFT_MEMORY * drift + _DRIFT_SCALE * rng.standard_normal(len(drift))
            wanted = np.clip(drift, low, high)
        wanted = wanted + noise * rng.standard_normal(len(wanted))
        yield np.clip(wanted, low, high).astype(np.float32)


def metaworld_expert(environment: Environment, task: str) -> Expert:
    """MetaWorld's own policy for the task."""
    from metaworld import policies

    assert isinstance(environment, MetaWorld)
    # Its gains are too high on purpose, and `disturbed` clips.
    warnings.filterwarnings("ignore", message="Constant.s. may be too high", category=UserWarning)
    policy = getattr(policies, expert_name(task))()
    return lambda: policy.get_action(environment.simulator.everything())


def simulated_expert(environment: Environment, task: str) -> Expert:
    """Holds the action that solves the episode."""
    assert isinstance(environment, SimulatedEnvironment)
    return lambda: environment.solution


def check_instruction(spec: EnvironmentSpec, env_config: EnvConfig) -> None:
    """Refuses to record without an instruction where ``env.task`` is its text."""
    if not any(spec.instructions) and getattr(env_config, "task", None) == "":
        hint = "each frame of a dataset has an instruction, and the environment names none; give its text"
        raise InputError("env.task", "", f"{hint}, such as --env.task='Reach the goal'")


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
    try:
        yield partial
        partial.rename(root)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


@contextmanager
def simulated[Item, Result](
    env_config: EnvConfig, work: Callable[[Environment, Item], Result], items: Sequence[Item]
) -> Iterator[Iterator[Result]]:
    """Results of `work(environment, item)`, in the order of `items`, from processes with an environment each.

    Few finished ones wait in memory. An error inside ends the processes at once.
    """
    # Each process comes to hold a simulator of every task.
    tasks = getattr(env_config, "tasks", ("one",))
    each = len(tasks) * SIMULATOR_GIB.get(env_config.type, 0.1)
    fitting = free_memory_gib() / each
    cores = len(os.sched_getaffinity(0))
    processes = max(1, int(min(cores, MOST_PROCESSES, len(items), fitting)))
    before = set(multiprocessing.active_children())
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, context, initializer=_start, initargs=(env_config,)) as pool:

        def results() -> Iterator[Result]:
            waiting: deque[Future[Result]] = deque()
            for item in items:
                waiting.append(pool.submit(_worked, work, item))
                if len(waiting) > 2 * processes:
                    yield waiting.popleft().result()
            for future in waiting:
                yield future.result()

        try:
            yield results()
        except BaseException:
            for process in set(multiprocessing.active_children()) - before:
                process.kill()
            raise


def _worked[Item, Result](work: Callable[[Environment, Item], Result], item: Item) -> Result:
    return work(_environment, item)


_environment: Environment


def _start(env_config: EnvConfig) -> None:
    """Makes a process ready; Ctrl-C on the terminal is for its parent, which ends it."""
    global _environment
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _environment = make_environment(env_config)


def _end_with_parent() -> None:
    """Ends this process when its parent has been killed, which could not end it."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


@contextmanager
def new_dataset(
    root: Path,
    repo_id: str,
    spec: EnvironmentSpec,
    env_config: EnvConfig,
    more: Mapping[str, Any] | None = None,
) -> Iterator[Any]:
    """A LeRobotDataset to be filled, with `more` features; complete when the context has been left."""
    from datasets.utils.logging import disable_progress_bar
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    disable_progress_bar()  # a bar per episode would bury ours
    dataset = LeRobotDataset.create(
        repo_id,
        fps=spec.fps,
        features=features(spec) | dict(more or {}),
        root=root,
        robot_type=env_config.type,
        use_videos=False,
        video_backend="pyav",  # unused, but the default probes for FFmpeg and complains at length
    )
    yield dataset
    dataset.finalize()
    # The pictures are inside the parquet files; LeRobot leaves the folders they were collected in.
    shutil.rmtree(root / "images", ignore_errors=True)


@dataclass(frozen=True, kw_only=True)
class DemosConfig(Section, section="demos"):
    """Number of demonstrations, and their disturbance. They show the environment without ``env.shift``."""

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


def record_demos(
    env_config: EnvConfig, config: DemosConfig, root: str, seed: int = 0, console: Console | None = None
) -> Path:
    """Records demonstrations, disjoint ones for different seeds.

    The dataset appears at `root` only when it is complete.

    Returns:
        The dataset's folder; open it with ``LeRobotDataset(REPO_ID, root=...)``.
    """
    folder = check_free(root)
    console = console or Console()
    env_config = env_config.nominal()
    environment = make_environment(env_config)
    spec = environment.spec
    check_instruction(spec, env_config)
    for task in spec.tasks:
        make_expert(env_config, environment, task)  # refuses a task without an expert before any work
    environment.close()
    tally = {"episodes": 0, "frames": 0, "successes": 0}
    record = partial(record_one, env_config, config, seed)
    with (
        appearing(folder) as unfinished,
        simulated(env_config, record, range(config.episodes)) as episodes,
        console.stage("demonstrations", total=config.episodes) as stage,
        new_dataset(unfinished, REPO_ID, spec, env_config) as dataset,
    ):
        for episode in episodes:
            save_episode(dataset, episode, tally)
            stage.update(tally["episodes"])
    console.say("{episodes} episodes, {frames} frames, {successes} successes".format(**tally))
    return folder


def save_episode(
    dataset: Any, episode: Episode, tally: dict[str, int], more: Mapping[str, np.ndarray] | None = None
) -> None:
    """Adds an episode, with `more` features (T, 1), to a dataset and to a count."""
    last = len(episode) - 1
    columns = {**episode.observations, **(more or {}), "action": episode.actions}
    columns |= {REWARD: episode.rewards[:, None], SUCCESS: episode.successes[:, None]}
    for t in range(len(episode)):
        frame = {name: rows[t] for name, rows in columns.items()}
        frame["task"] = episode.task
        frame["next.done"] = np.array([episode.done and t == last])
        dataset.add_frame(frame)
    dataset.save_episode()
    tally["episodes"] += 1
    tally["frames"] += len(episode)
    tally["successes"] += episode.success


def features(spec: EnvironmentSpec) -> dict[str, dict[str, Any]]:
    """LeRobot's feature table for an environment; reward, done and success under LeRobot's own names."""
    table: dict[str, dict[str, Any]] = {
        key: {"dtype": "image", "shape": shape, "names": ["height", "width", "channels"]}
        for key, shape in spec.images.items()
    }
    vectors = {"observation.state": spec.state_dim, "action": spec.action_dim, REWARD: 1}
    if spec.environment_state_dim:
        vectors[ENVIRONMENT_STATE] = spec.environment_state_dim
    for key, size in vectors.items():
        table[key] = {"dtype": "float32", "shape": (size,), "names": None}
    for key in ("next.done", SUCCESS):
        table[key] = {"dtype": "bool", "shape": (1,), "names": None}
    return table


def record_one(
    env_config: EnvConfig, config: DemosConfig, seed: int, environment: Environment, slot: int
) -> Episode:
    """The episode at place `slot` of the dataset."""
    tasks = environment.spec.tasks
    share = config.failure_share
    task = tasks[slot % len(tasks)]
    rank = slot // len(tasks)
    fail = math.floor((rank + 1) * share) > math.floor(rank * share)
    for attempt in range(_MAX_TRIES):
        own_seed = demo_seed(seed, slot + attempt * _MAX_EPISODES)
        expert = make_expert(env_config, environment, task)
        actions = disturbed(
            expert, environment.spec, own_seed, noise=config.action_noise, push=config.push, fail=fail
        )
        episode = played(environment, task, own_seed, actions)
        if episode.success != fail or (config.push and not fail):
            return episode
    outcome = "fail" if fail else "succeed"
    hint = f"{_MAX_TRIES} tries of {task} in a row did not {outcome}; lower it"
    hint += ", or allow more env steps (env.max_steps)"
    if fail:
        raise InputError("demos.failure_share", share, hint)
    raise InputError("demos.action_noise", config.action_noise, hint)
