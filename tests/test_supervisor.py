# SPDX-License-Identifier: Apache-2.0
"""An actor under supervision."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import psutil
import pytest

from accerl_lerobot.engine import launch, replicas
from accerl_lerobot.engine.launch import end_all
from accerl_lerobot.engine.replicas import WorkerSlot


class Stand:
    """Stands in for `ray`: every reference is its own answer, and nobody is killed."""

    def get(self, reference: Any, timeout: float) -> Any:
        return reference

    def kill(self, actor: Any) -> None:
        pass


@pytest.mark.parametrize("here", [True, False])
def test_only_a_process_of_this_node_is_ended_by_its_number(here: bool, monkeypatch: pytest.MonkeyPatch):
    for module in (launch, replicas):
        monkeypatch.setattr(module, "ray", Stand())
    monkeypatch.setattr(launch, "GONE_S", 0.2)
    with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"]) as process:
        worker = WorkerSlot("somebody")
        worker.await_start(process.pid, 1.0, here)
        assert (worker.process == psutil.Process(process.pid)) is here
        end_all([worker])
        assert (process.poll() is not None) is here
        process.kill()
