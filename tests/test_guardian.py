# SPDX-License-Identifier: Apache-2.0
"""Whatever ends a process, nothing that it has started is left; signals are noted, or heeded at once."""

import contextlib
import multiprocessing
import os
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

PARENT = """
import multiprocessing, os, signal, subprocess, sys, time
from pathlib import Path
from accerl_lerobot import guardian

def child(semaphore):
    subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])  # it has no parent soon
    time.sleep(600)

if __name__ == "__main__":
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # whoever started the tests may ignore it
    guardian.start()
    folder = Path(sys.argv[1])
    folder.mkdir()
    guardian.remove(folder)
    context = multiprocessing.get_context("spawn")
    semaphore = context.Semaphore()
    context.Process(target=child, args=(semaphore,), daemon=True).start()
    Path(sys.argv[2]).write_text(semaphore._semlock.name + " " + os.environ[guardian.MARK])
    guardian._process.terminate()  # as by a scheduler, which asks all processes to stop
    if sys.argv[3] == "return":
        sys.exit(0)
    os.kill(os.getpid(), signal.Signals[sys.argv[3]])
"""


def below(mark: str) -> list[psutil.Process]:
    """Processes that have a mark in their environment; those that have ended have none."""
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            if mark in process.environ().get("ACCERL_GUARDED_BY", "").split():
                found.append(process)
    return found


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /dev/shm")
@pytest.mark.parametrize("how", ["SIGKILL", "SIGHUP", "return"])
def test_nothing_is_left_however_a_process_ends(how: str, tmp_path: Path):
    program, folder, note = tmp_path / "parent.py", tmp_path / "folder", tmp_path / "note"
    program.write_text(PARENT)
    command = [sys.executable, str(program), str(folder), str(note), how]
    subprocess.run(command, capture_output=True, timeout=240)  # waits for the guardian, too
    semaphore, mark = note.read_text().rsplit(" ", 1)
    assert eventually(lambda: not below(mark) and not folder.exists())
    assert eventually(lambda: not Path(f"/dev/shm/sem.{semaphore.strip('/')}").exists())


def play(environment: Environment, seconds: int) -> bool:
    time.sleep(seconds)
    return signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_simulators_end_at_once_when_their_parent_is_interrupted():
    before = set(multiprocessing.active_children())
    with pytest.raises(KeyboardInterrupt), simulated(SimulatedConfig(), play, [0, 3600]) as results:
        assert next(results) and set(multiprocessing.active_children()) - before
        raise KeyboardInterrupt
    assert eventually(lambda: not set(multiprocessing.active_children()) - before)


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
