# SPDX-License-Identifier: Apache-2.0
"""A cluster of two nodes on this machine, and runs that join it.

What is here is called by ``test_launch_nodes.py`` in a process of its own, as one process has one Ray. The
second node is a Ray node like any other: a raylet, an object store, workers. Messages go over TCP, as between
machines.
"""

import contextlib
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from accerl_lerobot.engines import ray_session

ray_session.prepare()

import pytest  # noqa: E402
import ray  # noqa: E402
from ray.cluster_utils import Cluster  # noqa: E402

from accerl_lerobot.algorithms.config import TrainerConfig  # noqa: E402
from accerl_lerobot.engines import ray_engine  # noqa: E402
from accerl_lerobot.engines.config import LaunchConfig  # noqa: E402
from accerl_lerobot.engines.ray_engine import RayEngine  # noqa: E402
from accerl_lerobot.engines.stopping import WorkerError  # noqa: E402
from accerl_lerobot.evaluation import evaluation_plans  # noqa: E402
from accerl_lerobot.inference import worker as inference_worker  # noqa: E402
from accerl_lerobot.rollout.runner import RolloutConfig  # noqa: E402
from accerl_lerobot.trainer import worker as trainer_worker  # noqa: E402
from benchmarks.simulated_environment import LatencyConfig  # noqa: E402
from tests.light_workers import LightInference, LightTrainer  # noqa: E402
from tests.runs import collect, drive, polls, tiny_run, until  # noqa: E402

NOTICED_SOON = {"health_check_initial_delay_ms": 1000, "health_check_period_ms": 1000,
                "health_check_timeout_ms": 2000, "health_check_failure_threshold": 3}  # fmt: skip
SLOW = LatencyConfig(max_steps=16, frame_ms=8.0)
FOUR = RolloutConfig(workers=4, environments=2, segment_length=3)


@contextmanager
def two_nodes() -> Iterator[tuple[Cluster, Any]]:
    """The cluster, and its second node, which has a resource ``sim``."""
    made = Cluster()
    try:
        made.add_node(
            num_cpus=2, include_dashboard=False, _system_config=NOTICED_SOON, node_ip_address="127.0.0.1"
        )
        second = made.add_node(num_cpus=2, resources={"sim": 1}, node_ip_address="127.0.0.1")
        yield made, second
    finally:
        ray.shutdown()
        made.shutdown()


def engine(address: str, nodes: str, updates: int, max_restarts: int = 0) -> RayEngine:
    """A run with its rollout workers on these nodes."""
    launch = LaunchConfig(
        address=address, placement={"rollout": nodes}, stall_s=60.0, max_restarts=max_restarts
    )
    config = tiny_run(
        Path("nowhere"),
        env=SLOW,
        rollout=FOUR,
        trainer=TrainerConfig(updates=updates, batch_decisions=16),
        launch=launch,
    )
    return RayEngine(config, ("match",))


def parent(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def raylet(node: Any) -> int:
    """Process id."""
    return int(node.all_processes["raylet"][0].process.pid)


def a_run_over_two_nodes_ends_right(made: Cluster, second: Any) -> None:
    """Each worker is where it was sent, and of the run nothing is left but the cluster."""
    one = engine(made.address, "sim", updates=12)
    pids = one.pids()
    first = {name for name, pid in pids.items() if parent(pid) == raylet(made.head_node)}
    assert first == {"inference", "replay", "trainer"}
    assert {name for name, pid in pids.items() if parent(pid) == raylet(second)} == pids.keys() - first
    assert ray.get(ray.remote(lambda: os.environ["OMP_NUM_THREADS"]).remote()) == "1"
    one.plan(evaluation_plans(("match",), 6, "before"))
    assert sorted(r.plan.index for r in collect(one, "before", 6)) == list(range(6))
    one.train()
    history = drive(one)
    assert [u["update"] for p in history for u in p.updates] == [i + 1.0 for i in range(12)]
    assert history[-1].rollout["restarts"] == 0
    one.close()
    deadline = time.monotonic() + 30
    while left := [name for name, pid in pids.items() if Path(f"/proc/{pid}").exists()]:
        assert time.monotonic() < deadline, left
        time.sleep(0.1)
    assert not ray.is_initialized() and second.all_processes["raylet"][0].process.poll() is None


def a_node_that_leaves_takes_nothing_along(made: Cluster, second: Any) -> None:
    """Ray starts its rollout workers again on the first one."""
    one = engine(made.address, "all", updates=1_000_000, max_restarts=3)
    pids = one.pids()
    there = {name for name, pid in pids.items() if parent(pid) == raylet(second)}
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
    assert {parent(pid) for pid in pids.values()} == {raylet(made.head_node)}
    one.close()


def main() -> None:
    """All of it; an assertion ends the process, and its traceback says which."""
    monkeypatch = pytest.MonkeyPatch()
    monkeypatch.setattr(ray_engine, "POLL_S", 0.1)
    monkeypatch.setattr(inference_worker, "InferenceWorker", LightInference)
    monkeypatch.setattr(trainer_worker, "TrainerWorker", LightTrainer)
    with two_nodes() as (made, second):
        a_run_over_two_nodes_ends_right(made, second)
        a_node_that_leaves_takes_nothing_along(made, second)
