# SPDX-License-Identifier: Apache-2.0
"""The world benchmark runs and its numbers add up."""

from __future__ import annotations

import io
import json

import pytest
from rich.console import Console

from accerl_lerobot.envs import EnvConfig, LiberoConfig, MetaWorldConfig
from benchmarks.world import BenchWorldConfig, bench_world, table
from tests.envs.libero_assets import ASSETS, needs_assets

LIBERO = LiberoConfig(task="libero_object/0", image_size=64, rendering="fast", assets=ASSETS)


@pytest.mark.parametrize(
    ("env", "least"),
    [
        pytest.param(MetaWorldConfig(), 10, id="metaworld"),
        pytest.param(LIBERO, 3, marks=[needs_assets, pytest.mark.slow], id="libero"),
    ],
)
def test_three_arms_in_turns(env: EnvConfig, least: float):
    pytest.importorskip("metaworld")
    result = bench_world(BenchWorldConfig(env=env, seconds=0.3, rounds=1, chunk=5))
    assert json.loads(json.dumps(result)) == result
    arms = result["arms"]
    for rates in arms.values():
        assert len(rates["env_steps_per_s"]["blocks"]) == 2
        assert rates["env_steps_per_s"]["min"] <= rates["env_steps_per_s"]["median"]
    ours = arms["ours"]
    assert ours["env_steps_per_s"]["median"] == pytest.approx(5 * ours["decisions_per_s"]["median"], rel=0.1)
    assert result["ratio"]["min"] > least, "the whole point of our own world"
    console = Console(width=120, record=True, file=io.StringIO())
    console.print(table(result))
    assert "stock" in console.export_text()
