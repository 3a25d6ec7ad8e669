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
"""The world models that ``imagination.model`` can name. A new one is a class and a line here."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from accerl_lerobot.envs import EnvConfig, make_world
from accerl_lerobot.envs.base import WorldSpec
from accerl_lerobot.policies.loading import resolve_device
from accerl_lerobot.world_model.baselines import CopyModel, OracleModel, ShuffledModel
from accerl_lerobot.world_model.contract import WorldModel, WorldModelSpec
from accerl_lerobot.world_model.imagination_config import ImaginationConfig
from accerl_lerobot.world_model.imagine import Dreamer
from accerl_lerobot.world_model.pixels import PixelWorldModel
from accerl_lerobot.world_model.stand_in import load_stand_in
from accerl_lerobot.world_model.store import load_world_model


def make_dreamer(
    config: ImaginationConfig, env: EnvConfig, world: WorldSpec, executed: int, device: str
) -> Dreamer:
    """The one that `config` names.

    Args:
        config: which, and from where.
        env: the real world, for an oracle.
        world: what that shows.
        executed: actions that the policy executes per decision.
        device: where it dreams, see `PolicyConfig.device`.

    Raises:
        InputError: it cannot be loaded.
    """
    where = resolve_device(device)
    if config.model == "oracle":
        return _oracle(config, env, world, executed)
    assert config.path is not None  # ImaginationConfig has seen to that
    model, success = load_world_model(Path(config.path), "imagination.path")
    dreams = _LEARNED[config.model](model.eval().to(where))
    if config.success.path is not None:
        return Dreamer(dreams, load_stand_in(config.success, model.spec, "imagination.success", where))
    if success is not None:
        success.config.device = str(where)
        if config.threshold is not None:
            success.config.threshold = config.threshold
    return Dreamer(dreams, None if success is None else success.to(where))


def _oracle(config: ImaginationConfig, env: EnvConfig, world: WorldSpec, executed: int) -> Dreamer:
    height, width, _ = next(iter(world.images.values()))
    spec = WorldModelSpec(
        cameras=tuple(world.images),
        image_size=(height, width),
        state_dim=world.state_dim,
        action_dim=world.action_dim,
        chunk=executed,
        fps=world.fps,
        context=1,
        provides=frozenset({"pixels", "state"} if world.state_dim else {"pixels"}),
    )
    return Dreamer(OracleModel(spec, lambda: make_world(env), config.dreams), None)


_LEARNED: dict[str, Callable[[PixelWorldModel], WorldModel]] = {
    "learned": lambda model: model,
    "shuffled": ShuffledModel,
    "copy": lambda model: CopyModel(model.spec),
}
