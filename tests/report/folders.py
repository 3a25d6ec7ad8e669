# SPDX-License-Identifier: Apache-2.0
"""Folders of runs, written as runs write them, with numbers that tests choose."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from accerl_lerobot.algorithms import PPOConfig
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.engines.config import RunConfig, encode
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.evaluation import Rate

EPISODES = 100
"""Episodes of each evaluation."""
HOSTILE = "<script>document.title = 'owned'</script>\"'><img src=x onerror=\"document.title = 'owned'\">"
"""Hostile names of a task, or any other text of a run."""


def run_config(**fields: Any) -> RunConfig:
    """A recipe on the simulated environment."""
    defaults: dict[str, Any] = {"env": SimulatedConfig(), "trainer": TrainerConfig(updates=40)}
    return RunConfig(**{**defaults, **fields})


def ppo(**fields: Any) -> RunConfig:
    """The same with another algorithm."""
    return run_config(algorithm=PPOConfig(), **fields)


def write_run(
    folder: Path,
    *,
    config: RunConfig | None = None,
    tasks: Sequence[str] = ("door-open-v3",),
    successes: tuple[int, int] = (40, 90),
    finished: bool = True,
    rollout: dict[str, Any] | None = None,
    train: dict[str, Any] | None = None,
) -> Path:
    """A run of ``accerl train`` with an evaluation before and, if `finished`, after.

    `rollout` and `train` are further numbers of each record of the workers and of the trainer.
    """
    folder.mkdir(parents=True)
    config = config or run_config()
    (folder / "config.yaml").write_text(yaml.safe_dump(encode(config), sort_keys=False))
    updates = config.trainer.updates
    evaluations = [evaluation("before", 0.0, successes[0], tasks)]
    lines = [{"kind": "evaluation", "wall_s": 5.0, "update": 0, **evaluations[0]}]
    for update in range(1, updates + 1):
        lines += [train_record(update) | (train or {}), rollout_record(update, rollout or {})]
    if finished:
        evaluations.append(evaluation("after", 100.0 * updates, successes[1], tasks))
        lines.append({"kind": "evaluation", "wall_s": 12.0 + updates, "update": updates, **evaluations[1]})
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    if finished:
        (folder / "summary.json").write_text(json.dumps(summary(config, evaluations, tasks)) + "\n")
        (folder / "checkpoints" / "last" / "pretrained_model").mkdir(parents=True)
    return folder


def evaluation(group: str, steps: float, successes: int, tasks: Sequence[str]) -> dict[str, Any]:
    n = EPISODES
    rate = {"success": successes / n, "n": n, "ci95": [*Rate(successes=successes, n=n).interval()]}
    return {
        **rate,
        "steps_mean": 10.0,
        "env_steps": steps,
        "group": group,
        "tasks": {task: {**rate, "n": n // len(tasks)} for task in tasks},
    }


def train_record(update: int) -> dict[str, Any]:
    """One update a second, of which a quarter is spent waiting."""
    return {
        "kind": "train", "wall_s": 10.0 + update, "update": float(update),
        "policy_loss": math.sin(update / 7),
        "value_loss": 1 / update, "kl": 0.01, "approx_kl": 0.02, "clip_fraction": 0.1, "low_weight": 0.0,
        "ess": 0.9, "explained_variance": 0.5, "grad_norm": 2.0, "lr": 1e-4, "return_mean": 0.3,
        "lag_mean": 3.0 + update % 2, "lag_max": 7.0 + update % 3, "ratio_max_dev": 0.1, "skipped": 0.0,
        "wait_s": 0.25, "update_s": 0.7, "publish_s": 0.05,
    }  # fmt: skip


def rollout_record(update: int, more: dict[str, Any]) -> dict[str, Any]:
    """100 env steps and one episode a second, after the evaluation's of 10 steps each."""
    return {
        "kind": "rollout", "wall_s": 10.0 + update, "update": update, "restarts": 0.0,
        "env_steps": 10.0 * EPISODES + 100.0 * update, "decisions": EPISODES + 10.0 * update,
        "episodes": EPISODES + float(update), "success_exploring": min(1.0, 0.2 + update / 100),
        "inference_batches": 5.0 * update, "inference_batch_size_mean": 3.0,
        "inference_wait_mean_s": 0.002, "inference_busy_share": 0.3, **more,
    }  # fmt: skip


def summary(config: RunConfig, evaluations: Sequence[dict[str, Any]], tasks: Sequence[str]) -> dict[str, Any]:
    updates = config.trainer.updates
    found = {
        f"{name}_{when}": one[key]
        for when, one in zip(("before", "after"), evaluations, strict=True)
        for name, key in (("success", "success"), ("n", "n"), ("ci95", "ci95"), ("tasks", "tasks"))
    }
    return {
        **found, "env_steps": 100 * updates, "episodes": updates, "updates": updates, "wall_s": 75.0,
        "warm_start_s": 5.0, "rl_s": 60.0, "algorithm": config.algorithm.type, "seed": config.seed,
        "tasks": list(tasks),
    }  # fmt: skip
