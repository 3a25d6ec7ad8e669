# SPDX-License-Identifier: Apache-2.0
"""Training of a pixel world model before a run.

``accerl world-model`` trains on a LeRobotDataset. `prepared` is what ``accerl train`` does where no world
model is named: it records episodes of the policy and of a disturbed expert, and trains on them.

<output_dir>/
  world_model/       see `imagined.py`
  metrics.jsonl      training losses
  validation.json    the check
  preview.mp4        held-out episodes, recorded above imagined
"""

from __future__ import annotations

import contextlib
import itertools
import json
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from accerl_lerobot.checkpoint.layout import write_atomically
from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.console import Console
from accerl_lerobot.demos import record
from accerl_lerobot.envs import EnvConfig, make_environment
from accerl_lerobot.envs.base import ChunkResult, Environment, WrappedEnvironment
from accerl_lerobot.errors import InputError, expanded
from accerl_lerobot.experience import Observation
from accerl_lerobot.metrics import plain
from accerl_lerobot.policies.config import Load, loader
from accerl_lerobot.policies.loading import resolve_device
from accerl_lerobot.rollout.runner import EpisodePlans, RolloutRunner
from accerl_lerobot.run.preflight import policy_to_be
from accerl_lerobot.world_model.check import check, checks_table, preview
from accerl_lerobot.world_model.config import WorldModelConfig
from accerl_lerobot.world_model.contract import WorldModelSpec, new_model
from accerl_lerobot.world_model.data import load_episodes, split_episodes
from accerl_lerobot.world_model.imagined import World, load_world, read_content, save_world
from accerl_lerobot.world_model.training import Trainer, uniform

if TYPE_CHECKING:
    from accerl_lerobot.cli.configs import WorldModelEvalRun
    from accerl_lerobot.engines.config import RunConfig

LOG_EVERY = 20  # steps between two lines of training losses
VALIDATION = "validation.json"
PLAY, PRETRAINING = "play", "pretraining"  # folders of a run: recorded episodes, and their world model
DISTURBED = record.DemosConfig(failure_share=0.1, action_noise=0.2, push=2.0)
"""The expert's part of `PLAY`: some of its episodes miss narrowly, as a policy does, and some drift."""
PLAY_WORKER = 999  # of the seeds of the policy's part of `PLAY`, apart from those of rollout workers


def pretrain(
    config: WorldModelConfig,
    env: EnvConfig,
    dataset: DatasetConfig,
    directory: Path,
    console: Console,
    *,
    seed: int,
    device: str,
) -> dict[str, Any]:
    """Trains, checks and saves a world model; `directory` exists.

    Returns:
        What `check` returns, with ``seconds`` of the training and the number of ``learnt`` episodes.
    """
    torch_device = resolve_device(device, "device")
    with closing(make_environment(env)) as environment:
        sizes = environment.spec
    spec = WorldModelSpec(
        cameras=tuple(sizes.images), image_size=(config.image_size, config.image_size),
        state_dim=sizes.state_dim, action_dim=sizes.action_dim, chunk=config.chunk,
        context=config.model.context, fps=sizes.fps,
    )  # fmt: skip
    with console.stage("episodes"):
        episodes = load_episodes(dataset, spec)
    learnt, held_out = split_episodes(episodes, np.random.default_rng((seed, 0)))
    if any({episode.success for episode in part} != {True, False} for part in (learnt, held_out)):
        hint = (
            "it needs at least two successes and two failures, to hold out one of each; record more episodes"
        )
        raise InputError("dataset.repo_id", dataset.repo_id, hint)
    spec = replace(spec, tasks=tuple(sorted({episode.task for episode in episodes})))
    started = time.monotonic()
    torch.manual_seed(seed)
    # The networks are initialised on the CPU, so alike on every device.
    world = World(new_model(spec, config.model)).to(torch_device)
    trainer, weights = Trainer(world, config.lr, seed, config.steps), uniform(learnt)
    trainer.fit_statistics(learnt)
    with (
        console.stage("world model", total=config.steps) as stage,
        (directory / "metrics.jsonl").open("w") as log,
    ):
        for step in range(1, config.steps + 1):
            metrics = trainer.step(learnt, weights)
            stage.update(step, " ".join(f"{name} {value:.3f}" for name, value in metrics.items()))
            if step % LOG_EVERY == 0:
                log.write(json.dumps({"step": step} | metrics) + "\n")
    seconds = time.monotonic() - started
    world = trainer.serving
    with console.stage("check"):
        found = check(world, held_out, seed)
        preview(directory / "preview.mp4", world, held_out)
    world.success.threshold.fill_(found["threshold"])
    failed = [name for name, outcome in found["checks"].items() if not outcome["holds"]]
    save_world(directory / "world_model", world, [episode.key for episode in learnt], failed)
    found = found | {"learnt": len(learnt), "seconds": seconds}
    write_atomically(directory / VALIDATION, json.dumps(plain(found), indent=2) + "\n")
    return found


