# SPDX-License-Identifier: Apache-2.0
"""A Ray that we started ends with us, one that hangs is dropped, and one that has lost a process is seen."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import psutil
import pytest

from accerl_lerobot.engine import cluster, own_ray
from accerl_lerobot.engine.config import LaunchConfig
from accerl_lerobot.engine.contract import WorkerError
from accerl_lerobot.engine.own_ray import OwnRay, RayWatch
from accerl_lerobot.engine.ray_environment import kind_of


class Stand:
    """Stands in for `ray`, and counts."""

    def __init__(self, there: bool = False, failures: int = 0) -> None:
        self.there, self.failures, self.calls = there, failures, list[str]()

    def is_initialized(self) -> bool:
        return self.there

    def init(self, launch: LaunchConfig | None = None, **options: object) -> None:
        self.calls.append("init")
        if self.failures:
            self.failures -= 1
            raise Exception("The current node timed out\nduring startup.")  # a plain one, as Ray's
        self.there = True

    def shutdown(self) -> None:
        self.there = False
        self.calls.append("shutdown")


@pytest.fixture(autouse=True)
def none_of_the_session(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hides a Ray that other tests use in this process: without it, that one would be ended here."""
    for module in (own_ray, cluster):
        monkeypatch.setattr(module, "ray_processes", dict)


@pytest.mark.parametrize(
    ("responds", "calls"),
    [(True, ["init", "shutdown"]), (False, ["init", "shutdown", "init", "shutdown"])],
)
def test_it_is_kept_for_those_who_come_later_while_it_responds(
    responds: bool, calls: list[str], monkeypatch: pytest.MonkeyPatch
):
    stand = Stand()
    monkeypatch.setattr(own_ray, "ray", stand)
    monkeypatch.setattr(own_ray, "start_ray", stand.init)
    monkeypatch.setattr(own_ray, "_responds", lambda: responds)
    own = OwnRay(LaunchConfig())
    own.start()
    own.start()
    own.close()
    own.close()
    assert stand.calls == calls and not stand.there


def test_one_that_was_there_before_is_left_as_it_is(monkeypatch: pytest.MonkeyPatch):
    stand = Stand(there=True)
    monkeypatch.setattr(own_ray, "ray", stand)
    monkeypatch.setattr(own_ray, "start_ray", stand.init)
    monkeypatch.setattr(own_ray, "_responds", lambda: pytest.fail("it is not ours to judge"))
    own = OwnRay(LaunchConfig())
    own.start()
    own.close()
    assert stand.calls == [] and stand.there


@pytest.fixture
def raylet(monkeypatch: pytest.MonkeyPatch) -> Iterator[psutil.Process]:
    """A process that is taken for Ray's only one."""
    with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"]) as process:
        one = psutil.Process(process.pid)  # made once: there is none of a process that has gone
        monkeypatch.setattr(own_ray, "ray_processes", lambda: {one: "raylet"})
        yield one
        process.kill()


@pytest.mark.parametrize(("number", "how"), [(signal.SIGKILL, "died"), (signal.SIGSTOP, "been stopped for")])
def test_a_process_of_ray_that_is_lost_is_named_and_a_new_ray_is_started(
    number: signal.Signals, how: str, raylet: psutil.Process, monkeypatch: pytest.MonkeyPatch
):
    stand = Stand()
    monkeypatch.setattr(own_ray, "ray", stand)
    monkeypatch.setattr(own_ray, "start_ray", stand.init)
    own = OwnRay(LaunchConfig(stall_s=0.1))
    own.start()
    assert not own.lost
    raylet.send_signal(number)
    while not own.lost:
        time.sleep(0.01)
    assert own.lost.startswith(f"Ray's raylet (process {raylet.pid}) has {how}")
    own.close()
    assert own.lost and not raylet.is_running()
    monkeypatch.setattr(own_ray, "ray_processes", dict)
    own.start()
    assert not own.lost and stand.calls == ["init", "shutdown", "init"]
    own.close()


def test_who_goes_on_is_not_taken_for_stopped(raylet: psutil.Process):
    watch = RayWatch(stall_s=3600.0)
    raylet.suspend()
    while raylet.status() != psutil.STATUS_STOPPED:
        time.sleep(0.01)
    assert not watch.look() and watch._stopped
    raylet.resume()
    while watch._stopped:
        assert not watch.look()
    watch.close()


HANGS = """
import os, signal, sys, time
import psutil
from accerl_lerobot import guardian
from accerl_lerobot.engine import own_ray
gcs_server = psutil.Process(int(sys.argv[1]))
own_ray.ray_processes = lambda: {gcs_server: "gcs_server"}
own_ray.kill_ray = lambda processes: None
own_ray.GIVE_UP_S = 0.1
guardian.explain(remedy="to go on: accerl train --resume=true")
own_ray.RayWatch(300.0)
os.kill(int(sys.argv[1]), signal.SIGKILL)
time.sleep(600)
"""


def test_a_main_thread_that_hangs_in_ray_does_not_keep_the_process(raylet: psutil.Process):
    command = [sys.executable, "-c", HANGS, str(raylet.pid)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240)
    said = f"accerl: Ray's gcs_server (process {raylet.pid}) has died; to go on: accerl train --resume=true"
    assert (done.returncode, done.stderr.splitlines()[-1:]) == (1, [said])


@pytest.mark.parametrize("failures", [2, cluster.STARTS])
def test_a_ray_that_does_not_start_is_started_again_a_few_times(
    failures: int, monkeypatch: pytest.MonkeyPatch
):
    stand = Stand(failures=failures)
    monkeypatch.setattr(cluster, "ray", stand)
    monkeypatch.setattr(cluster.time, "sleep", lambda seconds: None)
    if failures < cluster.STARTS:
        cluster.start_ray()
        assert stand.there and stand.calls.count("init") == failures + 1
        return
    with pytest.raises(WorkerError) as raised:
        cluster.start_ray()
    assert str(raised.value) == (
        f"Ray did not start in {failures} attempts: The current node timed out during startup."
    )


def test_rays_own_processes_are_told_from_its_workers():
    assert kind_of(["/x/ray/core/src/ray/raylet/raylet", "--raylet_socket_name=x"]) == "raylet"
    assert kind_of(["python", "-u", "/x/ray/_private/log_monitor.py"]) == "log monitor"
    assert kind_of(["ray::DashboardAgent" + " " * 90]) == "dashboard agent"
    assert kind_of(["python", "/x/ray/_private/workers/default_worker.py", "--raylet=/x"]) is None
    assert kind_of(["ray::RolloutWorker"]) is None and kind_of([]) is None
