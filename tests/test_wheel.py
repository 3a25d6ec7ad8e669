# SPDX-License-Identifier: Apache-2.0
"""The wheel holds all that a run outside of the repository needs."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.runs import pip_installed

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with nothing but what the wheel puts there."""
    site = tmp_path_factory.mktemp("site")
    pip_installed(site, ROOT)
    return site


def accerl(site: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": str(site)}
    command = [sys.executable, "-m", "accerl_lerobot.cli", *arguments]
    return subprocess.run(command, env=environment, cwd=site, capture_output=True, text=True, check=False)


def test_recipes_are_found_by_name(installed: Path):
    done = accerl(installed, "train", "--config_path=quickstart", "--trainer.updates=-1")
    assert done.returncode == 2 and done.stderr.startswith("accerl: trainer.updates=-1"), done.stderr
    done = accerl(installed, "train", "--config_path=quickstar")
    assert "no such file; this package has " in done.stderr and ", quickstart" in done.stderr


def test_everything_that_is_not_code_comes_too(installed: Path):
    package = installed / "accerl_lerobot"
    here, there = (
        {p.relative_to(folder) for p in folder.rglob("*") if p.is_file() and "__pycache__" not in p.parts}
        for folder in (ROOT / "accerl_lerobot", package)
    )
    recipes = {Path("recipes") / p.name for p in (ROOT / "recipes").iterdir()}
    assert there == here | recipes
    assert {p.name for p in installed.iterdir()} >= {"accerl_lerobot"}
    assert not {"tests", "benchmarks", "datasets", "recipes", "docs"} & {p.name for p in installed.iterdir()}
