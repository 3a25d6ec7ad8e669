# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""The bench of faults: what it says of a run's books, and that it hits what it says."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from accerl_lerobot.bench import faults as bench
from accerl_lerobot.bench.faults import BenchFaultsConfig, audit, markdown
from accerl_lerobot.bench.victims import Victim, await_hit, descendants, hit, title
from accerl_lerobot.errors import InputError

SLEEPS = """
import subprocess, sys, time
subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
time.sleep(60)
"""


@pytest.fixture
def sleeper():
    process = subprocess.Popen([sys.executable, "-c", SLEEPS])
    yield process
    for pid in [*descendants(process.pid), process.pid]:
        hit(pid, signal.SIGKILL)
    process.wait()


def below(pid: int) -> int:
    """The one child of a process, once it is there."""
    deadline = time.monotonic() + 30
    while not (found := descendants(pid)):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return found[0]


def test_hits_are_proved(sleeper: subprocess.Popen):
    child = below(sleeper.pid)
    assert sys.executable.split("/")[-1] in title(child) and title(2**22 + 1) == ""
    assert not await_hit(child, signal.SIGSTOP, timeout=0.05), "nothing has been done to it"
    assert hit(child, signal.SIGSTOP) and await_hit(child, signal.SIGSTOP)
    assert not await_hit(child, signal.SIGKILL, timeout=0.05)
    assert hit(child, signal.SIGKILL) and await_hit(child, signal.SIGKILL)
    assert descendants(sleeper.pid) == [], "a zombie is none"
    assert not hit(2**22 + 1, signal.SIGKILL)


def logged(folder: Path, updates: list[int], inserted: int) -> Victim:
    """A run that ended, by its files alone."""
    folder.mkdir()
    books = {"replay_inserted_segments": inserted, "replay_stored_segments": 3, "replay_evicted_segments": 4}
    books["replay_retired_segments"] = 2
    records: list[dict[str, Any]] = [{"kind": "train", "update": number} for number in updates]
    lines = [json.dumps(record) for record in [*records, {"kind": "rollout", **books}]]
    (folder / "metrics.jsonl").write_text("\n".join(lines) + '\n{"kind": "train", "up')
    victim = object.__new__(Victim)
    victim.folder = folder
    return victim


def test_books_that_add_up(tmp_path: Path):
    found = audit(logged(tmp_path / "run", [1, 2, 3, 4], 9))
    assert (found["updates"], found["lost"], found["doubled"], found["books"]) == (4, 0, 0, True)
    assert "there is none" in found["saved"]


def test_what_is_lost_or_doubled_is_found(tmp_path: Path):
    found = audit(logged(tmp_path / "run", [1, 2, 2, 5, 5, 5], 8))
    assert (found["updates"], found["lost"], found["doubled"], found["books"]) == (5, 2, 3, False)


def test_the_table_says_all_of_it():
    cell = {
        "target": "trainer", "fault": "kill", "fired": 3, "recovered": 2, "seconds": [4.0, 8.0],
        "updates": 40, "lost": 1, "doubled": 0, "books": False, "left_behind": 2, "exit": 143,
    }  # fmt: skip
    died = cell | {"error": "no successor of trainer 7: it ended\nmore", "seconds": [], "left_behind": 0}
    del died["exit"]
    rows = markdown({"cells": [cell, died]}).splitlines()
    assert rows[2] == (
        "| kill trainer | 3 | 2 | 6.0, 8.0 | 40 | 1 | 0 | DO NOT | exit 143, 2 processes left behind |"
    )
    assert rows[3].endswith("| – | 40 | 1 | 0 | DO NOT | no successor of trainer 7: it ended |")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"targets": ("everything",)}, r"targets=\('everything',\): use some of rollout, inference"),
        ({"targets": ()}, "use some of"),
        ({"faults": ("kill", "kill")}, "none twice"),
        ({"repeats": 0}, "use at least 1"),
        ({"stall_s": 1.0}, "use 5 s or more"),
    ],
)
def test_what_cannot_be_done_is_refused(options: dict[str, Any], message: str):
    with pytest.raises(InputError, match=message):
        BenchFaultsConfig(**options)


def test_nothing_is_begun_where_something_is(tmp_path: Path):
    with pytest.raises(InputError, match="the folder exists"):
        bench.bench_faults(BenchFaultsConfig(output_dir=str(tmp_path)))
    with pytest.raises(InputError, match="nothing is imagined in this recipe"):
        bench.bench_faults(BenchFaultsConfig(output_dir=str(tmp_path / "new"), targets=("dream",)))
    assert not (tmp_path / "new").exists()
