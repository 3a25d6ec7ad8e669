# SPDX-License-Identifier: Apache-2.0
"""Files from untrusted sources that abort, hang or fill the memory of whoever loads them."""

from __future__ import annotations

import json
import logging
import os
import resource
import shutil
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save_file

from accerl_lerobot.checkpoint import isolation
from accerl_lerobot.checkpoint.isolation import rehearse
from accerl_lerobot.checkpoint.safety import MIB, FileSource
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies import loading
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.loading import rehearsed_config
from tests.policies.checkpoints import edit_config

ORIGIN = FileSource("policy.path", "theirs")


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(isolation, "CPU_S", 3)


def refused(task: Callable[[], object], folder: Path, why: str) -> None:
    with pytest.raises(InputError, match=f"^policy.path='theirs': .*{why}") as caught:
        rehearse(task, folder, ORIGIN)
    assert "\n" not in str(caught.value)


class Panic(BaseException):
    """No `Exception`, as those of Rust."""


def panic() -> None:
    raise Panic("regex backtracked\ntoo often")


def refuse() -> None:
    raise InputError("policy.path", 7, "use another")


@pytest.mark.parametrize(
    ("task", "why"),
    [
        (os.abort, "ends the process with SIGABRT; the size of its files does not account for that"),
        (lambda: os.kill(os.getpid(), signal.SIGSEGV), "ends the process with SIGSEGV"),
        (lambda: os._exit(3), "ends the process with code 3"),
        (lambda: os.kill(os.getpid(), signal.SIGKILL), "takes more than 3 s of processor time"),
        (lambda: exec("while True: pass"), "takes more than 3 s of processor time"),
        (lambda: b"x" * 2**33, f"takes more than {isolation.SLACK // MIB} MiB beside the libraries"),
        (lambda: np.ones(2**33), "takes more than .* MiB"),
        (panic, "fails with Panic: regex backtracked … too often"),
    ],
)
def test_however_a_child_ends_its_parent_gets_a_line(tmp_path: Path, task: Callable[[], object], why: str):
    refused(task, tmp_path, why)


def test_the_line_of_a_check_is_passed_on(tmp_path: Path):
    with pytest.raises(InputError) as caught:
        rehearse(refuse, tmp_path, ORIGIN)
    assert str(caught.value) == "policy.path='7': use another"


def test_its_warnings_are_passed_on(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    def warn() -> int:
        logging.getLogger("accerl_lerobot.x").warning("it %s", "is odd")
        return 3

    assert rehearse(warn, tmp_path, ORIGIN) == 3
    assert [(r.name, r.getMessage()) for r in caplog.records] == [("accerl_lerobot.x", "it is odd")]


def test_a_child_that_waits_for_ever_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(isolation, "PATIENCE", 0.4)
    refused(lambda: time.sleep(1000), tmp_path, "takes more than 1 s")


def test_a_child_that_waits_for_a_lock_of_the_fork_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Held by a thread of the parent at the first fork, free at the second."""
    monkeypatch.setattr(isolation, "IDLE_S", 0.5)
    lock, forks = threading.Lock(), 0
    fork = os.fork

    def counted() -> int:
        nonlocal forks
        forks += 1
        if forks == 1:
            lock.acquire()
        child = fork()
        if forks == 1 and child:
            lock.release()
        return child

    monkeypatch.setattr(os, "fork", counted)

    def task() -> str:
        with lock:
            return "loaded"

    assert rehearse(task, tmp_path, ORIGIN) == "loaded" and forks == 2


def test_a_child_that_works_is_not_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(isolation, "IDLE_S", 0.5)
    started = tmp_path / "started"

    def work() -> int:
        started.write_text(started.read_text() + "x" if started.exists() else "x")
        until = time.process_time() + 2
        while time.process_time() < until:
            pass
        return len(started.read_text())

    assert rehearse(work, tmp_path, ORIGIN) == 1


def test_what_is_good_leaves_nothing_behind(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    def held() -> tuple[list[str], list[str]]:
        children = (path.read_text() for path in Path("/proc/self/task").glob("*/children"))
        return sorted(os.listdir("/proc/self/fd")), sorted(children)

    before = held()
    rehearse(lambda: os.write(1, b"loading") + os.write(2, b"loading"), tmp_path, ORIGIN)
    assert held() == before and capfd.readouterr() == ("", "")


def test_limits_grow_with_the_weights(tmp_path: Path):
    save_file({"a": np.zeros((1000, 1000), np.float16)}, tmp_path / "x.safetensors")

    def look() -> None:
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        memory, cpu_s = (resource.getrlimit(n)[0] for n in (resource.RLIMIT_AS, resource.RLIMIT_CPU))
        extra = memory - taken - isolation.SLACK
        assert 0.9 * 8_000_000 <= extra <= 8_001_000 and cpu_s == 3, (extra, cpu_s)

    rehearse(look, tmp_path, ORIGIN)


@pytest.fixture
def theirs(tiny_checkpoint: Path, tmp_path: Path) -> Path:
    """A small SmolVLA, and its tokeniser, to be changed."""
    path = Path(shutil.copytree(tiny_checkpoint, tmp_path / "policy"))
    old = json.loads((path / "config.json").read_text())["vlm_model_name"]
    shutil.copytree(old, tmp_path / "backbone")
    for file in path.glob("*.json"):
        file.write_text(file.read_text().replace(old, str(tmp_path / "backbone")))
    return path


def tokenizer_length(path: Path, length: int) -> None:
    file = path / "policy_preprocessor.json"
    content = json.loads(file.read_text())
    for step in content["steps"]:
        if step["registry_name"] == "tokenizer_processor":
            step["config"] |= {"max_length": length, "padding": "max_length"}
    file.write_text(json.dumps(content))


def normalizer(path: Path, step: dict[str, Any]) -> None:
    file = path.parent / "backbone" / "tokenizer.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"normalizer": step}))


GROWS = {"type": "Replace", "pattern": {"String": "a"}, "content": "a" * 1000}
BACKTRACKS = {"type": "Replace", "pattern": {"Regex": r"(?:(?:[a-z ]|[a-zA-Z ])+)+[^\s\S]"}, "content": "x"}


def test_a_good_checkpoint_is_tried_once(theirs: Path, monkeypatch: pytest.MonkeyPatch):
    config = PolicyConfig(path=str(theirs), device="cpu")
    assert rehearsed_config(config).type == "smolvla"
    monkeypatch.setattr(loading, "rehearse", None)
    assert rehearsed_config(config).type == "smolvla"


@pytest.mark.parametrize(
    "change",
    [
        lambda path: tokenizer_length(path, 10**10),
        lambda path: normalizer(path, {"type": "Sequence", "normalizers": 5 * [GROWS]}),
        lambda path: normalizer(path, BACKTRACKS),
        lambda path: edit_config(path, prefix_length=10**9),
        lambda path: edit_config(path, chunk_size=10**9),
    ],
)  # fmt: skip
def test_checkpoints_that_nobody_can_load_are_refused_in_a_line(
    theirs: Path, change: Callable[[Path], object]
):
    config = PolicyConfig(path=str(theirs), device="cpu")
    change(theirs)
    with pytest.raises(InputError) as caught:
        rehearsed_config(config)
    assert str(caught.value).startswith(f"policy.path='{theirs}': ") and "\n" not in str(caught.value)
