# SPDX-License-Identifier: Apache-2.0
"""Puts together what imagines for a run."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from accerl_lerobot.engine.config import DatasetConfig, RunConfig, journal_folder
from accerl_lerobot.engine.preflight import policy_to_be
from accerl_lerobot.envs import make_world
from accerl_lerobot.envs.base import WorldSpec
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Segment
from accerl_lerobot.policies.loading import load_lerobot_config
from accerl_lerobot.world_model.baselines import learnt_within
from accerl_lerobot.world_model.config import TrialConfig
from accerl_lerobot.world_model.contract import WorldModelSpec
from accerl_lerobot.world_model.dataset import fingerprint, load_episodes
from accerl_lerobot.world_model.episodes import Episode
from accerl_lerobot.world_model.films import TrialFilms
from accerl_lerobot.world_model.fit import check_fit
from accerl_lerobot.world_model.imagination_config import FILMS, ImaginationConfig, OnlineLearnConfig
from accerl_lerobot.world_model.imagine import Dreamer, Imagination
from accerl_lerobot.world_model.online import OnlineLearner
from accerl_lerobot.world_model.pool import part
from accerl_lerobot.world_model.recorded import DREAMS, DreamRecorder
from accerl_lerobot.world_model.sources import ONLINE, check_apart, named, open_rooms
from accerl_lerobot.world_model.store import A_RUN, Source, find, load_sources
from accerl_lerobot.world_model.zoo import make_dreamer

EARLIER = "earlier"
"""Source of the episodes that a world model has learnt from before the run."""


def make_imagination(
    config: RunConfig, name: str, on_segment: Callable[[Segment], object], index: int = 0
) -> Imagination:
    """Makes the workers' imagination of a run, or a part of it.

    Args:
        config: the run; its ``policy.path`` must be set.
        name: prefix of the segments' keys.
        on_segment: see `Imagination`.
        index: which of `ImaginationConfig.workers` dreams; each has its part of the dreams and its own draws.

    Raises:
        InputError: the world model cannot be loaded, or does not fit world and policy.
    """
    spec = _spec(config)
    dreamer = load_dreamer(config, spec)
    folder = journal_folder(config)
    if config.imagination.record and folder is not None and index == 0:
        pace = spec.fps / dreamer.model.spec.chunk
        on_segment = _recorded(DreamRecorder(folder / DREAMS, config.imagination.record, pace), on_segment)
    return Imagination(
        dreamer.model,
        dreamer.success,
        spec,
        part(config.imagination, index),
        decision_cost=config.rollout.decision_cost,
        fails=config.rollout.time_limit == "fail",
        seed=config.seed,
        name=name,
        on_segment=on_segment,
        index=index,
        ended=_witnesses(config),
        sources=_sources(config, dreamer.model.spec) if index == 0 else (),
    )


def _sources(config: RunConfig, spec: WorldModelSpec) -> list[Source]:
    """Datasets that a learning world model learns from, beside the run's own episodes."""
    if not config.imagination.learns:
        return []
    sources = list(load_sources(Path(str(config.imagination.path)), "imagination"))
    rooms = _rooms(config.imagination.learn)
    for room, meta in open_rooms(rooms, spec).items():
        if find(sources, known := fingerprint(meta)) is None:  # then it is learnt from whole
            every = tuple(range(meta.total_episodes))
            name = rooms[room].repo_id or ""
            sources.append(Source(repo_id=name, fingerprint=known, learnt=every, held_out=()))
    return [*sources, A_RUN]


def _witnesses(config: RunConfig) -> int:
    """Real episodes to calibrate by: all there will be, or so many that those under way matter little."""
    rollout = config.rollout
    enough = config.imagination.witnesses + rollout.workers * rollout.worlds
    return min(enough, rollout.episodes or enough)


def _recorded(
    recorder: DreamRecorder, on_segment: Callable[[Segment], object]
) -> Callable[[Segment], object]:
    def record(segment: Segment) -> None:
        recorder.write(segment)
        on_segment(segment)

    return record


def load_dreamer(config: RunConfig, world: WorldSpec) -> Dreamer:
    """Loads a run's world model; its ``policy.path`` must be set.

    Raises:
        InputError: see `make_imagination`.
    """
    policy = load_lerobot_config(config.policy)
    executed = getattr(policy, "n_action_steps", 1)
    return _dreamer(config, world, executed, policy.n_obs_steps)


