# SPDX-License-Identifier: Apache-2.0
"""Batching: requests wait until a batch is full, or until the oldest of them has waited long enough.

Time is an argument, so tests need no clock. The wait of a batch starts with its *oldest* request: counting
from the newest would let a steady trickle postpone the answer forever. First in, first out: a request is
neither split nor reordered nor forgotten. In lock step, requests wait until there is one for every
environment, however long that takes, and are then served in as many batches as they need.

Of several inference replicas rollout worker i asks replica i modulo their number, so the requests of a worker
are batched together; their metrics are merged as of one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence, Sized


class Batcher[R: Sized]:
    """Gathers requests into batches; ``len(request)`` is the number of observations it carries.

    Moments are seconds on a monotonic clock, the same for all calls.
    """

    def __init__(self, max_batch: int, max_wait_s: float) -> None:
        self.max_batch, self.max_wait_s = max_batch, max_wait_s
        self._waiting: deque[tuple[R, float]] = deque()
        self._observations = 0
        self._together = self._left = 0
        self._batches = self._batched = self._served = 0  # batches; observations and requests in them
        self._wait_sum_s = 0.0

    def metrics(self) -> dict[str, float]:
        """Means for the log; 0 before the first batch."""
        return {
            "batches": float(self._batches),
            "batch_size_mean": self._batched / max(self._batches, 1),
            "wait_mean_s": self._wait_sum_s / max(self._served, 1),
        }

    def lock_step(self, observations: int) -> None:
        """From now on so many observations wait for each other; 0: none do."""
        self._together, self._left = observations, 0

    def __len__(self) -> int:
        return len(self._waiting)

    def add(self, request: R, now: float) -> None:
        """Queues a request, which holds an observation at least."""
        self._waiting.append((request, now))
        self._observations += len(request)

    def due(self, now: float) -> bool:
        deadline = self.next_deadline()
        return deadline is not None and now >= deadline

    def next_deadline(self) -> float | None:
        """When the next batch is due if nothing more arrives; in the past if it is full, None if it is empty
        or in lock step with others that are not here yet."""
        if not self._waiting:
            return None
        if self._together and not self._left:
            return self._waiting[0][1] if self._observations >= self._together else None
        full = self._left or self._observations >= self.max_batch
        return self._waiting[0][1] + (0.0 if full else self.max_wait_s)

    def take(self, now: float) -> list[R]:
        """Remove the next batch, due or not: the oldest requests, as many as fit, at least one."""
        batch: list[R] = []
        size = 0
        if self._together and not self._left:
            self._left = self._observations
        most = min(self.max_batch, self._left or self.max_batch)
        while self._waiting and (not batch or size + len(self._waiting[0][0]) <= most):
            request, since = self._waiting.popleft()
            batch.append(request)
            size += len(request)
            self._wait_sum_s += now - since
        self._observations -= size
        self._left = max(0, self._left - size)
        self._batches += bool(batch)
        self._batched += size
        self._served += len(batch)
        return batch


def merge_metrics(metrics: Sequence[dict[str, float]]) -> dict[str, float]:
    """Metrics as of one replica: sums of batches, means, the oldest version; {} for none."""
    if len(metrics) < 2:
        return dict(*metrics)
    batches = sum(m["batches"] for m in metrics)
    observations = [m["batches"] * m["batch_size_mean"] for m in metrics]
    waited = sum(m["wait_mean_s"] * n for m, n in zip(metrics, observations, strict=True))
    return {
        "batches": batches,
        "batch_size_mean": sum(observations) / max(batches, 1.0),
        "wait_mean_s": waited / max(sum(observations), 1.0),
        "version": min(m["version"] for m in metrics),
        "busy_share": sum(m["busy_share"] for m in metrics) / len(metrics),
    }
