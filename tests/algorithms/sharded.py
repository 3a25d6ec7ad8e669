# SPDX-License-Identifier: Apache-2.0
"""Work of a test's ranks, in processes of their own; free of pytest, which they have no use for.

Results travel as snapshots: every rank writes its own, and the test reads them.
"""

from __future__ import annotations

import faulthandler
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from accerl_lerobot.algorithms import AlgorithmConfig, GIPOConfig, PPOConfig, ranks
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.algorithms.ratio_update import RatioUpdate
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.experience import Segment
from accerl_lerobot.policies.adapter import Evaluation, PolicyAdapter
from tests.algorithms.linear import STATE, STD, LinearAdapter, make_segments

TIMEOUT_S = 60.0


class Layer(nn.Module):
    """Two linear layers around a norm."""

    def __init__(self, width: int, inner: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.up, self.down = nn.Linear(width, inner), nn.Linear(inner, width)

    def forward(self, x: Tensor, cache: Cache | None = None) -> Tensor:
        if cache is not None:
            cache.append(x)
        return x + self.down(torch.tanh(self.up(self.norm(x))))


class Cache(list[Tensor]):
    """Remembers what was put into it."""


class LayeredAdapter(LinearAdapter):
    """A policy with every way in which LeRobot's use their layers."""

    block_names = r"layers\.[01]|layers\.[23]\.(up|down)|frozen\.0"

    def __init__(self, seed: int = 0) -> None:
        super().__init__(seed)
        generator = torch.Generator().manual_seed(seed + 1)
        self.layers = nn.ModuleList(Layer(3, 5 + i) for i in range(4))
        self.tied = nn.ModuleList(nn.Linear(3, 3, bias=False) for _ in range(2))
        self.tied[1].weight = self.tied[0].weight
        self.read = nn.ModuleList([nn.Linear(3, 3)])
        self.frozen = nn.ModuleList([nn.Linear(3, 3).requires_grad_(False)])
        self.idle = nn.ModuleList([nn.Linear(3, 3)])
        with torch.no_grad():
            for parameter in self.parameters():
                if parameter is not self.weight:
                    parameter.copy_(0.4 * torch.randn(parameter.shape, generator=generator))

    def evaluate(
        self, observations: dict[str, np.ndarray], tasks: Sequence[str], latent: dict[str, Tensor]
    ) -> Evaluation:
        features = self.encode(torch.from_numpy(observations[STATE]))
        z = (latent["x"] - features @ self.weight.T) / STD
        value = self.value_head(features.detach())[:, 0]
        return Evaluation(log_prob=-0.5 * z * z, entropy=torch.zeros(len(z)), value=value)

    @torch.no_grad()
    def values(self, observations: dict[str, np.ndarray], tasks: Sequence[str]) -> Tensor:
        return self.value_head(self.encode(torch.from_numpy(observations[STATE])))[:, 0]

    def encode(self, x: Tensor) -> Tensor:
        called, again, inside, caching = self.layers
        x = self.frozen[0](called(x))
        for _ in range(3):  # as denoising steps do
            x = again(x)
        x = x + inside.down(torch.tanh(inside.up(inside.norm(x))))  # the layer itself is not called
        x = caching(x, Cache())
        x = self.tied[1](self.tied[0](x))
        return functional.linear(self.read[0](x), self.read[0].weight)

    def trainable(self) -> dict[str, nn.Parameter]:
        named = {k: p for k, p in self.named_parameters() if p.requires_grad}
        return {k if k.startswith("value_head.") else f"policy.{k}": p for k, p in named.items()}


class Case(NamedTuple):
    """Some updates that one process and several are to make alike."""

    adapter: Callable[[], PolicyAdapter]
    algorithm: AlgorithmConfig
    config: dict[str, Any]
    """Config of the trainer, apart from its ranks."""
    batches: list[list[Segment]]


def run(case: Case, config: TrainerConfig, state: Any = None) -> dict[str, Any]:
    """Makes the case's updates, those that `state` has not made; all that can be said of them."""
    adapter = case.adapter()
    if ranks.rank():  # as if it had been loaded otherwise there
        with torch.no_grad():
            for parameter in adapter.trainable().values():
                parameter.add_(1.0)
    update = RatioUpdate(adapter, case.algorithm, config)
    if state is not None:
        adapter.load_trainable(state["weights"])
        update.restore(state["update"])
    half, metrics = state, []
    for number, batch in enumerate(case.batches):
        if number < update.version:
            continue
        metrics.append(update.step(batch))
        if update.version == len(case.batches) // 2:
            half = {"weights": adapter.export_trainable(), "update": update.state()}
    return {"metrics": metrics, "weights": adapter.export_trainable(), "half": half}


def config_of(case: Case, sharding: str, size: int) -> TrainerConfig:
    return TrainerConfig(**case.config, ranks=size, sharding=sharding)


def cases() -> dict[str, Case]:
    """Between them: every mean over a batch, every copy of weights, every way of being uneven."""
    plain = {"updates": 100, "lr": 1e-2, "value_lr": 1e-2, "warmup_updates": 0, "value_warmup_updates": 1}
    uneven = [make_segments((3, 5, 1, 4), version=i, seed=i) for i in range(6)]
    for i, batch in enumerate(uneven):  # decisions of the versions that are probed
        for segment in batch:
            segment.version[:] = max(0, i - 2)
    broken = [make_segments((3, 5, 1, 4), seed=i) for i in range(6)]
    broken[1][2].reward[0] = broken[4][0].reward[1] = np.nan
    counted = [make_segments((2, 4, 3), seed=i) for i in range(6)]
    for batch in counted:
        for segment in batch:
            segment.latent["count"] = 1 + np.arange(len(segment)) % 2
    few = [make_segments((1,) * (1 + i % 3), seed=i) for i in range(6)]
    shrunk = {"grad_clip": 0.05}
    return {
        "whole": Case(LinearAdapter, GIPOConfig(), plain | shrunk | {"probe_every": 1}, uneven),
        "parts": Case(
            LinearAdapter,
            PPOConfig(kl_coef=0.1),
            plain | {"micro_batch": 2, "advantage_memory": 0.5, "probe_every": 1},
            uneven,
        ),
        "few": Case(LinearAdapter, PPOConfig(), plain | {"probe_every": 0}, few),
        "broken": Case(LinearAdapter, GIPOConfig(), plain | {"micro_batch": 3}, broken),
        "counted": Case(LinearAdapter, GIPOConfig(level="token"), plain | {"micro_batch": 2}, counted),
        "layers": Case(LayeredAdapter, GIPOConfig(), plain | {"micro_batch": 2, "probe_every": 1}, uneven),
        "forgetful": Case(LayeredAdapter, GIPOConfig(), plain | {"activation_checkpointing": True}, uneven),
    }


def shardings(name: str) -> tuple[str, ...]:
    """Ways of sharing in which a case is run; zero2 differs from zero3 for blocks only."""
    return ("ddp", "zero2", "zero3") if name == "layers" else ("ddp", "zero3")


def work(rank: int, size: int, place: Any, names: Sequence[str], states: Path, results: Path) -> None:
    """One rank: every named case, in every way of sharing, from the beginning and from one rank's state."""
    faulthandler.enable()
    torch.set_num_threads(1)
    join(rank, size, place)
    for name in names:
        case = cases()[name]
        for sharding in shardings(name):
            config = config_of(case, sharding, size)
            result = run(case, config)
            result["resumed"] = run(case, config, snapshot.load(states / name))
            snapshot.save(results / f"{name}-{sharding}-{rank}", result)
    leave()


def leave() -> None:
    """Ends a rank once all are done; at the interpreter's own end, threads of PyTorch may abort."""
    torch.distributed.barrier()
    torch.distributed.destroy_process_group()
    os._exit(0)


def join(rank: int, size: int, place: Any) -> None:
    """Become a rank of a group of `size`; the queue `place` tells where they meet."""
    ranks.use_only(ranks.LOOPBACK)
    if rank == 0:
        store, port = ranks.open_store(ranks.LOOPBACK, size, TIMEOUT_S)
        for _ in range(size - 1):
            place.put(port)
    else:
        store = ranks.store_at(ranks.LOOPBACK, place.get(), size, TIMEOUT_S)
    ranks.join(store, rank, size, torch.device("cpu"), TIMEOUT_S)