def make_learner(config: RunConfig, dreamer: Dreamer | None = None) -> OnlineLearner:
    """Makes the learner of a run's world model, from `dreamer` on; None: from the saved one.

    Raises:
        InputError: a dataset it was pre-trained on cannot be read, is of another world, or is named twice.
    """
    learn = config.imagination.learn
    world = _spec(config)
    dreamer = dreamer or load_dreamer(config, world)
    model, success = learnt_within(dreamer.model), dreamer.success
    longest = _longest(config, world, model.spec.chunk)
    assert success is not None  # as `check_imagination` has found
    sources = load_sources(Path(str(config.imagination.path)), "imagination")
    offline: list[Episode] = []
    held_out: list[Episode] = []
    rooms = _rooms(learn)
    for room, meta in open_rooms(rooms, model.spec).items():
        with named(room):
            # Not as a policy's, whichever it is: in a trial, this run's own failures are what counts.
            episodes = load_episodes(rooms[room], model.spec, EARLIER, both=False)
            check_apart(rooms[room], episodes, offline + held_out)
        source = find(sources, fingerprint(meta))
        offline += episodes if source is None else [episodes[i] for i in source.learnt]
        held_out += [] if source is None else [episodes[i] for i in source.held_out]
    return OnlineLearner(
        model,
        success,
        learn,
        _trial(config.imagination, longest),
        offline=offline,
        held_out=held_out,
        longest=longest,
        fixed=config.imagination.threshold,
        seed=config.seed,
        on_trial=_films(config),
    )


def check_imagination(config: RunConfig) -> None:
    """Refuses, before a run begins, what `make_imagination` would refuse in the middle of it.

    Raises:
        InputError: see there.
    """
    policy = policy_to_be(config)
    executed = getattr(policy, "n_action_steps", 1)
    dreamer = _dreamer(config, _spec(config), executed, policy.n_obs_steps, first=True)
    learn = config.imagination.learn
    if config.imagination.learns:
        open_rooms(_rooms(learn), dreamer.model.spec)


def _rooms(learn: OnlineLearnConfig) -> dict[str, DatasetConfig]:
    """The datasets that are named."""
    rooms = {"dataset": learn.dataset, ONLINE: learn.online}
    return {f"imagination.learn.{room}": of for room, of in rooms.items() if of.repo_id is not None}


def _films(config: RunConfig) -> TrialFilms | None:
    """Where the folder of the run is known, and films are wanted."""
    folder, every = journal_folder(config), config.imagination.learn.films
    return None if folder is None or not every else TrialFilms(folder / FILMS, every)


def _trial(config: ImaginationConfig, longest: int) -> TrialConfig:
    """Trial of the run's own dreams, in so many chunks at most."""
    trial = config.learn.trial
    if config.horizon is None:
        return replace(trial, whole=True, depth=min(trial.depth, longest))
    return replace(trial, whole=False, depth=config.horizon)


def _longest(config: RunConfig, world: WorldSpec, chunk: int) -> int:
    """Decisions of a dream at most."""
    return config.imagination.horizon or math.ceil(world.max_steps / chunk)


def _spec(config: RunConfig) -> WorldSpec:
    world = make_world(config.env)
    try:
        return world.spec
    finally:
        world.close()


def _dreamer(
    config: RunConfig, spec: WorldSpec, executed: int, history: int, *, first: bool = False
) -> Dreamer:
    """The one that was asked for, checked; `first`: see `make_dreamer`."""
    if (reward := getattr(config.env, "reward", "success")) != "success":
        remedy = "use success with imagination.share: that is what dreams are rewarded for"
        raise InputError("env.reward", reward, remedy)
    if not getattr(config.env, "terminate_on_success", True):
        remedy = "use true with imagination.share: a success ends a dream, and so it must a real episode"
        raise InputError("env.terminate_on_success", False, remedy)
    dreamer = make_dreamer(config.imagination, config.env, spec, executed, config.policy.device, first=first)
    if config.imagination.learns and dreamer.success is None:
        remedy = "it has no success model to go on learning with; use imagination.learn.steps_per_episode=0"
        raise InputError("imagination.path", config.imagination.path, remedy)
    check_fit(dreamer.model.spec, spec, executed, history, dreamer.success is not None)
    longest = _longest(config, spec, executed)
    config.imagination.replay.check(
        batch_decisions=config.trainer.batch_decisions, segment_decisions=longest, field="imagination.replay"
    )
    return dreamer
