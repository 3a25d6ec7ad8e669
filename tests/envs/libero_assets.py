# SPDX-License-Identifier: Apache-2.0
"""Where tests find LIBERO's meshes, which are not part of this repository."""

import importlib.util
import os
from pathlib import Path

import pytest

ASSETS = os.environ.get("LIBERO_ASSETS", "")

needs_assets = pytest.mark.skipif(
    importlib.util.find_spec("libero") is None or not (Path(ASSETS) / "scenes").is_dir(),
    reason="LIBERO is not tested: install accerl-lerobot[libero] and name its assets in LIBERO_ASSETS",
)
