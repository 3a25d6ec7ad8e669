# SPDX-License-Identifier: Apache-2.0
"""Time of an environment from a decision to its next observation, and of a reset, under random actions.

``python -m benchmarks async_vs_sync --traces=…`` measures what asynchrony gains with these times.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any

import numpy as np
from rich.table import Table

from accerl_lerobot.config.ranges import Range, Section, Seed
from accerl_lerobot.console import Console
from accerl_lerobot.envs import EnvConfig, Environment, MetaWorldConfig, make_environment
from accerl_lerobot.seeds import train_seed
from benchmarks.tables import as_table, host, output_folder

TRACE = "trace.txt"
RESET = "reset"  # first word of a trace's lines about resets
QUANTILES = (0.5, 0.95, 0.99)


@dataclass(frozen=True, kw_only=True)
class BenchLatencyConfig(Section):
    """Durations of an environment's decisions and resets."""

    env: EnvConfig = field(default_factory=MetaWorldConfig)
    """Any environment."""
    chunk: Annotated[int, Range("[1, 100000]")] = 10
    """Actions per decision."""
    decisions: Annotated[int, Range("[2, 1000000000]")] = 600
    """Decisions that are timed; a reset is timed where an episode ends among them."""
    seed: Seed = 0
    """Seed of the actions and episodes."""
    output_dir: str = "outputs/latency"
    """Folder for trace.txt, a duration on each line."""


def bench_latency(config: BenchLatencyConfig) -> dict[str, Any]:
    """Plays and times: ``decision_ms`` and ``reset_ms`` (None without any), see `described`; ``trace``."""
    console, root = Console(), output_folder(config.output_dir)
    environment = make_environment(config.env)
    try:
        with console.stage("decisions", total=config.decisions) as stage:
            lines = timed(environment, config, stage.update)
        tasks = ", ".join(environment.spec.tasks)
    finally:
        environment.close()
    decisions, resets = (np.asarray([s for s, reset in lines if reset is kind]) for kind in (False, True))
    result = {
        "decision_ms": described(decisions),
        "reset_ms": described(resets) if len(resets) else None,
        "trace": str(root / TRACE),
        "config": asdict(config),
        "host": host(),
    }
    text = "".join(f"{RESET + ' ' if reset else ''}{1000 * s:.4f}\n" for s, reset in lines)
    (root / TRACE).write_text(f"# {tasks}, chunks of {config.chunk}, ms\n{text}")
    console.say(f"wrote {root / TRACE}")
    return result


def timed(
    environment: Environment, config: BenchLatencyConfig, progress: Callable[[int], Any]
) -> list[tuple[float, bool]]:
    """Seconds of each decision and each reset between episodes, in order; True marks a reset."""
    rng, spec = np.random.default_rng(config.seed), environment.spec
    low, high = np.maximum(spec.action_low, -1), np.minimum(spec.action_high, 1)
    found: list[tuple[float, bool]] = []
    episodes = itertools.count()

    def reset() -> None:
        episode = next(episodes)
        environment.reset(train_seed(config.seed, 0, episode), spec.tasks[episode % len(spec.tasks)])

    reset()
    for made in range(1, config.decisions + 1):
        actions = rng.uniform(low, high, (config.chunk, spec.action_dim)).astype(np.float32)
        started = time.perf_counter()
        done = environment.step_chunk(actions).done
        ended = time.perf_counter()
        found.append((ended - started, False))
        if done:
            reset()
            found.append((time.perf_counter() - ended, True))
        progress(made)
    return found


def described(seconds: np.ndarray) -> dict[str, float]:
    """Mean, quantiles and maximum of durations (T,) in ms, coefficient of variation, and number."""
    return {
        "mean": 1000 * float(seconds.mean()),
        **{f"p{100 * q:.0f}": 1000 * float(np.quantile(seconds, q)) for q in QUANTILES},
        "longest": 1000 * float(seconds.max()),
        "cv": float(seconds.std() / seconds.mean()),
        "n": len(seconds),
    }


def table(result: dict[str, Any]) -> Table:
    columns = ("", "mean", "p50", "p95", "p99", "longest", "CV", "how many")
    rows = []
    for name in ("decision", "reset"):
        if (of := result[f"{name}_ms"]) is not None:
            durations = [f"{of[key]:.1f} ms" for key in ("mean", "p50", "p95", "p99", "longest")]
            rows.append([name, *durations, f"{of['cv']:.2f}", str(of["n"])])
    return as_table("from a decision to the next observation", columns, rows)
