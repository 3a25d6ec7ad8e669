# SPDX-License-Identifier: Apache-2.0
"""Differences of a recipe from the defaults and between runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from accerl_lerobot.algorithms import PPOConfig
from accerl_lerobot.config.parsing import read_recipe
from accerl_lerobot.demos.backbone import BackboneConfig
from accerl_lerobot.demos.record import DemosConfig
from accerl_lerobot.demos.sft import SFTConfig
from accerl_lerobot.engines.config import DatasetConfig, RunConfig, encode, parse
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.report.read import changed_fields, differences, flat
from tests.report.folders import run_config

ROOT = Path(__file__).parents[2]


def changed(config: RunConfig) -> dict[str, Any]:
    return {field: value for field, (value, _) in changed_fields(encode(config))}


def test_the_defaults_differ_in_nothing() -> None:
    assert changed(RunConfig()) == {}


def test_fields_of_stages_that_the_run_skips_are_left_out() -> None:
    sft, demos = SFTConfig(steps=5, lr=1e-4), DemosConfig(episodes=3)
    names = {"sft.steps", "sft.lr", "demos.episodes"}
    assert names <= changed(RunConfig(sft=sft, demos=demos)).keys()
    given = DatasetConfig(repo_id="a/b")
    assert not {"demos.episodes"} & changed(RunConfig(sft=sft, demos=demos, dataset=given)).keys()
    improved = RunConfig(sft=replace(sft, steps=0), demos=demos, policy=PolicyConfig(path="x"))
    assert changed(improved).keys() == {"policy.path"}


def test_another_type_and_a_section_that_is_off_unless_given() -> None:
    config = RunConfig(
        algorithm=PPOConfig(clip_high=0.3), sft=SFTConfig(steps=5, backbone=BackboneConfig(hidden=8))
    )
    found = changed(config)
    assert found["algorithm.type"] == "ppo" and found["algorithm.clip_high"] == 0.3
    assert found["sft.backbone.hidden"] == 8 and "algorithm.gamma" not in found


@pytest.mark.parametrize("path", sorted((ROOT / "recipes").glob("*.yaml")), ids=lambda p: p.stem)
def test_a_recipe_differs_in_what_it_says(path: Path) -> None:
    if "type: libero" in path.read_text():
        pytest.importorskip("libero")
    now, usual = flat(encode(parse(RunConfig, [str(path)]))), flat(encode(RunConfig()))
    said = {key for key in flat(read_recipe(path)) if key in usual and now[key] != usual[key]}
    assert changed(parse(RunConfig, [str(path)])).keys() >= {
        name for name in said - {"job_name"} if not name.startswith(("sft.", "demos."))
    }


def test_runs_apart() -> None:
    a, b = (encode(run_config(seed=seed)) for seed in (1, 2))
    b["algorithm"] = {"type": "ppo"}
    b["output_dir"] = "elsewhere"
    rows = dict(differences([a, b]))
    assert rows["seed"] == [1, 2] and rows["algorithm.type"] == ["gipo", "ppo"]
    assert rows["algorithm.sigma"] == [1.0, "–"] and "output_dir" not in rows
