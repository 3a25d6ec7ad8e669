# SPDX-License-Identifier: Apache-2.0
"""The policy's adapter as the workers of a run have it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from accerl_lerobot.algorithms import ChunkCriticConfig, OffPolicyConfig
from accerl_lerobot.checkpoint.layout import DEMOS
from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.demos.record import REPO_ID
from accerl_lerobot.policies.config import Load, PolicyConfig, loader

if TYPE_CHECKING:
    from accerl_lerobot.engines.config import RunConfig


def make_adapter(
    config: RunConfig,
    remembered: DatasetConfig | None,
    environment_state: int,
    load: Load | None,
    policy: PolicyConfig,
) -> Any:
    """The adapter of a policy, with the teacher and the demonstrations that the run's algorithm learns from.

    `remembered` is `demonstrations_of` the run; `environment_state` the number of numbers that the simulator
    tells; `load` loads the policy, None: a LeRobot checkpoint.
    """
    if isinstance(config.algorithm, ChunkCriticConfig):
        from accerl_lerobot.policies.teacher import with_teacher

        share = config.algorithm.teacher_episodes
        adapter: Any = with_teacher(loader(load), config.state_model, environment_state, share, policy)
    else:
        adapter = loader(load)(policy)
    if remembered is not None:
        from accerl_lerobot.algorithms.demonstrations import demonstrations

        adapter.demonstrations = partial(demonstrations, remembered, config.rollout.decision_cost)
    return adapter


def demonstrations_of(config: RunConfig) -> DatasetConfig | None:
    """The dataset that the run was given, or has recorded; None without one, or if nothing remembers it."""
    if not isinstance(config.algorithm, OffPolicyConfig):
        return None
    if config.dataset.repo_id is not None:
        root = config.dataset.root
        return replace(config.dataset, root=None if root is None else str(Path(root).expanduser().absolute()))
    if config.folder is None or not (config.folder / DEMOS).is_dir():
        return None
    return replace(config.dataset, repo_id=REPO_ID, root=str(config.folder / DEMOS))
