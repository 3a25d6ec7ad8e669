# SPDX-License-Identifier: Apache-2.0
"""An algorithm that another package registers is named on the command line, and trained with."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Literal

import pytest

from accerl_lerobot.algorithms import AlgorithmConfig
from accerl_lerobot.config.parsing import parse
from accerl_lerobot.engine.config import LaunchConfig, RunConfig
from accerl_lerobot.errors import InputError
from tests.runs import tiny_run, trained

PACKAGE, NAME = "tests.algorithms.own_algorithm", "own_reinforce"
NAMED = [f"--algorithm.discover_packages_path={PACKAGE}", f"--algorithm.type={NAME}"]


@pytest.fixture(autouse=True)
def unheard_of() -> Iterator[None]:
    forget()
    yield
    forget()


def forget() -> None:
    AlgorithmConfig.get_known_choices().pop(NAME, None)
    sys.modules.pop(PACKAGE, None)


def test_it_is_unknown_without_its_package():
    with pytest.raises(InputError, match=rf"^algorithm\.type='{NAME}'"):
        parse(RunConfig, NAMED[1:])


def test_a_file_alone_imports_no_package(tmp_path: Path):
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(f"algorithm: {{discover_packages_path: {PACKAGE}, type: {NAME}}}\n")
    with pytest.raises(InputError, match=r"^algorithm\."):
        parse(RunConfig, [f"--config_path={recipe}"])
    assert parse(RunConfig, [f"--config_path={recipe}", NAMED[0]]).algorithm.type == NAME


@pytest.mark.parametrize("engine", ["local", pytest.param("ray", marks=pytest.mark.slow)])
def test_it_trains(engine: Literal["local", "ray"], tiny_checkpoint: Path):
    algorithm = parse(RunConfig, [*NAMED, "--algorithm.scale=0.5"]).algorithm
    config = tiny_run(tiny_checkpoint, algorithm=algorithm)
    config = replace(config, launch=LaunchConfig(engine=engine, stall_s=120))
    made = trained(config, ("match",))
    assert len(made) == 12 and made[-1]["skipped"] == 0
    assert any(update["policy_loss"] != 0 for update in made)
