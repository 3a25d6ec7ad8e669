# SPDX-License-Identifier: Apache-2.0
"""Named points: nothing happens unless it is ordered, and then once, by whoever is there first."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import accerl_lerobot
from benchmarks import fault_injection
from benchmarks.fault_injection import (
    CRASHES,
    POINTS,
    FaultError,
    environment,
    handle,
    inject,
    proof,
    withdraw,
)

COMES_BY = """
import sys
from pathlib import Path
from accerl_lerobot.fault_points import fault_point
for _ in range(int(sys.argv[2])):
    fault_point(sys.argv[1], Path(sys.argv[3]))
print("went on")
"""


@pytest.fixture
def orders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """This process looks for orders here."""
    monkeypatch.setattr(fault_injection, "_orders", fault_injection._Orders(tmp_path))
    return tmp_path


def comes_by(folder: Path, point: str, times: int = 1, path: str = "") -> subprocess.CompletedProcess[str]:
    """A process of its own that reaches a point."""
    command = [sys.executable, "-c", COMES_BY, point, str(times), path]
    return subprocess.run(
        command, env=os.environ | environment(folder), capture_output=True, text=True, timeout=60, check=False
    )


def test_without_an_order_nothing_happens(orders: Path):
    assert not handle("trainer.loss") and list(orders.iterdir()) == []
    taken = inject(orders, "1", "trainer.backward", "exception")
    assert not handle("trainer.update") and proof(taken) is None
    assert withdraw(orders, "trainer.backward") and not withdraw(orders, "trainer.backward")
    handle("trainer.backward")


def test_it_happens_at_the_visit_that_was_ordered_and_once(orders: Path):
    taken = inject(orders, "1", "replay.insert", "exception", at=3)
    handle("replay.insert")
    handle("replay.insert")
    assert proof(taken) is None
    with pytest.raises(FaultError, match=r"replay\.insert"):
        handle("replay.insert")
    said = proof(taken)
    assert said is not None and said["pid"] == os.getpid() and said["point"] == "replay.insert"
    handle("replay.insert")
    inject(orders, "2", "replay.insert", "exception")
    with pytest.raises(FaultError):  # visits are counted from the order on
        handle("replay.insert")


def test_what_is_not_finite_may_last(orders: Path):
    inject(orders, "1", "trainer.loss", "nan", at=2, times=3)
    assert [handle("trainer.loss") for _ in range(6)] == [False, True, True, True, False, False]


def test_a_process_that_is_started_anew_does_not_take_it_again(tmp_path: Path):
    taken = inject(tmp_path, "1", "rollout.step", "exit", at=2)
    assert comes_by(tmp_path, "rollout.step").stdout == "went on\n" and proof(taken) is None
    first = comes_by(tmp_path, "rollout.step", times=2)
    assert (first.returncode, first.stdout) == (0, "") and proof(taken) is not None
    assert comes_by(tmp_path, "rollout.step", times=9).stdout == "went on\n"


def test_a_torn_file_has_lost_its_end_and_its_writer_is_gone(tmp_path: Path):
    files = tmp_path / "000001"
    files.mkdir()
    (files / "large").write_bytes(bytes(1000))
    (files / "small").write_bytes(bytes(10))
    inject(tmp_path / "orders", "1", "driver.renamed", "torn")
    done = comes_by(tmp_path / "orders", "driver.renamed", path=str(files))
    assert done.returncode == -signal.SIGKILL
    assert ((files / "large").stat().st_size, (files / "small").stat().st_size) == (500, 10)


def test_every_point_is_in_the_code_once_and_no_other_is():
    found = [
        point
        for path in Path(accerl_lerobot.__file__).parent.rglob("*.py")
        for point in re.findall(r'\bfault_point\("([a-z.]+)"', path.read_text())
    ]
    # Every worker's timeline is written by the same line.
    assert sorted(found) == sorted(point for point in POINTS if not point.endswith(".timeline"))
    assert all(set(faults) <= {*CRASHES, "nan", "full", "torn"} for faults in POINTS.values())
