# SPDX-License-Identifier: Apache-2.0
"""Play, and the world model that is trained on it, of a run that imagines and names no world model.

Episodes of the run's policy and of a disturbed expert are recorded, failures included, in ``play``; the world
model is trained on them and checked in ``pretraining``.
"""

from __future__ import annotations

import gc
import itertools
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.console import Console
from accerl_lerobot.demos import record
from accerl_lerobot.engines.config import RunConfig
from accerl_lerobot.envs import make_environment
from accerl_lerobot.envs.base import ChunkResult, Environment, WrappedEnvironment
from accerl_lerobot.experience import Observation
from accerl_lerobot.policies.config import Load, executed_rows, loader
from accerl_lerobot.rollout.runner import EpisodePlans, RolloutRunner
from accerl_lerobot.run.preflight import policy_to_be
from accerl_lerobot.world_model.config import WorldModelConfig
from accerl_lerobot.world_model.pretrain import pretrain, show

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
    with closing(make_environment(config.env)) as environment:
        spec = environment.spec
    with (
        console.stage("play", total=policy_episodes + expert_episodes) as stage,
        record.appearing(root) as folder,
        record.new_dataset(folder, "accerl/play", spec, config.env) as dataset,
        record.simulated(config.env, expert, range(expert_episodes)) as disturbed,
    ):
        by_policy = policy_play(config, spec.tasks, policy_episodes, load)
        for episode in itertools.chain(by_policy, disturbed):
            record.save_episode(dataset, episode, tally)
            stage.update(tally["episodes"], f"{tally['successes']} successes")
    console.say("{episodes} episodes of play, {successes} successes".format(**tally))


def policy_play(
    config: RunConfig, tasks: tuple[str, ...], count: int, load: Load | None
) -> Iterator[record.Episode]:
    """Exploring episodes of a run's policy, with an observation at every env step."""
    adapter = loader(load)(config.policy)
    ended: list[record.Episode] = []
    environments = []
    for _ in range(min(count, config.rollout.environments)):
        environments.append(RecordingEnvironment(make_environment(config.env), ended))
    plans = EpisodePlans(tasks, config.seed, count, PLAY_WORKER)
    plans.exploring = True
    runner = RolloutRunner(environments, plans, config.rollout)
    with closing(runner):
        requests = {slot: runner.begin_episode(slot) for slot in range(len(runner))}
        while due := {slot: request for slot, request in requests.items() if request}:
            for slot, decision in zip(due, adapter.decide(list(due.values()), 0), strict=True):
                requests[slot] = runner.advance(slot, decision)
            runner.segments.clear()
            runner.results.clear()
            yield from ended
            ended.clear()


class RecordingEnvironment(WrappedEnvironment):
    """An environment that adds its whole episodes to `ended`."""

    def __init__(self, environment: Environment, ended: list[record.Episode]) -> None:
        super().__init__(environment)
        self._ended = ended

    def reset(self, seed: int, task: str) -> Observation:
        self._observation = super().reset(seed, task)
        self._steps: list[record.PlayedStep] = []
        return self._observation

    def step_chunk(self, actions: np.ndarray) -> ChunkResult:
        rewards = []
        actions = np.clip(actions, self.spec.action_low, self.spec.action_high).astype(np.float32)
        for action in actions:
            result = self._environment.step_chunk(action[None])
            rewards.append(result.rewards)
            self._steps.append((self._observation, action, result))
            self._observation = result.observation
            if result.done:
                self._ended.append(record.episode_of(self._steps))
                break
        return replace(result, rewards=np.concatenate(rewards))
