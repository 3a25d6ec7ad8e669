# SPDX-License-Identifier: Apache-2.0
"""Observations for tiny policies, and stored decisions as the trainer sees them."""

import math
import pickle
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from torch import Tensor

from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import TASK, Request, Segment
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.config import PolicyConfig, SamplerConfig
from accerl_lerobot.policies.loading import load_adapter
from accerl_lerobot.rollout.runner import ActiveEpisode, EpisodePlan

TEXTS = ("Match the target", "Go", "Mirror the target slowly, then stay")  # a batch pads some of them


def requests(count: int, *, explore: bool = True, seed: int = 0, image: int = 32) -> list[Request]:
    rng = np.random.default_rng(seed)
    return [
        Request(
            observation={
                "observation.images.front": rng.integers(0, 256, (image, image, 3), dtype=np.uint8),
                "observation.state": rng.standard_normal(4, dtype=np.float32),
                TASK: TEXTS[i % len(TEXTS)],
            },
            noise_seed=1000 * seed + i,
            explore=explore,
        )
        for i in range(count)
    ]


def looking_back(count: int, *, explore: bool = True, image: int = 32) -> list[Request]:
    """Requests whose observations hold two env steps, unrelated ones."""
    asked = requests(count, explore=explore, image=image)
    for i, before in enumerate(requests(count, seed=7, image=image)):
        now = asked[i].observation
        seen = {key: np.stack([before.observation[key], now[key]]) for key in now if key != TASK}
        asked[i] = replace(asked[i], observation=now | seen)
    return asked


def adapter_at(path: Path | str, sampler: SamplerConfig | None = None, **options: Any) -> LeRobotAdapter:
    return load_adapter(PolicyConfig(path=str(path), device="cpu", sampler=sampler, **options))


def refused(path: Path | str, why: str, **options: Any) -> None:
    """Asserts that a policy is not loaded, in one line."""
    with pytest.raises(InputError, match=why) as caught:
        adapter_at(path, **options)
    assert "\n" not in str(caught.value)


def as_segment(asked: Sequence[Request], adapter: LeRobotAdapter, length: int) -> Segment:
    """Plays requests as one episode, in which each decision is made alone; it has been through a pickle."""
    plan = EpisodePlan(task="task", seed=0, explore=True)
    episode = ActiveEpisode(plan=plan, time_limit=100, observations=[asked[0].observation])
    for i in range(length):
        decision = adapter.decide([asked[i]], 3)[0]
        episode.add(decision, decision.chunk, 0.0, 3, asked[i + 1].observation)
    return pickle.loads(pickle.dumps(episode.cut("test")))


def deviation(one: Tensor, other: Tensor) -> float:
    """Difference of two means in units of its standard error."""
    error = math.sqrt(one.var().item() / len(one) + other.var().item() / len(other))
    return abs(one.mean().item() - other.mean().item()) / error
