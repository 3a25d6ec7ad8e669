# SPDX-License-Identifier: Apache-2.0
"""Cost of a checkpoint's decisions and steps: with its own likelihood, and as a policy of any type.

A type without a likelihood has the second column alone. The two take turns, so a busy machine slows both.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Annotated, Any

from rich.table import Table

from accerl_lerobot.config.ranges import Range, Repeats, Section
from accerl_lerobot.policies.config import POLICIES, ChunkNoiseConfig, PolicyConfig
from benchmarks.tables import as_table, host, ranged, spread

OWN, ANY = "own likelihood", "chunk_noise"


@dataclass(frozen=True, kw_only=True)
class BenchSamplersConfig(Section):
    """Decisions and steps of a checkpoint."""

    policy: PolicyConfig = field(default_factory=PolicyConfig)
    """The checkpoint."""
    environments: Annotated[int, Range("[1, 1024]")] = 8
    """Environments that are decided for together."""
    batch: Annotated[int, Range("[1, 65536]")] = 64
    """Rows of a step."""
    repeats: Repeats = 20
    """Times each part is measured after a first one that does not count."""


def bench_samplers(config: BenchSamplersConfig) -> dict[str, Any]:
    """Decides for one environment, for several, and makes a step of LeRobot's imitation loss.

    Returns:
        ``seconds``, sampler → part → median, range and all of ``decide_one``, ``decide`` and ``step``;
        ``ratio``, part → the second sampler's median by the first one's, where there are two; ``type``,
        ``config`` and ``host``.
    """
    from accerl_lerobot.policies.loading import load_adapter, load_lerobot_config

    kind = load_lerobot_config(config.policy).type
    adapters = {ANY: load_adapter(replace(config.policy, sampler=ChunkNoiseConfig()))}
    if kind in POLICIES:
        adapters = {OWN: load_adapter(config.policy)} | adapters
    works = {name: _parts(adapter, config) for name, adapter in adapters.items()}
    times: dict[str, dict[str, list[float]]] = {
        name: {part: [] for part in parts} for name, parts in works.items()
    }
    for repeat in range(config.repeats + 1):
        for name, parts in works.items():
            for part, work in parts.items():
                began = time.perf_counter()
                work()
                if repeat:
                    times[name][part].append(time.perf_counter() - began)
    seconds = {name: {part: spread(each) for part, each in parts.items()} for name, parts in times.items()}
    ratio: dict[str, float] = {}
    if OWN in seconds:
        own, any_type = seconds[OWN], seconds[ANY]
        ratio = {part: any_type[part]["median"] / own[part]["median"] for part in own}
    return {"type": kind, "seconds": seconds, "ratio": ratio, "config": asdict(config), "host": host()}


def table(result: dict[str, Any]) -> Table:
    rows = []
    for part in ("decide_one", "decide", "step"):
        cells = [ranged(parts[part], ".4f") for parts in result["seconds"].values()]
        if result["ratio"]:
            cells.append(f"{result['ratio'][part]:.2f}")
        rows.append((part, *cells))
    columns = ["part", *(f"{name}, s" for name in result["seconds"])]
    if result["ratio"]:
        columns.append("ratio")
    return as_table(f"{result['type']}: median (range)", columns, rows)


def _parts(adapter: Any, config: BenchSamplersConfig) -> dict[str, Callable[[], Any]]:
    import torch

    from accerl_lerobot.experience import stack_observations

    examples = adapter.example_requests()
    requests = [
        replace(examples[i % len(examples)], noise_seed=i)
        for i in range(max(config.environments, config.batch))
    ]
    observations, tasks = stack_observations(requests[: config.batch])
    shape = adapter.decide(requests[:1], 0)[0].chunk.shape
    chunk = torch.zeros(config.batch, *shape, device=adapter.device)
    trained = list(adapter.trainable().values())
    optimizer = torch.optim.AdamW(trained, lr=1e-6, fused=True)

    def step() -> None:
        optimizer.zero_grad(set_to_none=True)
        with adapter.autocast():
            loss = adapter.imitate(observations, tasks, chunk)[0].mean()
        loss.backward()
        optimizer.step()
        float(loss.detach())  # waits for a GPU

    return {
        "decide_one": lambda: adapter.decide(requests[:1], 0),
        "decide": lambda: adapter.decide(requests[: config.environments], 0),
        "step": step,
    }
