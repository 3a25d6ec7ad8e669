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
"""Makes the world models of `kinds.py`."""

from __future__ import annotations

from pathlib import Path

from accerl_lerobot.envs import EnvConfig, make_world
from accerl_lerobot.envs.base import WorldSpec
from accerl_lerobot.imports import imported
from accerl_lerobot.policies.loading import resolve_device
from accerl_lerobot.world_model.baselines import CopyModel, OracleModel, ShuffledModel
from accerl_lerobot.world_model.contract import Means, WorldModel, WorldModelSpec
from accerl_lerobot.world_model.imagination_config import ImaginationConfig
from accerl_lerobot.world_model.imagine import Dreamer
from accerl_lerobot.world_model.stand_in import load_stand_in
from accerl_lerobot.world_model.store import load_world_model


def make_dreamer(
    config: ImaginationConfig, env: EnvConfig, world: WorldSpec, executed: int, device: str
) -> Dreamer:
    """The one that `config` names.

    Args:
        config: which, and from where.
        env: the real world, for an oracle.
        world: what that shows, for those that are made of no other world model.
        executed: actions that the policy executes per decision.
        device: where it dreams, see `PolicyConfig.device`.

    Raises:
        InputError: it cannot be loaded.
    """
    where, kind = resolve_device(device), config.kind
    learnt = success = None
    if kind.folder:
        assert config.path is not None  # ImaginationConfig has seen to that
        learnt, success = load_world_model(
            Path(config.path), config.discover_packages_path, room="imagination"
        )
        learnt.to(where)
    spec = _shown(world, executed) if learnt is None else learnt.spec
    means = Means(config, spec, learnt, lambda: make_world(env), where)
    model: WorldModel = imported(kind.make)(means)
    if config.success.path is not None:
        return Dreamer(model, load_stand_in(config.success, model.spec, "imagination.success", where))
    if success is not None:
        success.config.device = str(where)
        if config.threshold is not None:
            success.config.threshold = config.threshold
    return Dreamer(model, None if success is None else success.to(where))


def learned(means: Means) -> WorldModel:
    """The learnt one as it is."""
    assert means.learnt is not None  # its line in `KINDS` sees to that
    return means.learnt


def shuffled(means: Means) -> WorldModel:
    """The learnt one, told the wrong actions."""
    return ShuffledModel(learned(means))


def copy(means: Means) -> WorldModel:
    """Frames of the learnt one's size that never change."""
    return CopyModel(means.spec)


def oracle(means: Means) -> WorldModel:
    """A simulator for each dream."""
    return OracleModel(means.spec, means.simulator, means.config.dreams)


def _shown(world: WorldSpec, executed: int) -> WorldModelSpec:
    """All that a world shows, at its own size."""
    height, width, _ = next(iter(world.images.values()))
    return WorldModelSpec(
        cameras=tuple(world.images),
        image_size=(height, width),
        state_dim=world.state_dim,
        action_dim=world.action_dim,
        chunk=executed,
        fps=world.fps,
        context=1,
        provides=frozenset({"pixels", "state"} if world.state_dim else {"pixels"}),
    )
