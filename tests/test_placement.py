# SPDX-License-Identifier: Apache-2.0
"""Which worker goes where, on made-up clusters."""

from pathlib import Path
from typing import Any

import pytest
import torch

from accerl_lerobot.console import Console
from accerl_lerobot.engines.config import LaunchConfig, RunConfig
from accerl_lerobot.engines.ray_session import Placement
from accerl_lerobot.errors import InputError
from accerl_lerobot.run.train import Run
from tests.runs import changed, tiny_run


def cluster(*gpus: float, sim: int | None = None) -> list[dict[str, float]]:
    """Resources of nodes with so many GPUs, of which the one numbered `sim` has a resource of that name."""
    nodes = [{"CPU": 8.0, "GPU": count, f"node:10.0.0.{i + 1}": 1.0} for i, count in enumerate(gpus)]
    if sim is not None:
        nodes[sim]["sim"] = 1.0
    return nodes


def run(device: str = "auto", **placement: str) -> RunConfig:
    launch = {"address": "auto", "placement": placement}
    return tiny_run(Path("nowhere"), policy={"device": device}, launch=launch)


@pytest.mark.parametrize(
    ("device", "count", "share"), [("auto", 0, 0.0), ("auto", 1, 0.5), ("auto", 2, 1.0), ("cpu", 2, 0.0)]
)
def test_by_default_all_is_here_and_shares_the_gpus(device: str, count: float, share: float):
    placement = Placement(run(device), cluster(count, 8), "a" * 56)
    for role in ("trainer", "inference", "rollout", "replay"):
        options = placement.options(role)
        assert options["scheduling_strategy"].node_id == "a" * 56
        assert options["num_gpus"] == (share if role in ("trainer", "inference") else 0.0)


def test_each_role_goes_where_it_is_sent_and_shares_what_is_there():
    nodes = cluster(2, 1, 0, sim=2)
    config = changed(
        run(world_model="node:10.0.0.2", rollout="sim"),
        trainer={"ranks": 2},
        inference={"workers": 2},
        rollout={"workers": 6},
        imagination={"environments": 2, "path": "nowhere"},
    )
    placement = Placement(config, nodes, "a" * 56)
    assert placement.options("trainer")["num_gpus"] == pytest.approx(0.6)
    assert placement.options("world_model")["num_gpus"] == 0
    assert placement.options("rollout")["resources"].keys() == {"sim"}
    assert placement.rows() == [
        "2 trainer × 0.6 GPU on this node",
        "1 world_model on nodes with node:10.0.0.2",
        "2 inference × 0.4 GPU on this node",
        "6 rollout on nodes with sim",
        "1 replay on this node",
    ]
    everywhere = Placement(run(inference="all"), nodes, "a" * 56).options("inference")
    assert (everywhere["scheduling_strategy"], everywhere["num_gpus"]) == ("SPREAD", 1.0)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (run(rollout="simulators"), r"rollout='simulators': .*there are node:10\.0\.0\.1, .*, sim, or"),
        (run("cuda", inference="sim"), r"policy\.device='cuda': there is no GPU on the nodes with sim"),
    ],
)
def test_what_is_not_there_is_refused(config: RunConfig, message: str):
    with pytest.raises(InputError, match=message):
        Placement(config, cluster(1, 0, sim=1), "a" * 56)


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"address": "auto", "engine": "local"}, r"launch\.address='auto': launch\.engine=local is one proc"),
        ({"placement": {"rollout": "all"}}, r"placement=.*a private Ray has one"),
    ],
)
def test_a_cluster_that_is_none_is_refused_when_the_recipe_is_read(fields: dict[str, Any], match: str):
    with pytest.raises(InputError, match=match):
        LaunchConfig(**fields)


def test_a_run_that_does_not_fit_does_not_begin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    config = tiny_run(Path("nowhere"), trainer={"ranks": 2}, policy={"device": "auto"})
    with pytest.raises(InputError, match=r"trainer\.ranks=2: .* 2 ranks on 1 GPUs leave 1 without"):
        Run(config, tmp_path, Console(), load=lambda policy: None).execute()
    assert [path.name for path in tmp_path.iterdir()] == ["config.yaml"]
