# SPDX-License-Identifier: Apache-2.0
"""A run whose weights go straight from the trainer to each inference service, through gloo.

Two services; one is killed in mid-run, and the one that takes its place gets the newest weights.
"""

from __future__ import annotations

import os
import signal
from pathlib import Path

import psutil

from accerl_lerobot.config import LaunchConfig
from accerl_lerobot.inference.worker import InferenceConfig
from accerl_lerobot.launch import RayEngine
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.trainer.config import TrainerConfig
from tests.runs import polls, tiny_run
from tests.test_ray_environment import LOOPBACK, listening


def ports(pid: int) -> int:
    """At how many a process listens."""
    return sum(c.status == "LISTEN" for c in psutil.Process(pid).net_connections("tcp"))


def test_updates_go_on_and_acting_and_learning_agree(tiny_checkpoint: Path):
    config = tiny_run(
        tiny_checkpoint,
        launch=LaunchConfig(weights="gloo", transport="ray"),
        inference=InferenceConfig(workers=2),
        rollout=RolloutConfig(workers=2, worlds=2, segment_length=3),
        trainer=TrainerConfig(
            updates=100_000, batch_decisions=16, warmup_updates=0, value_warmup_updates=1, probe_every=3
        ),
    )
    engine = RayEngine(config, ("match",))
    try:
        pids = engine.pids()
        engine.train()
        mismatches: list[float] = []
        addresses: set[str] = set()
        lost_at = back_at = 0
        for progress in polls(engine):
            found = [u["logprob/mismatch_max"] for u in progress.updates if "logprob/mismatch_max" in u]
            mismatches += found if not lost_at or back_at else []
            served = progress.inference.get("version", 0.0)
            if not lost_at and served >= 4:
                addresses = set(listening())
                # For each service a place to meet and one end of a pair; a rollout worker has what Ray opens.
                assert ports(pids["trainer"]) >= ports(pids["rollout 0"]) + 4
                lost_at = progress.version
                os.kill(pids["inference 1"], signal.SIGKILL)
            if lost_at and not back_at and progress.inference["restarts"] and engine.pids()["inference 1"]:
                back_at = progress.version if all(engine._inference.up) else 0
            if back_at and served > back_at + 3 and len(mismatches) >= 4:
                break
        assert max(mismatches) <= 1e-4
        assert addresses and addresses <= LOOPBACK
    finally:
        engine.close()
