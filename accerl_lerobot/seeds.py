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
"""Which seed is for what: demonstrations, training and evaluation never see the same episode.

MetaWorld and Gymnasium take seeds below 2**32; each use owns one range of them.
"""

from __future__ import annotations

import random
import sys
from typing import Any

import numpy as np

from accerl_lerobot.errors import InputError

DEMO_SEEDS = range(0, 1_000_000_000)
TRAIN_SEEDS = range(1_000_000_000, 2_000_000_000)
EVAL_SEEDS = range(2_000_000_000, 3_000_000_000)

_DEMOS_PER_RUN = 1_000_000
_WORKERS_PER_RUN = 1_000
_EPISODES_PER_WORKER = 10_000
_RUNS = 100
_ALL_SEEDS = 2**32
_DECISIONS_PER_EPISODE = 1_000_003


def demo_seed(run_seed: int, index: int) -> int:
    """Seed of the `index`-th demonstration tried by a recording with `run_seed`.

    Raises:
        InputError: `run_seed` is not in 0..999.
    """
    if not 0 <= run_seed < len(DEMO_SEEDS) // _DEMOS_PER_RUN:
        raise InputError("demos.seed", run_seed, "use 0 to 999")
    if not 0 <= index < _DEMOS_PER_RUN:
        raise ValueError(f"demonstration {index}: one recording has at most {_DEMOS_PER_RUN} tries")
    return DEMO_SEEDS.start + run_seed * _DEMOS_PER_RUN + index


def train_seed(run_seed: int, worker: int, episode: int) -> int:
    """Seed of a training episode; a worker starts over after 10,000 episodes.

    Raises:
        InputError: `run_seed` is not in 0..99.
    """
    if not 0 <= run_seed < _RUNS:
        raise InputError("seed", run_seed, f"use 0 to {_RUNS - 1}")
    if not 0 <= worker < _WORKERS_PER_RUN:
        raise ValueError(f"worker {worker}: a run has at most {_WORKERS_PER_RUN}")
    place = run_seed * _WORKERS_PER_RUN + worker
    return TRAIN_SEEDS.start + place * _EPISODES_PER_WORKER + episode % _EPISODES_PER_WORKER


def noise_seed(episode_seed: int, member: int, decision: int) -> int:
    """Seed of one decision's noise: of the episode and the decision, not of the slot or batch that runs it.

    Args:
        episode_seed: of the world, below 2**32.
        member: which of the episodes with this seed, where several start alike; else 0.
        decision: number within the episode, below 1,000,003.
    """
    return (member * _ALL_SEEDS + episode_seed) * _DECISIONS_PER_EPISODE + decision


def eval_seed(index: int) -> int:
    """Seed of the `index`-th evaluation episode, the same in every run, so that runs are paired."""
    if not 0 <= index < len(EVAL_SEEDS):
        raise ValueError(f"evaluation episode {index}: use 0 to {len(EVAL_SEEDS) - 1}")
    return EVAL_SEEDS.start + index


def global_generators() -> dict[str, Any]:
    """The states of the generators that libraries share: Python's, NumPy's, and torch's if it is in use."""
    states: dict[str, Any] = {"python": random.getstate(), "numpy": np.random.get_state()}
    if "torch" in sys.modules:
        import torch

        states["torch"] = torch.get_rng_state()
        states["cuda"] = torch.cuda.get_rng_state_all() if torch.cuda.is_available() else []
    return states


def restore_global_generators(states: dict[str, Any]) -> None:
    """Sets them to what `global_generators` gave."""
    random.setstate(states["python"])
    np.random.set_state(states["numpy"])
    if "torch" in states:
        import torch

        torch.set_rng_state(states["torch"])
        if torch.cuda.is_available() and len(states["cuda"]) == torch.cuda.device_count():
            torch.cuda.set_rng_state_all(states["cuda"])
