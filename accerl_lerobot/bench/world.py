# SPDX-License-Identifier: Apache-2.0
"""Speed of our MetaWorld next to LeRobot's: both step random actions, in turns, on the same machine.

Three arms: ``ours`` (a picture per decision), ``ours_every_step`` (chunks of one, so a picture per step) and
``stock`` (LeRobot's own wrapper: 480 pixels, default lights, a picture per step). Blocks go forth and back
(A B C C B A), so that a machine that slows down slows every arm.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import numpy as np
from rich.table import Table

from accerl_lerobot.bench.host import as_table, host, ranged, spread
from accerl_lerobot.config.ranges import Positive, Range, Repeats, Section
from accerl_lerobot.demos.writing import simulators
from accerl_lerobot.envs.metaworld import ACTION_DIM, MetaWorld, MetaWorldConfig, import_mujoco
from accerl_lerobot.errors import InputError
from accerl_lerobot.seeds import train_seed

OURS, EVERY_STEP, STOCK = "ours", "ours_every_step", "stock"
_ARMS = (OURS, EVERY_STEP, STOCK)
Decide = Callable[[], int]
"""Steps an environment for one decision and returns the number of env steps."""


@dataclass(frozen=True, kw_only=True)
class BenchWorldConfig(Section):
    """Fields of ``accerl bench world``."""

    task: str = "drawer-open-v3"
    """One MetaWorld task."""
    chunk: Annotated[int, Range("[1, 500]")] = 10
    """Actions per decision."""
    image_size: Annotated[int, Range("[64, 480]")] = 64
    """Our pictures' height and width in pixels; LeRobot's wrapper always draws 480."""
    seconds: Positive = 4.0
    """Length of one block."""
    rounds: Repeats = 2
    """Times each arm is measured twice."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.env.tasks) != 1:
            raise InputError("task", self.task, "name one task")

    @property
    def env(self) -> MetaWorldConfig:
        """Our world."""
        return MetaWorldConfig(task=self.task, image_size=self.image_size)


def bench_world(config: BenchWorldConfig) -> dict[str, Any]:
    """Measures all three arms.

    Returns:
        ``arms[name]`` with ``env_steps_per_s`` and ``decisions_per_s``, each median, min, max and blocks;
        ``ratio``, our env steps per second over LeRobot's, median of the blocks' pairs and their range;
        ``config`` and ``host``.
    """
    blocks: dict[str, list[tuple[float, float]]] = {name: [] for name in _ARMS}
    with contextlib.ExitStack() as stack:
        # A process for each arm: two OpenGL contexts in one process disturb each other.
        pools = {name: stack.enter_context(simulators(1, _start, name, config)) for name in _ARMS}
        for name in (*_ARMS, *config.rounds * (*_ARMS, *reversed(_ARMS))):
            blocks[name].append(pools[name].submit(_measure, config.seconds).result())
        machine = pools[OURS].submit(_host).result()
    arms = {}
    for name, values in blocks.items():
        steps, decisions = (
            spread(list(rates)) for rates in zip(*values[1:], strict=True)
        )  # the first: warm-up
        arms[name] = {"env_steps_per_s": steps, "decisions_per_s": decisions}
    ours, stock = (arms[name]["env_steps_per_s"]["blocks"] for name in (OURS, STOCK))
    ratio = spread([own / other for own, other in zip(ours, stock, strict=True)])
    return {"config": asdict(config), "arms": arms, "ratio": ratio, "host": machine}


def table(result: dict[str, Any]) -> Table:
    """`result` for people."""
    config, ratio = result["config"], result["ratio"]
    title = (
        f"{config['task']}, chunk {config['chunk']}: {ranged(ratio, '.0f')} times the env steps of LeRobot's"
    )
    rows = [
        (name, *(ranged(rates[kind], ",.1f") for kind in ("env_steps_per_s", "decisions_per_s")))
        for name, rates in result["arms"].items()
    ]
    return as_table(title, ("arm", "env steps/s (range)", "decisions/s (range)"), rows)


_decide: Decide


def _start(arm: str, config: BenchWorldConfig) -> None:
    """Makes a process ready to measure one arm."""
    global _decide
    import_mujoco()
    if arm == STOCK:
        del os.environ["LP_NUM_THREADS"]  # ours draws with one thread, LeRobot's by default with all
    chunk = config.chunk if arm == OURS else 1
    actions = np.random.default_rng(0).uniform(-1, 1, (997, chunk, ACTION_DIM)).astype(np.float32)
    _decide = _stock(config.task, actions) if arm == STOCK else _ours(config, actions)


def _ours(config: BenchWorldConfig, actions: np.ndarray) -> Decide:
    world = MetaWorld(config.env)
    seeds = (train_seed(0, 0, episode) for episode in itertools.count())
    chunks = itertools.cycle(actions)
    world.reset(next(seeds), config.task)

    def decide() -> int:
        result = world.step_chunk(next(chunks))
        if result.done:
            world.reset(next(seeds), config.task)
        return result.steps

    return decide


def _stock(task: str, actions: np.ndarray) -> Decide:
    from lerobot.envs.metaworld import MetaworldEnv

    env = MetaworldEnv(task, obs_type="pixels_agent_pos")
    chunks = itertools.cycle(actions)
    env.reset(seed=0)

    def decide() -> int:
        _, _, terminated, truncated, _ = env.step(next(chunks)[0])
        if truncated and not terminated:  # it resets itself after a termination
            env.reset()
        return 1

    return decide


def _measure(seconds: float) -> tuple[float, float]:
    """Env steps and decisions a second."""
    steps = decisions = 0
    start = now = time.perf_counter()
    while now - start < seconds:
        steps += _decide()
        decisions += 1
        now = time.perf_counter()
    return steps / (now - start), decisions / (now - start)


def _host() -> dict[str, Any]:
    return host() | {"mujoco": import_mujoco().__version__, "gl": os.environ.get("MUJOCO_GL", "")}