def evaluate(run: WorldModelEvalRun, directory: Path, console: Console) -> dict[str, Any]:
    """Checks a saved world model on episodes that it was not trained on."""
    device = resolve_device(run.device, "device")
    path = expanded(str(run.path), "path")
    world = load_world(path, run.discover_packages_path).to(device)
    learnt = read_content(path).get("learnt") or ()
    with console.stage("episodes"):
        episodes = load_episodes(run.dataset, world.model.spec)
    kept = [episode for episode in episodes if episode.key not in learnt]
    if not kept:
        hint = "the world model was trained on every episode of it; give another dataset"
        raise InputError("dataset.repo_id", run.dataset.repo_id, hint)
    with console.stage("check"):
        found = check(world, kept, run.seed)
        preview(directory / "preview.mp4", world, kept)
    write_atomically(directory / VALIDATION, json.dumps(plain(found), indent=2) + "\n")
    return found


def show(found: dict[str, Any], directory: Path, console: Console) -> None:
    """Shows people the outcome of a check."""
    console.rich.print(checks_table(found))
    console.say(f"{'passed' if found['passed'] else 'FAILED'}; see {directory / 'preview.mp4'}")


def prepared(config: RunConfig, directory: Path, console: Console, load: Load | None = None) -> RunConfig:
    """A run whose policy is there, with a world model of its own: play is recorded, and trained on.

    A part that is complete is not done again.
    """
    imagination = config.imagination
    play, pretraining = directory.absolute() / PLAY, directory.absolute() / PRETRAINING
    dataset = DatasetConfig(repo_id="accerl/play", root=str(play))
    if not play.exists():
        record_play(config, play, console, load)
    if not pretraining.exists():
        chunk = getattr(policy_to_be(config), "n_action_steps", 1)
        model = WorldModelConfig(steps=imagination.steps, chunk=chunk)
        with record.appearing(pretraining) as folder:
            folder.mkdir()
            device = config.policy.device
            found = pretrain(model, config.env, dataset, folder, console, seed=config.seed, device=device)
        show(found, pretraining, console)
    learn = replace(imagination.learn, dataset=dataset)
    path = str(pretraining / "world_model")
    return replace(config, imagination=replace(imagination, path=path, learn=learn))


def record_play(config: RunConfig, root: Path, console: Console, load: Load | None) -> None:
    """Records exploring episodes of a run's policy, and episodes of the disturbed expert, as one dataset."""
    policy_episodes, expert_episodes = config.imagination.policy_episodes, config.imagination.expert_episodes
    tally = {"episodes": 0, "frames": 0, "successes": 0}
    # Of other starts than the demonstrations.
    expert = partial(record.record_one, config.env, DISTURBED, config.seed + 1)
    with contextlib.ExitStack() as stack:
        stage = stack.enter_context(console.stage("play", total=policy_episodes + expert_episodes))
        folder = stack.enter_context(record.appearing(root))
        with closing(make_environment(config.env)) as environment:
            spec = environment.spec
        dataset = stack.enter_context(record.new_dataset(folder, "accerl/play", spec, config.env))
        disturbed = stack.enter_context(record.simulated(config.env, expert, range(expert_episodes)))
        by_expert = (episode for episode, _ in disturbed)
        for episode in itertools.chain(policy_play(config, policy_episodes, load), by_expert):
            record.save_episode(dataset, episode, tally)
            stage.update(tally["episodes"], f"{tally['successes']} successes")
    console.say("{episodes} episodes of play, {successes} successes".format(**tally))


def policy_play(config: RunConfig, count: int, load: Load | None) -> Iterator[record.Episode]:
    """Exploring episodes of a run's policy, with an observation at every env step."""
    adapter = loader(load)(config.policy)
    ended: list[record.Episode] = []
    environments = [
        RecordingEnvironment(make_environment(config.env, 1, config.rollout.reward_model), ended)
        for _ in range(min(count, config.rollout.environments))
    ]
    if not environments:
        return
    plans = EpisodePlans(environments[0].spec.tasks, config.seed, count, PLAY_WORKER)
    runner = RolloutRunner(
        environments, lambda source: plans.next(True), config.rollout, PLAY,
        on_segment=lambda segment: None, on_episode=plans.ended,
    )  # fmt: skip
    with closing(runner):
        requests = {slot: runner.start(slot) for slot in range(len(runner))}
        while due := {slot: request for slot, request in requests.items() if request is not None}:
            decisions = adapter.decide(list(due.values()), 0)
            for slot, decision in zip(due, decisions, strict=True):
                requests[slot] = runner.advance(slot, decision)
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
        results: list[ChunkResult] = []
        for action in np.clip(actions, self.spec.action_low, self.spec.action_high).astype(np.float32):
            results.append(self._environment.step_chunk(action[None]))
            self._steps.append((self._observation, action, results[-1]))
            self._observation = results[-1].observation
            if results[-1].done:
                self._ended.append(record.episode_of(self._steps))
                break
        return replace(results[-1], rewards=np.concatenate([result.rewards for result in results]))
