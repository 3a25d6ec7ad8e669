# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""How long a world takes from a decision to its next observation, and what law that follows.

    accerl bench latency --env.type=metaworld --env.task=door-open-v3
    accerl bench async-vs-sync --traces='[outputs/latency/trace.txt]'

Random actions are played. Where an episode ends its last decision is charged with the reset as well: whoever
waits for the next observation waits for both. The second command says what asynchrony gains where many worlds
take turns at these durations.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from accerl_lerobot.bench.host import host
from accerl_lerobot.bench.study import as_markdown, as_table, write
from accerl_lerobot.console import Console
from accerl_lerobot.envs import EnvConfig, MetaWorldConfig, World, make_world
from accerl_lerobot.errors import InputError
from accerl_lerobot.evaluation.pictures import drawing
from accerl_lerobot.seeds import train_seed

TRACE = "trace.txt"
QUANTILES = (0.5, 0.95, 0.99)


@dataclass(frozen=True, kw_only=True)
class BenchLatencyConfig:
    """What is timed, for how long."""

    env: EnvConfig = field(default_factory=MetaWorldConfig)
    """Any world."""
    chunk: int = 10
    """Actions per decision, at least 1."""
    decisions: int = 600
    """Timed, at least 2; more than an episode has, or no reset is among them."""
    seed: int = 0
    """Of the actions and episodes, 0 to 99."""
    output_dir: str = "outputs/latency"
    """Folder for trace.txt (one duration on each line, in milliseconds), latency.json, .md and .png."""

    def __post_init__(self) -> None:
        if self.chunk < 1:
            raise InputError("chunk", self.chunk, "use at least 1")
        if self.decisions < 2:
            raise InputError("decisions", self.decisions, "use at least 2")
        train_seed(self.seed, 0, 0)


def bench_latency(config: BenchLatencyConfig) -> dict[str, Any]:
    """Plays and times.

    Returns:
        ``latency_ms`` (``mean``, ``p50``, ``p95``, ``p99``, ``max``), ``cv`` (standard deviation over mean),
        ``resets`` (how many), ``reset_share`` (of all time: what their decisions took longer than the others'
        mean), ``neighbours`` (correlation of one duration with the next), ``trace`` (the file), ``config``
        and ``host``.
    """
    console, root = Console(), Path(config.output_dir)
    root.mkdir(parents=True, exist_ok=True)
    world = make_world(config.env)
    try:
        with console.stage("decisions", total=config.decisions) as stage:
            seconds, ends = timed(world, config, stage.update)
    finally:
        world.close()
    result = described(seconds, ends) | {
        "trace": str(root / TRACE),
        "config": asdict(config),
        "host": host(),
    }
    lines = [
        f"{1000 * s:.4f}{'  # and a reset' if end else ''}\n" for s, end in zip(seconds, ends, strict=True)
    ]
    (root / TRACE).write_text(
        f"# {type(config.env).__name__}, chunks of {config.chunk}, ms\n" + "".join(lines)
    )
    write(
        root,
        "latency",
        result,
        as_markdown(_COLUMNS, _rows(result)),
        lambda path, _: draw(path, seconds, ends),
    )
    console.say(f"wrote {TRACE}, latency.json, .md and .png into {root}")
    return result


def timed(world: World, config: BenchLatencyConfig, progress: Any) -> tuple[np.ndarray, np.ndarray]:
    """Seconds of each decision, float64 (T,), and whether an episode ended with it, bool (T,).

    The first episode's reset, in which much is built, is not timed.
    """
    rng, spec = np.random.default_rng(config.seed), world.spec
    seconds, ends = np.zeros(config.decisions), np.zeros(config.decisions, bool)
    episode = 0

    def reset() -> None:
        nonlocal episode
        world.reset(train_seed(config.seed, 0, episode), spec.tasks[episode % len(spec.tasks)])
        episode += 1

    reset()
    for i in range(config.decisions):
        low, high = np.maximum(spec.action_low, -1), np.minimum(spec.action_high, 1)
        actions = rng.uniform(low, high, (config.chunk, spec.action_dim)).astype(np.float32)
        started = time.perf_counter()
        if world.step_chunk(actions).done:
            reset()
            ends[i] = True
        seconds[i] = time.perf_counter() - started
        progress(i + 1)
    return seconds, ends


def described(seconds: np.ndarray, ends: np.ndarray) -> dict[str, Any]:
    """The law of these durations; see `bench_latency`."""
    usual = seconds[~ends].mean() if (~ends).any() else 0.0
    # Of durations that are all alike there is no correlation.
    one, other = seconds[:-1], seconds[1:]
    varied = len(one) > 1 and one.std() > 0 and other.std() > 0
    return {
        "latency_ms": {
            "mean": 1000 * float(seconds.mean()),
            **{f"p{100 * q:.0f}": 1000 * float(np.quantile(seconds, q)) for q in QUANTILES},
            "max": 1000 * float(seconds.max()),
        },
        "cv": float(seconds.std() / seconds.mean()),
        "resets": int(ends.sum()),
        "reset_share": float((seconds[ends] - usual).sum() / seconds.sum()),
        "neighbours": float(np.corrcoef(one, other)[0, 1]) if varied else None,
    }


def table(result: dict[str, Any]) -> Table:
    """`result` for people."""
    return as_table("from a decision to the next observation", _COLUMNS, _rows(result))


def draw(path: Path, seconds: np.ndarray, ends: np.ndarray) -> None:
    """Each duration in its place, those with a reset apart."""
    place = np.arange(len(seconds))
    with drawing(path) as axes:
        for shown, label in ((~ends, "decision"), (ends, "with a reset")):
            axes.scatter(place[shown], 1000 * seconds[shown], s=8, label=label, linewidths=0)
        axes.set(xlabel="decision", ylabel="ms to the next observation")
        axes.set_ylim(bottom=0)
        axes.legend()


_COLUMNS = ("mean", "p50", "p95", "p99", "longest", "CV", "resets", "their share")


def _rows(result: dict[str, Any]) -> list[list[str]]:
    durations = [f"{ms:.1f} ms" for ms in result["latency_ms"].values()]
    return [[*durations, f"{result['cv']:.2f}", str(result["resets"]), f"{result['reset_share']:.0%}"]]
