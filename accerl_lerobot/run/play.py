# SPDX-License-Identifier: Apache-2.0
"""Play, and the world model that is trained on it, of a run that imagines and names no world model.

Episodes of the run's policy and of a disturbed expert are recorded, failures included, in ``play``; the world
model is trained on them and checked in ``pretraining``.
"""

from __future__ import annotations

import gc
import itertools
import logging
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.console import Console
from accerl_lerobot.demos import record
from accerl_lerobot.engines.config import RunConfig
from accerl_lerobot.envs import make_environment
from accerl_lerobot.envs.base import ChunkResult, WrappedEnvironment
from accerl_lerobot.experience import Observation, Request, nonfinite
from accerl_lerobot.policies.config import Load, executed_rows, loader
from accerl_lerobot.run.preflight import policy_to_be
from accerl_lerobot.seeds import noise_seed, train_seed
from accerl_lerobot.world_model.config import WorldModelConfig
from accerl_lerobot.world_model.pretrain import pretrain, show

if TYPE_CHECKING:
    from accerl_lerobot.policies.adapter import PolicyAdapter

logger = logging.getLogger(__name__)

PLAY, PRETRAINING = "play", "pretraining"  # folders of a run: recorded episodes, and their world model
DISTURBED = record.DemosConfig(failure_share=0.1, action_noise=0.2, push=2.0)
"""The expert's part of `PLAY`: some of its episodes miss narrowly, as a policy does, and some drift."""
PLAY_WORKER = 999  # of the seeds of the policy's part of `PLAY`, apart from those of rollout workers


def prepared(config: RunConfig, directory: Path, console: Console, load: Load | None = None) -> RunConfig:
    """A run whose policy is there, with a world model of its own: play is recorded, and trained on.

    A part that is complete is not done again.
    """
    imagination = config.imagination
    play = directory.absolute() / PLAY
    pretraining = directory.absolute() / PRETRAINING
    dataset = DatasetConfig(repo_id="accerl/play", root=str(play))
    if not play.exists():
        record_play(config, play, console, load)
    if not pretraining.exists():
        chunk = executed_rows(policy_to_be(config))
        model = WorldModelConfig(steps=imagination.steps, chunk=chunk)
        with record.appearing(pretraining) as folder:
            folder.mkdir()
            device = config.policy.device
            found = pretrain(model, config.env, dataset, folder, console, seed=config.seed, device=device)
        show(found, pretraining, console)
    if torch.cuda.is_available():  # this process needs none of it any more
        gc.collect()
        torch.cuda.empty_cache()
    learn = replace(imagination.learn, dataset=dataset)
    path = str(pretraining / "world_model")
    return replace(config, imagination=replace(imagination, path=path, learn=learn))


def record_play(config: RunConfig, root: Path, console: Console, load: Load | None) -> None:
    """Records exploring episodes of a run's policy, and episodes of the disturbed expert, as one dataset."""
    policy_episodes = config.imagination.policy_episodes
    expert_episodes = config.imagination.expert_episodes
    tally = {"episodes": 0, "frames": 0, "successes": 0}
    # Of other starts than the demonstrations.
    expert = partial(record.record_one, config.env, DISTURBED, config.seed + 1)
    with (
        closing(WatchedEnvironment(make_environment(config.env))) as environment,
        console.stage("play", total=policy_episodes + expert_episodes) as stage,
        record.appearing(root) as folder,
        record.new_dataset(folder, "accerl/play", environment.spec, config.env) as dataset,
        record.simulated(config.env, expert, range(expert_episodes)) as disturbed,
    ):
        by_policy = policy_play(config, environment, policy_episodes, load)
        for episode in itertools.chain(by_policy, disturbed):
            record.save_episode(dataset, episode, tally)
            stage.update(tally["episodes"], f"{tally['successes']} successes")
    console.say("{episodes} episodes of play, {successes} successes".format(**tally))


class WatchedEnvironment(WrappedEnvironment):
    """An environment that keeps the newest observation in `seen`."""

    seen: Observation

    def reset(self, seed: int, task: str) -> Observation:
        self.seen = super().reset(seed, task)
        return self.seen

    def step_chunk(self, actions: np.ndarray) -> ChunkResult:
        result = self._environment.step_chunk(actions)
        self.seen = result.observation
        return result


def policy_play(
    config: RunConfig, environment: WatchedEnvironment, count: int, load: Load | None
) -> Iterator[record.Episode]:
    """Exploring episodes of a run's policy, of each task in turn, with an observation at every env step."""
    if not count:
        return
    adapter = loader(load)(config.policy)
    tasks = environment.spec.tasks
    for number in range(count):
        seed = train_seed(config.seed, PLAY_WORKER, number)
        task = tasks[number % len(tasks)]
        actions = explored(adapter, environment, task, seed)
        episode = record.played(environment, task, seed, actions)
        bad = nonfinite(environment.seen | episode.observations | {"the reward": episode.rewards})
        if bad:
            logger.warning("an episode of play is dropped: %s is not finite", bad)
        else:
            yield episode


def explored(
    adapter: PolicyAdapter, environment: WatchedEnvironment, task: str, seed: int
) -> Iterator[np.ndarray]:
    """Actions of the policy for what the environment shows, without end."""
    spec = environment.spec
    steps = 0
    for number in itertools.count():
        if number and nonfinite(environment.seen):
            return
        request = Request(
            observation=environment.seen,
            noise_seed=noise_seed(seed, number),
            elapsed=steps / spec.max_steps,
            task=task,
        )
        [decision] = adapter.decide([request], 0)
        steps += len(decision.chunk)
        yield from np.clip(decision.chunk, spec.action_low, spec.action_high).astype(np.float32)
