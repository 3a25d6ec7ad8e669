# SPDX-License-Identifier: Apache-2.0
"""How stale the samples of a recipe can be: the arguments that `replay.pacing` needs, from a run's config."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

from accerl_lerobot.replay.pacing import decisions_under_way, lag_bound

if TYPE_CHECKING:
    from accerl_lerobot.engine.config import RunConfig


def lag_limits(config: RunConfig) -> tuple[int, int]:
    """The largest lag under this recipe, and what its pace alone would allow; in updates."""
    trainer = config.trainer
    ahead = 1 if config.launch.engine == "ray" else 0  # of publications under way, and of batches drawn early
    bound, of_pace = (
        lag_bound(
            replay,
            batch_decisions=trainer.batch_decisions,
            in_flight=under_way(config),
            publish_every=trainer.publish_every,
            pickup=ahead + trainer.hold_back,
            prefetch=ahead,
        )
        for replay in (config.replay, dataclasses.replace(config.replay, max_lag=10**9))
    )
    return bound, of_pace


def under_way(config: RunConfig) -> int:
    """Decisions on their way to replay; an unknown chunk counts as one action, the worst case."""
    rollout = config.rollout
    return decisions_under_way(
        workers=rollout.workers,
        worlds=rollout.worlds,
        segment_length=rollout.segment_length,
        group_size=rollout.group_size,
        episode_decisions=math.ceil(config.env.max_steps / (executed(config) or 1)),
    )


def executed(config: RunConfig) -> int:
    """Actions of a chunk that are executed; 0 where only the checkpoint knows."""
    of_sft = config.sft.steps and config.sft.policy.get("n_action_steps")
    return int(config.policy.n_action_steps or of_sft or 0)
