# SPDX-License-Identifier: Apache-2.0
"""Seeds of demonstrations, training and evaluation, which never share an episode.

MetaWorld and Gymnasium take seeds below 2**32; each use owns one range of them. A run may have any seed.
"""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

DEMO_SEEDS = range(0, 1_000_000_000)
TRAIN_SEEDS = range(1_000_000_000, 2_000_000_000)
EVAL_SEEDS = range(2_000_000_000, 3_000_000_000)

_WORKERS_PER_RUN = 1_000  # the limit of `rollout.workers`
_PRIME = 999_999_937  # the largest below 10**9, the size of a range
_EVALUATIONS_PER_RUN = 10_000  # the limit of `evaluation.episodes`
_DECISIONS_PER_EPISODE = 1_000_003


def demo_seed(run_seed: int, index: int) -> int:
    """Seed of the `index`-th demonstration tried by a recording with `run_seed`."""
    return _permuted(DEMO_SEEDS, run_seed, index)


def train_seed(run_seed: int, worker: int, episode: int) -> int:
    """Seed of a training episode; no two of a run are equal before a worker's 999,999th."""
    return _permuted(TRAIN_SEEDS, run_seed, episode * _WORKERS_PER_RUN + worker)


def _permuted(seeds: range, run_seed: int, index: int) -> int:
    """The `index`-th of `seeds` in an order of the run's own.

    Indices below the prime p have different seeds, as i → a·i + b mod p is a permutation; a and b are drawn
    from a hash of the use and the run's seed, so that the orders of different runs have nothing in common.
    """
    drawn = np.random.SeedSequence((seeds.start, run_seed)).generate_state(2, np.uint64)
    a = 1 + int(drawn[0]) % (_PRIME - 1)
    b = int(drawn[1])
    return seeds.start + (a * index + b) % _PRIME


def noise_seed(episode_seed: int, decision: int) -> int:
    """Seed of one decision's noise: of the episode and the decision, not of the slot or batch."""
    return episode_seed * _DECISIONS_PER_EPISODE + decision


def episode_of(noise_seed: int) -> int:
    return noise_seed // _DECISIONS_PER_EPISODE


def decision_of(noise_seed: int) -> int:
    return noise_seed % _DECISIONS_PER_EPISODE


def eval_seed(run_seed: int, index: int) -> int:
    """Seed of the `index`-th evaluation episode of a task.

    Runs of the same seed are evaluated on the same episodes and can be compared by pairs. Runs of different
    seeds below 100,000 are evaluated on different ones, so that results over seeds do not share their luck.
    """
    place = run_seed * _EVALUATIONS_PER_RUN + index
    return EVAL_SEEDS.start + place % len(EVAL_SEEDS)


@contextmanager
def torch_seeded(seed: int, devices: Any = None) -> Iterator[None]:
    """Torch's generators begin with this seed in the context, and go on as before afterwards.

    `devices` are the GPUs whose generators do so too; None: all, and ``()``: none, so that none is looked at.
    """
    import torch

    with torch.random.fork_rng(devices):
        torch.manual_seed(seed % 2**63)
        yield


def global_generators() -> dict[str, Any]:
    """The states of the generators that libraries share: Python's, NumPy's and torch's."""
    import torch

    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),
        "torch": torch.get_rng_state(),
        # There may be a GPU that torch cannot use.
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
    }


def restore_global_generators(states: dict[str, Any]) -> None:
    import torch

    random.setstate(states["python"])
    np.random.set_state(states["numpy"])
    torch.set_rng_state(states["torch"])
    if torch.cuda.is_available() and len(states["cuda"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all(states["cuda"])
