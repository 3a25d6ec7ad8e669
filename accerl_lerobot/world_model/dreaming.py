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
"""Puts together what imagines for a run."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from accerl_lerobot.envs import make_world
from accerl_lerobot.envs.base import WorldSpec
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Segment
from accerl_lerobot.policies.loading import load_lerobot_config
from accerl_lerobot.world_model.imagine import Imagination, check_fit
from accerl_lerobot.world_model.zoo import Dreamer, make_dreamer

if TYPE_CHECKING:
    from accerl_lerobot.config import RunConfig


def make_imagination(config: RunConfig, name: str, on_segment: Callable[[Segment], object]) -> Imagination:
    """What dreams in a run.

    Args:
        config: the run; its ``policy.path`` must be set.
        name: prefix of the segments' keys.
        on_segment: see `Imagination`.

    Raises:
        InputError: the world model cannot be loaded, or does not fit world and policy.
    """
    policy = load_lerobot_config(config.policy)
    spec = _spec(config)
    dreamer = _dreamer(config, spec, getattr(policy, "n_action_steps", 1), policy.n_obs_steps)
    return Imagination(
        dreamer.model,
        dreamer.success,
        spec,
        config.imagination,
        decision_cost=config.rollout.decision_cost,
        fails=config.rollout.time_limit == "fail",
        seed=config.seed,
        name=name,
        on_segment=on_segment,
    )


def check_imagination(config: RunConfig) -> None:
    """Refuses, before a run begins, what `make_imagination` would refuse in the middle of it.

    Raises:
        InputError: see there.
    """
    if not config.imagination.share:
        return
    if config.policy.path is not None:
        make_imagination(config, "", lambda segment: None)
    else:
        fields = config.sft.policy
        executed = fields.get("n_action_steps", fields.get("chunk_size", 1))
        _dreamer(config, _spec(config), executed, fields.get("n_obs_steps", 1))


def _spec(config: RunConfig) -> WorldSpec:
    world = make_world(config.env)
    try:
        return world.spec
    finally:
        world.close()


def _dreamer(config: RunConfig, spec: WorldSpec, executed: int, history: int) -> Dreamer:
    """The one that was asked for, checked."""
    if not getattr(config.env, "terminate_on_success", True):
        remedy = "use true with imagination.share: a success ends a dream, and so it must a real episode"
        raise InputError("env.terminate_on_success", False, remedy)
    dreamer = make_dreamer(config.imagination, config.env, spec, executed)
    check_fit(dreamer.model.spec, spec, executed, history, dreamer.success is not None)
    return dreamer
