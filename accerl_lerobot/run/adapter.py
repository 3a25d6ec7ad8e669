# SPDX-License-Identifier: Apache-2.0
"""The policy's adapter as the workers of a run have it, and as ``accerl offline`` has it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from accerl_lerobot.algorithms import AlgorithmConfig, ChunkCriticConfig, OffPolicyConfig
from accerl_lerobot.algorithms.demonstrations import demonstrations
from accerl_lerobot.checkpoint.layout import DEMOS
from accerl_lerobot.demos.record import REPO_ID
from accerl_lerobot.experience import Segment
from accerl_lerobot.policies.config import Load, PolicyConfig, loader
from accerl_lerobot.world_model.config import StateModelConfig

if TYPE_CHECKING:
    from accerl_lerobot.engines.config import RunConfig

Reader = Callable[[Segment], Iterator[Segment]]
"""Reads demonstrations with the names and shapes of an explored segment; see `algorithms.demonstrations`."""


def make_adapter(
    algorithm: AlgorithmConfig,
    state_model: StateModelConfig,
    environment_state: int,
    remembered: Reader | None,
    load: Load | None,
    policy: PolicyConfig,
) -> Any:
    """The adapter of a policy, with the teacher and the demonstrations that the algorithm learns from.

    `environment_state` is the number of numbers that the simulator tells; `remembered` is `demonstrations_of`
    the run; `load` loads the policy, None: a LeRobot checkpoint.
    """
    if isinstance(algorithm, ChunkCriticConfig):
        from accerl_lerobot.policies.teacher import with_teacher

        share = algorithm.teacher_episodes
        adapter: Any = with_teacher(loader(load), state_model, environment_state, share, policy)
    else:
        adapter = loader(load)(policy)
    if remembered is not None:
        adapter.demonstrations = remembered
    return adapter


def demonstrations_of(config: RunConfig) -> Reader | None:
    """The dataset that the run was given, or has recorded; None without one, or if nothing remembers it."""
    if not isinstance(config.algorithm, OffPolicyConfig):
        return None
    dataset = config.dataset
    root = dataset.root
    if dataset.repo_id is None:
        if config.folder is None or not (config.folder / DEMOS).is_dir():
            return None
        dataset = replace(dataset, repo_id=REPO_ID)
        root = str(config.folder / DEMOS)
    elif root is not None:
        root = str(Path(root).expanduser().absolute())
    return partial(demonstrations, replace(dataset, root=root), config.rollout.decision_cost)
