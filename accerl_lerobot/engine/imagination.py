# SPDX-License-Identifier: Apache-2.0
"""Builds what imagines for a run, and the learner of its world model."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

from accerl_lerobot.engine.config import DatasetConfig, RunConfig, journal_folder
from accerl_lerobot.engine.preflight import policy_to_be
from accerl_lerobot.envs import make_world
from accerl_lerobot.envs.base import WorldSpec
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Segment
from accerl_lerobot.policies.loading import load_lerobot_config
from accerl_lerobot.world_model.config import VIDEOS, OnlineLearnConfig
from accerl_lerobot.world_model.contract import WorldModelSpec
from accerl_lerobot.world_model.data import fingerprint, load_episodes
from accerl_lerobot.world_model.online import OnlineLearner, PretrainingEpisodes
from accerl_lerobot.world_model.registry import (
    ImaginationModels,
    check_fit,
    learned_part,
    make_models,
)
from accerl_lerobot.world_model.rollouts import Imagination, RolloutSettings
from accerl_lerobot.world_model.store import OWN_RUN, Source, find_source, load_sources
from accerl_lerobot.world_model.validation import (
    DATASET,
    ONLINE,
    ValidationVideos,
    check_disjoint,
    name_section,
    open_datasets,
)

EARLIER = "earlier"
"""`Episode.source` of the pre-training episodes."""


def make_imagination(config: RunConfig, on_segment: Callable[[Segment], object]) -> Imagination:
    """Builds the imagination of a run.

    Args:
        config: of the run; its ``policy.path`` must be set.
        on_segment: receives the imagined segments.

    Raises:
        InputError: the world model cannot be loaded, or does not fit environment and policy.
    """
    world = _world_spec(config)
    models = load_models(config, world)
    run = RolloutSettings(
        decision_cost=config.rollout.decision_cost,
        time_limit_fails=config.rollout.time_limit == "fail",
        seed=config.seed,
    )
    sources = _sources(config, models.model.spec)
    return Imagination(models, world, config.imagination, run, on_segment, sources)


def _sources(config: RunConfig, spec: WorldModelSpec) -> list[Source]:
    """Datasets that a world model is trained on in the run, beside the run's own episodes."""
    if not config.imagination.learns:
        return []
    sources = list(load_sources(Path(str(config.imagination.path)), "imagination"))
    sections = _dataset_sections(config.imagination.learn)
    for section, meta in open_datasets(sections, spec).items():
        if find_source(sources, known := fingerprint(meta)) is None:  # then it trains on all of it
            every = tuple(range(meta.total_episodes))
            name = sections[section].repo_id or ""
            sources.append(Source(repo_id=name, fingerprint=known, learnt=every, held_out=()))
    return [*sources, OWN_RUN]


def load_models(config: RunConfig, world: WorldSpec) -> ImaginationModels:
    """Loads a run's world model; its ``policy.path`` must be set.

    Raises:
        InputError: see `make_imagination`.
    """
    policy = load_lerobot_config(config.policy)
    executed = getattr(policy, "n_action_steps", 1)
    return _models(config, world, executed, policy.n_obs_steps)


def make_learner(config: RunConfig, models: ImaginationModels | None = None) -> OnlineLearner:
    """Builds the learner of a run's world model, which starts at `models`; None: at the saved ones.

    Raises:
        InputError: a dataset of its pre-training cannot be read, does not fit, or is named twice.
    """
    learn = config.imagination.learn
    world = _world_spec(config)
    models = models or load_models(config, world)
    model, success = learned_part(models.model), models.success
    longest = _longest(world, model.spec.chunk)
    assert success is not None  # as `check_imagination` has found
    sources = load_sources(Path(str(config.imagination.path)), "imagination")
    known = PretrainingEpisodes([], [])
    sections = _dataset_sections(learn)
    for section, meta in open_datasets(sections, model.spec).items():
        with name_section(section):
            # Not ``online``, even if a policy recorded them: in validation this run's own failures count.
            episodes = load_episodes(sections[section], model.spec, EARLIER, both=False)
            check_disjoint(sections[section], episodes, known.learnt + known.held_out)
        source = find_source(sources, fingerprint(meta))
        known.learnt.extend(episodes if source is None else [episodes[i] for i in source.learnt])
        known.held_out.extend([] if source is None else [episodes[i] for i in source.held_out])
    return OnlineLearner(
        model,
        success,
        config.imagination,
        known,
        longest,
        seed=config.seed,
        on_validation=_videos(config),
    )


def check_imagination(config: RunConfig) -> None:
    """Refuses, before a run begins, what `make_imagination` would refuse in the middle of it.

    Raises:
        InputError: see there.
    """
    policy = policy_to_be(config)
    executed = getattr(policy, "n_action_steps", 1)
    models = _models(config, _world_spec(config), executed, policy.n_obs_steps, first=True)
    if config.imagination.learns:
        open_datasets(_dataset_sections(config.imagination.learn), models.model.spec)


def _dataset_sections(learn: OnlineLearnConfig) -> dict[str, DatasetConfig]:
    """The datasets that are named, by their config section."""
    sections = {DATASET: learn.dataset, ONLINE: learn.online}
    return {f"imagination.learn.{name}": of for name, of in sections.items() if of.repo_id is not None}


def _videos(config: RunConfig) -> ValidationVideos | None:
    """Videos into the run's folder, if that is known."""
    folder = journal_folder(config)
    return None if folder is None else ValidationVideos(folder / VIDEOS)


def _longest(world: WorldSpec, chunk: int) -> int:
    """Decisions of a rollout at most."""
    return math.ceil(world.max_steps / chunk)


def _world_spec(config: RunConfig) -> WorldSpec:
    world = make_world(config.env)
    try:
        return world.spec
    finally:
        world.close()


def _models(
    config: RunConfig, world: WorldSpec, executed: int, history: int, *, first: bool = False
) -> ImaginationModels:
    """Loads and checks the models; `first`: see `make_models`."""
    if (reward := getattr(config.env, "reward", "success")) != "success":
        remedy = "use success with imagination.share: that is what imagined rollouts are rewarded for"
        raise InputError("env.reward", reward, remedy)
    if not getattr(config.env, "terminate_on_success", True):
        remedy = "use true with imagination.share: imagined rollouts end with a success, real ones must too"
        raise InputError("env.terminate_on_success", False, remedy)
    models = make_models(config.imagination, config.env, world, executed, config.policy.device, first=first)
    if config.imagination.learns and models.success is None:
        remedy = "it has no success model to train on; use imagination.learn.steps_per_episode=0"
        raise InputError("imagination.path", config.imagination.path, remedy)
    check_fit(models.model.spec, world, executed, history, models.success is not None)
    imagined, longest = config.imagination.imagined_replay(config.replay), _longest(world, executed)
    imagined.check(batch_decisions=config.trainer.batch_decisions, segment_decisions=longest)
    return models
