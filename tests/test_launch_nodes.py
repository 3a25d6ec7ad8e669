# SPDX-License-Identifier: Apache-2.0
"""Runs over two nodes: that one ends right, and that it outlives the second node."""

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_two_nodes():
    """See `two_nodes`; in a process of its own, since this one may have a Ray already."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith("RAY_")}
    root = str(Path(__file__).parents[1])
    command = [sys.executable, "-c", "from tests import two_nodes; two_nodes.main()"]
    env = clean | {"PYTHONPATH": root}
    done = subprocess.run(command, env=env, cwd=root, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr[-6000:]
