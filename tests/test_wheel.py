# SPDX-License-Identifier: Apache-2.0
"""The wheel holds all that a run outside of the repository needs."""

import os
import subprocess
import sys
from pathlib import Path

from tests.runs import pip_installed

ROOT = Path(__file__).parents[1]


def test_the_wheel_holds_recipes_and_all_that_is_not_code(tmp_path: Path):
    pip_installed(tmp_path, ROOT)
    command = [sys.executable, "-m", "accerl_lerobot.cli", "train", "--config_path=quickstart"]
    options = {"env": os.environ | {"PYTHONPATH": str(tmp_path)}, "cwd": tmp_path}
    done = subprocess.run([*command, "--trainer.updates=-1"], capture_output=True, text=True, **options)
    assert done.returncode == 2 and done.stderr.startswith("accerl: trainer.updates=-1"), done.stderr
    here, there = (
        {p.relative_to(folder) for p in folder.rglob("*") if p.is_file() and "__pycache__" not in p.parts}
        for folder in (ROOT / "accerl_lerobot", tmp_path / "accerl_lerobot")
    )
    assert there == here | {Path("recipes") / p.name for p in (ROOT / "recipes").iterdir()}
    assert not {"tests", "benchmarks", "datasets", "recipes", "docs"} & {p.name for p in tmp_path.iterdir()}
