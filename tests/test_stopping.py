# SPDX-License-Identifier: Apache-2.0
"""Signals are noted, or heeded at once; processes that simulate end with their parent."""

import contextlib
import multiprocessing
import os
import secrets
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from accerl_lerobot.demos.record import simulated
from accerl_lerobot.engines.config import RunConfig
from accerl_lerobot.engines.stopping import StoppedError, Stopping, handled
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.envs.base import Environment
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import PolicyConfig, TuningConfig
from accerl_lerobot.run.resuming import continued
from tests.runs import eventually


def play(environment: Environment, seconds: int) -> bool:
    time.sleep(seconds)
    return signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_simulators_end_at_once_when_their_parent_is_interrupted():
    before = set(multiprocessing.active_children())
    with pytest.raises(KeyboardInterrupt), simulated(SimulatedConfig(), play, [0, 3600]) as results:
        assert next(results) and set(multiprocessing.active_children()) - before
        raise KeyboardInterrupt
    assert eventually(lambda: not set(multiprocessing.active_children()) - before)


KILLED = """
import os, signal
from accerl_lerobot.demos.record import simulated
from accerl_lerobot.envs import SimulatedConfig
from tests.test_stopping import play

if __name__ == "__main__":
    with simulated(SimulatedConfig(), play, [0, 3600]) as results:
        next(results)
        os.kill(os.getpid(), signal.SIGKILL)
"""


def test_simulators_end_when_their_parent_is_killed(tmp_path: Path):
    program = tmp_path / "parent.py"
    program.write_text(KILLED)
    mark = secrets.token_hex(8)
    environment = os.environ | {"PYTHONPATH": os.getcwd(), "ACCERL_TEST": mark}
    subprocess.run([sys.executable, str(program)], env=environment, timeout=240)
    assert eventually(lambda: not marked(mark))


def marked(mark: str) -> list[int]:
    """Processes whose environment has a mark, but for Python's own trackers of what they share."""
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            tracker = any("resource_tracker" in word for word in process.cmdline())
            if process.environ().get("ACCERL_TEST") == mark and not tracker:
                found.append(process.pid)
    return found


def test_a_signal_is_noted_first_and_interrupts_when_it_comes_again():
    """Handlers of a library that starts are taken back."""
    stop = Stopping()
    with pytest.raises(KeyboardInterrupt), handled(stop.note):
        with handled():
            signal.signal(signal.SIGTERM, lambda number, frame: pytest.fail("a handler of its own"))
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.asked == signal.SIGTERM
        os.kill(os.getpid(), signal.SIGTERM)
        pytest.fail("it goes on")


@pytest.mark.parametrize("before", [False, True])
def test_where_nothing_can_be_saved_the_first_signal_interrupts(before: bool):
    stop = Stopping("a command")
    with handled(stop.note):
        if before:
            os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(StoppedError, match="stopped by SIGINT; to resume: a command"), stop.at_once():
            os.kill(os.getpid(), signal.SIGINT)
            pytest.fail("it goes on")
        assert stop.asked == signal.SIGINT


@pytest.mark.parametrize("name", ["here", "alice/start", "gone"])
def test_low_rank_adapters_need_the_policy_that_they_adapt(name: str, tmp_path: Path):
    path = name if "/" in name else str(tmp_path / name)
    (tmp_path / "here").mkdir()
    config = RunConfig(policy=PolicyConfig(path=path, tuning=TuningConfig(mode="lora")))
    missing = pytest.raises(InputError, match=r"^policy\.path=.*gone': the policy that this run began from")
    with missing if name == "gone" else contextlib.nullcontext():
        assert continued(config, tmp_path, tmp_path / "checkpoints" / "000001").policy.path == path
