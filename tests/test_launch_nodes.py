# SPDX-License-Identifier: Apache-2.0
"""Runs that join a cluster of two nodes: that one ends right, and that it outlives the second node.

The second node is a Ray node like any other. Messages go over TCP, as between machines.
"""

import contextlib
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import psutil
import pytest
import ray
from ray.cluster_utils import Cluster

from accerl_lerobot.engines.ray_engine import RayEngine
from accerl_lerobot.engines.stopping import WorkerError
from accerl_lerobot.evaluation import evaluation_plans
from benchmarks.simulated_environment import LatencyConfig
from tests.light_workers import LightInference, LightTrainer
from tests.runs import collect, drive, eventually, polls, tiny_run, until, updates

NOTICED_SOON = {"health_check_initial_delay_ms": 1000, "health_check_period_ms": 1000,
                "health_check_timeout_ms": 2000, "health_check_failure_threshold": 3}  # fmt: skip


@contextmanager
def two_nodes() -> Iterator[tuple[Cluster, Any]]:
    """The cluster, and its second node, which has a resource ``sim``."""
    made = Cluster()
    here = {"num_cpus": 2, "node_ip_address": "127.0.0.1"}
    try:
        made.add_node(**here, include_dashboard=False, _system_config=NOTICED_SOON)
        yield made, made.add_node(**here, resources={"sim": 1})
    finally:
        ray.shutdown()
        made.shutdown()


def engine(address: str, nodes: str, updates: int, max_restarts: int = 0) -> RayEngine:
    launch = {"address": address, "placement": {"rollout": nodes}, "max_restarts": max_restarts}
    config = tiny_run(
        Path("nowhere"),
        env=LatencyConfig(max_steps=16, frame_ms=8.0),
        rollout={"workers": 4, "environments": 2},
        trainer={"updates": updates},
        launch=launch | {"stall_s": 60.0},
    )
    return RayEngine(config, ("match",))


def workers_of(node: Any, pids: dict[str, int]) -> set[str]:
    raylet = node.all_processes["raylet"][0].process.pid
    return {name for name, pid in pids.items() if psutil.Process(pid).ppid() == raylet}


def a_run_over_two_nodes_ends_right(made: Cluster, second: Any) -> None:
    one = engine(made.address, "sim", updates=12)
    pids = one.pids()
    first = {"inference", "replay", "trainer"}
    assert workers_of(made.head_node, pids) == first and workers_of(second, pids) == pids.keys() - first
    assert ray.get(ray.remote(lambda: os.environ["OMP_NUM_THREADS"]).remote()) == "1"
    one.plan(evaluation_plans(("match",), 6, "before"))
    assert sorted(r.plan.index for r in collect(one, "before", 6)) == list(range(6))
    one.train()
    history = drive(one)
    assert [u["update"] for u in updates(history)] == [i + 1.0 for i in range(12)]
    assert history[-1].rollout["restarts"] == 0
    one.close()
    assert eventually(lambda: not any(map(psutil.pid_exists, pids.values())), 30)
    assert not ray.is_initialized() and second.all_processes["raylet"][0].process.poll() is None


def a_node_that_leaves_takes_nothing_along(made: Cluster, second: Any) -> None:
    one = engine(made.address, "all", updates=1_000_000, max_restarts=3)
    pids = one.pids()
    there = workers_of(second, pids)
    assert there and there < {f"rollout {i}" for i in range(4)}
    one.train()
    until(one, 2)
    one.plan(evaluation_plans(("match",), 24, "during"))
    results = list(one.poll().episodes)
    made.remove_node(second, allow_graceful=False)
    for progress in polls(one):
        results += progress.episodes
        finished = sum(r.plan.group == "during" for r in results) >= 24
        if progress.rollout["restarts"] >= len(there) and finished:
            break
    assert sorted(r.plan.index for r in results if r.plan.group == "during") == list(range(24))
    until(one, progress.version + 3)
    pids = {}
    for _ in polls(one):
        with contextlib.suppress(WorkerError):  # the last one may be starting still
            pids = one.pids()
            break
    assert workers_of(made.head_node, pids) == pids.keys() and pids
    one.close()


def main() -> None:
    with (
        patch("accerl_lerobot.engines.ray_engine.POLL_S", 0.1),
        patch("accerl_lerobot.inference.worker.InferenceWorker", LightInference),
        patch("accerl_lerobot.trainer.worker.TrainerWorker", LightTrainer),
        two_nodes() as (made, second),
    ):
        a_run_over_two_nodes_ends_right(made, second)
        a_node_that_leaves_takes_nothing_along(made, second)


@pytest.mark.slow
def test_two_nodes():
    """In a process of its own, since this one may have a Ray already."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith("RAY_")}
    root = str(Path(__file__).parents[1])
    code = (
        "from accerl_lerobot.engines import ray_session; ray_session.prepare();"
        "from tests.test_launch_nodes import main; main()"
    )
    env = clean | {"PYTHONPATH": root}
    done = subprocess.run(
        [sys.executable, "-c", code], env=env, cwd=root, capture_output=True, text=True, timeout=240
    )
    assert done.returncode == 0, done.stderr[-6000:]
