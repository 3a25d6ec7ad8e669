# SPDX-License-Identifier: Apache-2.0
"""Several inference replicas: which client asks which, and their statistics as of one.

Rollout worker i asks replica i modulo their number, so the requests of a worker are batched together.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from accerl_lerobot.inference.batcher import BatcherStats

LARGEST = ("wait_max_s", "swap_s", "publish_to_served_s")


def dealt(workers: int, replicas: int) -> list[int]:
    """Rollout workers of each replica."""
    return [len(range(index, workers, replicas)) for index in range(replicas)]


def merge_metrics(metrics: Sequence[dict[str, float]]) -> dict[str, float]:
    """Metrics as of one replica: sums of batches, means over batches and requests, the oldest version; {} for
    none."""
    if len(metrics) < 2:
        return dict(*metrics)
    batches = sum(m["batches"] for m in metrics)
    observations = [m["batches"] * m["batch_size_mean"] for m in metrics]
    asked = max(sum(observations), 1.0)
    waited = sum(m["wait_mean_s"] * n for m, n in zip(metrics, observations, strict=True))
    found = {
        "batches": batches,
        "batch_size_mean": sum(observations) / max(batches, 1.0),
        "wait_mean_s": waited / asked,
        "version": min(m["version"] for m in metrics),
        "busy_share": sum(m["busy_share"] for m in metrics) / len(metrics),
    }
    return found | {name: max(m[name] for m in metrics) for name in LARGEST}


def merge_stats(stats: Sequence[BatcherStats]) -> BatcherStats:
    """Batches as of one replica."""
    sizes: Counter[int] = sum((Counter(s.batch_sizes) for s in stats), Counter())
    return BatcherStats(
        batches=sum(s.batches for s in stats),
        requests=sum(s.requests for s in stats),
        observations=sum(s.observations for s in stats),
        batch_sizes=dict(sizes),
        wait_sum_s=sum(s.wait_sum_s for s in stats),
        wait_max_s=max(s.wait_max_s for s in stats),
        waits=sum((s.waits for s in stats), Counter()),
    )
