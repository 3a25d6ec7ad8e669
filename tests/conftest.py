# SPDX-License-Identifier: Apache-2.0
"""Fixtures shared by all tests: offline, and one tiny checkpoint of LeRobot's own SmolVLA class."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# A policy type in a package of its own, as if it were installed; in LeRobot's commands too.
EXAMPLE = str(Path(__file__).parents[1] / "docs" / "examples" / "lerobot_policy_smolvla_bins")
sys.path.insert(0, EXAMPLE)
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (EXAMPLE, os.environ.get("PYTHONPATH"))))

from accerl_lerobot.engine import ray_session  # noqa: E402

ray_session.prepare()


@pytest.fixture(scope="session")
def tiny_checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A random SmolVLA that fits ``SimulatedConfig()``; about 0.1 M parameters."""
    from tests.policies.checkpoints import write_smolvla

    return write_smolvla(tmp_path_factory.mktemp("tiny") / "pretrained_model")
