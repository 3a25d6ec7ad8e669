# SPDX-License-Identifier: Apache-2.0
"""Speed of our MetaWorld or LIBERO next to LeRobot's: both step random actions, in turns, on one machine.

Arms: ``ours`` (a picture per decision), ``ours_every_step`` (chunks of one, so a picture per step) and
``stock`` (LeRobot's own environment, a picture per step: of MetaWorld 480 pixels with default lights, of
LIBERO two of our size); of LIBERO also ``physics`` and ``stock_physics``, the loops alone, without pictures
and resets. Blocks go forth and back (A B C C B A), so that a machine that slows down slows every arm.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from typing import Annotated, Any

import draccus
import numpy as np
from rich.table import Table

from accerl_lerobot.config.ranges import Positive, Range, Repeats, Section
from accerl_lerobot.envs import EnvConfig, LiberoConfig, MetaWorldConfig, make_environment
from accerl_lerobot.envs.graphics import import_mujoco
from accerl_lerobot.envs.libero import load_libero
from accerl_lerobot.envs.libero_simulator import Simulator, liberos_own
from accerl_lerobot.errors import InputError
from accerl_lerobot.seeds import train_seed
from benchmarks.tables import as_table, host, ranged, spread

OURS, EVERY_STEP, STOCK = "ours", "ours_every_step", "stock"
PHYSICS, STOCK_PHYSICS = "physics", "stock_physics"
Decide = Callable[[], int]  # steps an environment for one decision and returns the number of env steps


@dataclass(frozen=True, kw_only=True)
class BenchEnvironmentConfig(Section):
    """Speed of our MetaWorld or LIBERO next to LeRobot's."""

    env: EnvConfig = field(default_factory=MetaWorldConfig)
    """One task of ``env.type=metaworld`` or ``libero``."""
    chunk: Annotated[int, Range("[1, 500]")] = 10
    """Actions per decision."""
    seconds: Positive = 4.0
    """Length of one block."""
    rounds: Repeats = 2
    """Times each arm is measured twice."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.env, MetaWorldConfig | LiberoConfig):
            raise InputError("env.type", self.env.type, "use metaworld or libero")
        if len(self.env.tasks) != 1:
            raise InputError("env.task", self.env.task, "name one task")

    @property
    def task(self) -> str:
        assert isinstance(self.env, MetaWorldConfig | LiberoConfig)
        return self.env.tasks[0]

    @property
    def arms(self) -> tuple[str, ...]:
        alone = (PHYSICS, STOCK_PHYSICS) if isinstance(self.env, LiberoConfig) else ()
        return (OURS, EVERY_STEP, STOCK, *alone)


def bench_environment(config: BenchEnvironmentConfig) -> dict[str, Any]:
    """Measures all arms.

    Returns: ``arms[name]`` with ``env_steps_per_s`` and ``decisions_per_s``, and ``ratio``, our env
    steps per second over LeRobot's, of the blocks' pairs, see `spread`; of LIBERO also ``physics_ratio``.
    """
    names = config.arms
    blocks: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
    with contextlib.ExitStack() as stack:
        # A process for each arm: two OpenGL contexts in one process disturb each other.
        spawn = multiprocessing.get_context("spawn")
        pools = {
            name: stack.enter_context(ProcessPoolExecutor(1, spawn, _start, (name, config))) for name in names
        }
        for name in (*names, *config.rounds * (*names, *reversed(names))):
            blocks[name].append(pools[name].submit(_measure, config.seconds).result())
        machine = pools[OURS].submit(_host).result()
    arms = {}
    for name, values in blocks.items():
        counted = zip(*values[1:], strict=True)  # the first warms up
        steps, decisions = (spread(list(rates)) for rates in counted)
        arms[name] = {"env_steps_per_s": steps, "decisions_per_s": decisions}

    def ratio(*of: str) -> dict[str, Any]:
        ours, stock = (arms[name]["env_steps_per_s"]["blocks"] for name in of)
        return spread([own / other for own, other in zip(ours, stock, strict=True)])

    chosen = {"task": config.task, "chunk": config.chunk, "env": draccus.encode(config.env, EnvConfig)}
    result = {"config": chosen, "arms": arms, "ratio": ratio(OURS, STOCK), "host": machine}
    return result | ({"physics_ratio": ratio(PHYSICS, STOCK_PHYSICS)} if PHYSICS in names else {})


def table(result: dict[str, Any]) -> Table:
    config, ratio = result["config"], result["ratio"]
    title = (
        f"{config['task']}, chunk {config['chunk']}: {ranged(ratio, '.1f')} times the env steps of LeRobot's"
    )
    if "physics_ratio" in result:
        title += f", physics alone {ranged(result['physics_ratio'], '.1f')} times"
    rows = [
        (name, *(ranged(rates[kind], ",.1f") for kind in ("env_steps_per_s", "decisions_per_s")))
        for name, rates in result["arms"].items()
    ]
    return as_table(title, ("arm", "env steps/s (range)", "decisions/s (range)"), rows)


_decide: Decide


def _start(arm: str, config: BenchEnvironmentConfig) -> None:
    global _decide
    chunk = config.chunk if arm == OURS else 1
    dims = make_environment(config.env).spec.action_dim  # no simulator is built before the first reset
    if arm == STOCK:
        del os.environ["LP_NUM_THREADS"]  # ours draws with one thread, LeRobot's by default with all
    actions = np.random.default_rng(0).uniform(-1, 1, (997, chunk, dims))
    chunks = itertools.cycle(actions.astype(np.float32))
    make = {STOCK: _stock, PHYSICS: _physics, STOCK_PHYSICS: _stock_physics}.get(arm, _ours)
    _decide = make(config, chunks)


def _ours(config: BenchEnvironmentConfig, chunks: Iterator[np.ndarray]) -> Decide:
    environment = make_environment(config.env)
    seeds = (train_seed(0, 0, episode) for episode in itertools.count())
    environment.reset(next(seeds), config.task)

    def decide() -> int:
        result = environment.step_chunk(next(chunks))
        if result.done:
            environment.reset(next(seeds), config.task)
        return result.steps

    return decide


def _stock(config: BenchEnvironmentConfig, chunks: Iterator[np.ndarray]) -> Decide:
    env, left = _stock_env(config.env, config.task), config.env.time_limit
    env.reset(seed=0)

    def decide() -> int:
        nonlocal left
        _, _, terminated, truncated, _ = env.step(next(chunks)[0])
        left -= 1
        if terminated and not isinstance(config.env, LiberoConfig):  # LeRobot's MetaWorld has reset itself
            left = config.env.time_limit
        elif terminated or truncated or not left:
            env.reset(seed=0)
            left = config.env.time_limit
        return 1

    return decide


def _physics(config: BenchEnvironmentConfig, chunks: Iterator[np.ndarray]) -> Decide:
    assert isinstance(config.env, LiberoConfig)
    simulator = Simulator(config.task, config.env.rendering, config.env.assets)
    simulator.reset(train_seed(0, 0, 0))
    return _put_back(config, simulator.env.sim, simulator.step, chunks)


def _stock_physics(config: BenchEnvironmentConfig, chunks: Iterator[np.ndarray]) -> Decide:
    assert isinstance(config.env, LiberoConfig)
    load_libero(config.env.assets)
    with contextlib.redirect_stdout(io.StringIO()):
        env = liberos_own(config.task)
        env.reset()
    return _put_back(config, env.env.sim, env.step, chunks)


def _put_back(
    config: BenchEnvironmentConfig, sim: Any, step: Callable[[np.ndarray], Any], chunks: Iterator[np.ndarray]
) -> Decide:
    """Steps robosuite's `sim` and puts it back where it began after each episode's time."""
    start, steps = sim.get_state(), itertools.count(1)

    def decide() -> int:
        step(next(chunks)[0])
        if next(steps) % config.env.time_limit == 0:
            sim.set_state(start)
        return 1

    return decide


def _stock_env(config: EnvConfig, task: str) -> Any:
    if isinstance(config, LiberoConfig):
        load_libero(config.assets)
        from lerobot.envs.libero import LiberoEnv
        from libero.libero import benchmark

        suite, number = task.split("/")
        size = {"observation_width": config.image_size, "observation_height": config.image_size}
        with contextlib.redirect_stdout(io.StringIO()):  # LIBERO prints, and the result goes there
            tasks = benchmark.get_benchmark_dict()[suite]()
            return LiberoEnv(tasks, int(number), suite, obs_type="pixels_agent_pos", **size)
    from lerobot.envs.metaworld import MetaworldEnv

    return MetaworldEnv(task, obs_type="pixels_agent_pos")


def _measure(seconds: float) -> tuple[float, float]:
    steps = decisions = 0
    start = now = time.perf_counter()
    while now - start < seconds:
        steps += _decide()
        decisions += 1
        now = time.perf_counter()
    return steps / (now - start), decisions / (now - start)


def _host() -> dict[str, Any]:
    return host() | {"mujoco": import_mujoco().__version__, "gl": os.environ.get("MUJOCO_GL", "")}
