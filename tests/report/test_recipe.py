# SPDX-License-Identifier: Apache-2.0
"""Differences of a recipe from the defaults and between runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from accerl_lerobot.algorithms import PPOConfig
from accerl_lerobot.config.parsing import read_recipe
from accerl_lerobot.demos.backbone import BackboneConfig
from accerl_lerobot.demos.sft import SFTConfig
from accerl_lerobot.engine.config import RunConfig, encode, parse
from accerl_lerobot.report.read import apart, differences, flat
from tests.report.folders import run_config

ROOT = Path(__file__).parents[2]


def changed(config: RunConfig) -> dict[str, Any]:
    return {field: value for field, value, _ in differences(config)}


def test_the_defaults_differ_in_nothing() -> None:
    assert changed(RunConfig()) == {}


def test_another_type_is_a_difference_and_its_own_defaults_are_none() -> None:
    assert changed(RunConfig(algorithm=PPOConfig(clip_high=0.3))) == {
        "algorithm.type": "ppo", "algorithm.clip_high": 0.3,
    }  # fmt: skip


@pytest.mark.parametrize("path", sorted((ROOT / "recipes").glob("*.yaml")), ids=lambda p: p.stem)
def test_a_recipe_differs_in_what_it_says(path: Path) -> None:
    if "type: libero" in path.read_text():
        pytest.importorskip("libero")
    config = parse(RunConfig, [str(path)])
    said = {k: v for k, v in flat(read_recipe(path)).items() if k != "job_name"}
    found = changed(config)
    assert said.keys() >= found.keys() - {"sft.backbone", "sft.policy", "policy.sampler"}
    now, usual = flat(encode(config)), flat(encode(RunConfig()))
    # What is said of a policy is shown as a whole.
    said = {key: value for key, value in said.items() if not key.startswith("sft.policy.")}
    assert found.keys() >= {key for key in said if key in usual and usual[key] != now[key]}


def test_runs_apart() -> None:
    a, b = (encode(run_config(seed=seed)) for seed in (1, 2))
    b["algorithm"] = {"type": "ppo"}
    b["output_dir"] = "elsewhere"
    rows = dict(apart([a, b]))
    assert rows["seed"] == [1, 2] and rows["algorithm.type"] == ["gipo", "ppo"]
    assert rows["algorithm.sigma"] == [1.0, "–"] and "output_dir" not in rows


def test_a_section_that_is_off_unless_given() -> None:
    config = RunConfig(sft=SFTConfig(steps=5, backbone=BackboneConfig(hidden=8)))
    assert changed(config) == {"sft.backbone": "given", "sft.steps": 5, "sft.backbone.hidden": 8}
