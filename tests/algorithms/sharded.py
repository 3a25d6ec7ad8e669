# SPDX-License-Identifier: Apache-2.0
"""Work of a test's ranks, in processes of their own; free of pytest, which they have no use for.

Results travel as snapshots: every rank writes its own, and the test reads them.
"""

from __future__ import annotations

import faulthandler
import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from accerl_lerobot.algorithms import AlgorithmConfig, GIPOConfig, PPOConfig, ranks
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.algorithms.ratio_update import RatioUpdate
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.experience import Segment
from tests.algorithms.linear import LinearAdapter, make_segments

TIMEOUT_S = 60.0
SHARDINGS = ("ddp", "zero3")


class Case(NamedTuple):
    """Some updates that one process and several are to make alike."""

    algorithm: AlgorithmConfig
    config: dict[str, Any]
    batches: list[list[Segment]]


def run(case: Case, config: TrainerConfig, state: Any = None) -> dict[str, Any]:
    """Makes the case's updates, those that `state` has not made; all that can be said of them."""
    adapter = LinearAdapter()
    if ranks.rank():  # as if it had been loaded otherwise there
        with torch.no_grad():
            for parameter in adapter.trainable().values():
                parameter.add_(1.0)
    update = RatioUpdate(adapter, case.algorithm, config)
    if state is not None:
        adapter.load_trainable(state["weights"])
        update.restore(state["update"])
    half, metrics = state, []
    for batch in case.batches[update.version :]:
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
        "whole": Case(GIPOConfig(), plain | shrunk | {"probe_every": 1}, uneven),
        "parts": Case(
            PPOConfig(kl_coef=0.1),
            plain | {"micro_batch": 2, "advantage_memory": 0.5, "probe_every": 1},
            uneven,
        ),
        "few": Case(PPOConfig(), plain | {"probe_every": 0}, few),
        "broken": Case(GIPOConfig(), plain | {"micro_batch": 3}, broken),
        "counted": Case(GIPOConfig(level="token"), plain | {"micro_batch": 2}, counted),
    }


def work(rank: int, size: int, place: Any, states: Path, results: Path) -> None:
    """One rank: every case, in every way of sharing, from the beginning and from one rank's state."""
    faulthandler.enable()
    torch.set_num_threads(1)
    join(rank, size, place)
    for name, case in cases().items():
        for sharding in SHARDINGS:
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
