# SPDX-License-Identifier: Apache-2.0
"""Makes the world models of `kinds.py`."""

from __future__ import annotations

from pathlib import Path

from accerl_lerobot.config.imports import imported
from accerl_lerobot.envs import EnvConfig, make_world
from accerl_lerobot.envs.base import WorldSpec
from accerl_lerobot.policies.loading import resolve_device
from accerl_lerobot.world_model.baselines import CopyModel, OracleModel, ShuffledModel
from accerl_lerobot.world_model.contract import Means, WorldModel, WorldModelSpec
from accerl_lerobot.world_model.imagination_config import ImaginationConfig
from accerl_lerobot.world_model.imagine import Dreamer
from accerl_lerobot.world_model.stand_in import load_stand_in, rehearse_stand_in
from accerl_lerobot.world_model.store import load_world_model, rehearse_world_model


def make_dreamer(
    config: ImaginationConfig,
    env: EnvConfig,
    world: WorldSpec,
    executed: int,
    device: str,
    *,
    first: bool = False,
) -> Dreamer:
    """The one that `config` names.

    Args:
        config: which, and from where.
        env: the real world, for an oracle.
        world: what that shows, for those that are made of no other world model.
        executed: actions that the policy executes per decision.
        device: where it dreams, see `PolicyConfig.device`.
        first: nobody has loaded its files before, so a child process does so first, see `isolation`.

    Raises:
        InputError: it cannot be loaded.
    """
    where, kind = resolve_device(device), config.kind
    learnt = success = None
    if kind.folder:
        assert config.path is not None  # ImaginationConfig has seen to that
        if first:
            rehearse_world_model(Path(config.path), config.discover_packages_path, room="imagination")
        learnt, success = load_world_model(
            Path(config.path), config.discover_packages_path, room="imagination"
        )
        learnt.to(where)
    spec = _shown(world, executed) if learnt is None else learnt.spec
    means = Means(config, spec, learnt, lambda: make_world(env), where)
    model: WorldModel = imported(kind.make)(means)
    if config.success.path is not None:
        if first:
            rehearse_stand_in(config.success, model.spec, "imagination.success")
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
