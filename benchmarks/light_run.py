# SPDX-License-Identifier: Apache-2.0
"""A run in which all is real but what takes long: `accerl train` with environments and a policy made of time.

    python -m benchmarks.light_run --config_path=light.yaml --output_dir=RUN

Its processes, checkpoints, journal, recoveries and `--resume` are those of any run; no process of it imports
LeRobot or a simulator, so it starts in seconds. That is what faults are tried on, again and again.
"""

from __future__ import annotations

import functools
import logging
import os
import sys

from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.engines.config import LaunchConfig, RunConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.evaluation import EvaluationConfig
from accerl_lerobot.policies.config import Load, PolicyConfig
from accerl_lerobot.replay.buffer import ReplayConfig
from accerl_lerobot.rollout.runner import RolloutConfig
from benchmarks.simulated_environment import LatencyConfig

BATCH = 16
"""Decisions of an update."""


def light_config(
    *, updates: int, ranks: int = 1, stall_s: float = 10.0, save_every_s: float = 2.0
) -> RunConfig:
    """Some ten updates a second, most of which is slept."""
    return RunConfig(
        job_name="light",
        env=LatencyConfig(max_steps=32, frame_ms=40.0, latency_cv=0.5),
        policy=PolicyConfig(path="made of time", device="cpu"),
        rollout=RolloutConfig(workers=2, environments=4, segment_length=4),
        replay=ReplayConfig(
            capacity=512, min_decisions=32, max_unlearned_decisions=64, samples_per_insert=1.0
        ),
        trainer=TrainerConfig(
            updates=updates,
            batch_decisions=BATCH,
            lr=0.02,
            value_lr=0.02,
            warmup_updates=5,
            value_warmup_updates=2,
            ranks=ranks,
        ),
        evaluation=EvaluationConfig(episodes=100, before=False, videos=0),
        launch=LaunchConfig(stall_s=stall_s, max_restarts=1_000_000),
        save_every_s=save_every_s,
    )


def light_policy() -> Load:
    """Makes the stand-in for LeRobot's policy."""
    from benchmarks.simulated_policy import SimulatedPolicyConfig, load_simulated

    return functools.partial(load_simulated, SimulatedPolicyConfig(decide_ms=2.0, update_ms=60.0))


def main(arguments: list[str]) -> int:
    """As ``accerl train``; returns the exit code."""
    from accerl_lerobot.cli.verbs import train

    level = os.environ.get("ACCERL_LOG", "WARNING")
    logging.basicConfig(level=level, format="%(levelname)s %(name)s: %(message)s")
    try:
        return train(arguments, light_policy())
    except InputError as error:
        sys.stderr.write(f"light_run: {error}\n")
        return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
