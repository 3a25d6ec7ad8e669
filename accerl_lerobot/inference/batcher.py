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

from accerl_lerobot.experience import Metrics


class Batcher[R: Sized]:
    """Gathers requests into batches; ``len(request)`` is the number of observations it carries.

    Moments are seconds on a monotonic clock, the same for all calls.
    """

    def __init__(self, max_batch: int, max_wait_s: float) -> None:
        self.max_batch = max_batch
        self.max_wait_s = max_wait_s
        self.counts = {"batches": 0.0, "requests": 0.0, "observations": 0.0, "waited_s": 0.0}
        """Served so far, and how long the requests had waited in sum."""
        self._waiting: deque[tuple[R, float]] = deque()
        self._observations = 0  # of the requests that wait
        self._environments = 0  # in lock step: observations that wait for each other; 0: none do
        self._of_round = 0  # in lock step: observations of a round that are not served yet

    def lock_step(self, environments: int) -> None:
        """From now on so many observations wait for each other; 0: none do."""
        self._environments = environments
        self._of_round = 0

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
        _, oldest = self._waiting[0]
        full = self._environments or self.max_batch
        if self._of_round or self._observations >= full:
            return oldest
        if self._environments:
            return None
        return oldest + self.max_wait_s

    def take(self, now: float) -> list[R]:
        """Remove the next batch, due or not: the oldest requests, as many as fit, at least one."""
        if self._environments and not self._of_round:
            self._of_round = self._observations
        most = min(self.max_batch, self._of_round or self.max_batch)
        batch: list[R] = []
        size = 0
        while self._waiting:
            request, since = self._waiting[0]
            if batch and size + len(request) > most:
                break
            self._waiting.popleft()
            batch.append(request)
            size += len(request)
            self.counts["waited_s"] += now - since
        self._observations -= size
        self._of_round = max(0, self._of_round - size)
        self.counts["batches"] += bool(batch)
        self.counts["requests"] += len(batch)
        self.counts["observations"] += size
        return batch


def merge_metrics(replicas: Sequence[Metrics]) -> Metrics:
    """Metrics for the log from those of each replica: `Batcher.counts`, its version and busy share.

    Means are over all batches and requests, 0 before the first; the version is the oldest. {} for no replica.
    """
    if not replicas:
        return {}
    totals = {name: sum(replica[name] for replica in replicas) for name in replicas[0]}
    return {
        "batches": totals["batches"],
        "batch_size_mean": totals["observations"] / max(totals["batches"], 1.0),
        "wait_mean_s": totals["waited_s"] / max(totals["requests"], 1.0),
        "version": min(replica["version"] for replica in replicas),
        "busy_share": totals["busy_share"] / len(replicas),
    }
