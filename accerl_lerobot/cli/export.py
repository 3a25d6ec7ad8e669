# SPDX-License-Identifier: Apache-2.0
"""The exploring episodes of a run as a LeRobotDataset.

    accerl export --path=RUN --root=outputs/rollouts

A run observes its environments once per decision and keeps no pictures. Its journal has seeds and actions, so
episodes are replayed here with a picture at every step. An episode whose rewards or outcome differ from the
journal is left out and counted.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from accerl_lerobot.checkpoint.layout import CONFIG
from accerl_lerobot.checkpoint.safety import FileSource, check_folder
from accerl_lerobot.config.parsing import parse, read_arguments, read_recipe
from accerl_lerobot.config.ranges import NewFolder, Section
from accerl_lerobot.console import Console
from accerl_lerobot.demos import record
from accerl_lerobot.engines.config import RunConfig
from accerl_lerobot.envs import EnvConfig, Environment, MetaWorldConfig, make_environment
from accerl_lerobot.errors import InputError, expanded
from accerl_lerobot.replay.journal import EPISODES, JournalEntry, read_journal, whole_episodes
from accerl_lerobot.rollout.runner import RolloutConfig

REPO_ID = "accerl/rollouts"  # name of the dataset, which is where its folder is
VERSION = "policy_version"  # feature: updates behind the weights that chose the action
TOLERANCE = 1e-4  # by how much rewards of a decision may differ, as they are summed in another order


@dataclass(frozen=True, kw_only=True)
class ExportConfig(Section):
    """Fields of ``accerl export``; `env` is the run's own."""

    path: str | None = None
    """Folder of an ``accerl train`` run."""
    root: NewFolder = "outputs/rollouts"
    """Folder to create; must not exist."""
    pick: Literal["all", "successes", "failures"] = "all"
    """Episodes by their outcome."""
    env: EnvConfig = field(default_factory=MetaWorldConfig)


def export_config(arguments: list[str]) -> ExportConfig:
    """A command line on top of the config of the run that it names."""
    path = read_arguments(arguments)[1].get("path")
    if path is None:
        raise InputError("path", None, "name the folder of an accerl train run")
    run = expanded(str(path), "path")
    check_folder(run, FileSource("path", str(run)))
    for file in (CONFIG, EPISODES):
        if not (run / file).is_file():
            raise InputError("path", str(run), f"no accerl train run in it: there is no {file}")
    recipe = [f"--config_path={run / CONFIG}"]
    config: ExportConfig = parse(ExportConfig, recipe + arguments, recipe_class=RunConfig)
    return config


def export_episodes(config: ExportConfig, console: Console) -> dict[str, Any]:
    """Writes the dataset, which appears at ``config.root`` when it is complete.

    Returns:
        ``episodes``, ``frames``, ``successes``, and ``left_out``, those that played otherwise than the run's.
    """
    run = Path(str(config.path)).expanduser()
    root = record.check_free(config.root)
    episodes = list(whole_episodes(read_journal(run / EPISODES)))
    if config.pick != "all":
        outcome = config.pick == "successes"
        episodes = [parts for parts in episodes if parts[-1].success is outcome]
    if not episodes:
        hint = f"no whole episode in its {EPISODES} of those asked for ({config.pick})"
        raise InputError("path", str(run), hint)
    cost = _decision_cost(run)
    with closing(make_environment(config.env)) as environment:
        spec = environment.spec
    for parts in episodes:
        task = parts[0].origin.task
        if task not in spec.tasks:
            raise InputError("env.task", task, f"{EPISODES} has this task, and env has {spec.tasks}")
    record.check_instruction(spec, config.env)
    tally = {"episodes": 0, "frames": 0, "successes": 0, "left_out": 0}
    version = {VERSION: {"dtype": "int64", "shape": (1,), "names": None}}
    with (
        record.appearing(root) as folder,
        console.stage("replaying episodes", total=len(episodes)) as stage,
        record.simulated(config.env, partial(_replay, cost), episodes) as repeated,
    ):
        with record.new_dataset(folder, REPO_ID, spec, config.env, version) as dataset:
            for number, (episode, parts) in enumerate(zip(repeated, episodes, strict=True), start=1):
                stage.update(number, f"{tally['successes']} successes")
                if episode is None:
                    tally["left_out"] += 1
                    continue
                by_part = [np.repeat(part.versions, part.steps) for part in parts]
                versions = np.concatenate(by_part).astype(np.int64)
                record.save_episode(dataset, episode, tally, {VERSION: versions[:, None]})
        if not tally["episodes"]:
            hint = "none of its episodes could be repeated: this environment is not deterministic"
            raise InputError("path", str(run), hint)
    left_out = tally["left_out"]
    if left_out:
        console.say(f"{left_out} of {len(episodes)} episodes differed from the run and are left out")
    return tally


def _decision_cost(run: Path) -> float:
    """The cost of a decision in a run, which the rewards of its journal have in them."""
    rollout = read_recipe(run / CONFIG).get("rollout") or {}
    reward_model = rollout.get("reward_model") or {}
    if reward_model.get("path"):
        hint = "rollout.reward_model told its successes, which a repeated episode does not have"
        raise InputError("path", str(run), hint)
    return float(rollout.get("decision_cost", RolloutConfig().decision_cost))


def _replay(cost: float, environment: Environment, parts: list[JournalEntry]) -> record.Episode | None:
    """An episode with an observation at every step; None if it differs from the journal."""
    origin = parts[0].origin
    actions = np.concatenate([part.actions for part in parts])
    episode = record.played(environment, origin.task, origin.seed, actions)
    if len(episode) != len(actions) or episode.success != parts[-1].success:
        return None
    steps = np.concatenate([part.steps for part in parts])
    first = np.cumsum(steps) - steps  # env step with which each decision begins
    rewards = np.add.reduceat(episode.rewards, first) - cost
    expected = np.concatenate([part.rewards for part in parts])
    if not np.allclose(rewards, expected, rtol=0, atol=TOLERANCE):
        return None
    return episode
