# SPDX-License-Identifier: Apache-2.0
"""Which worker goes where, on made-up clusters."""

from pathlib import Path
from typing import Any

import pytest
import torch

from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.console import Console
from accerl_lerobot.engines.config import LaunchConfig, RunConfig
from accerl_lerobot.engines.ray_session import Placement
from accerl_lerobot.errors import InputError
from accerl_lerobot.inference.worker import InferenceConfig
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.run.train import Run
from accerl_lerobot.world_model.config import ImaginationConfig
from tests.runs import tiny_run

Nodes = list[dict[str, float]]


def cluster(*sizes: tuple[float, float], **resources: str) -> Nodes:
    """Resources of nodes with so many CPUs and GPUs; ``n1="sim"`` gives the second one a resource."""
    nodes = [{"CPU": cpus, "GPU": gpus, f"node:10.0.0.{i + 1}": 1.0} for i, (cpus, gpus) in enumerate(sizes)]
    for name, resource in resources.items():
        nodes[int(name[1:])][resource] = 1.0
    return nodes


def run(
    *,
    ranks: int = 1,
    services: int = 1,
    rollouts: int = 2,
    imagining: bool = False,
    device: str = "auto",
    **placement: str,
) -> RunConfig:
    """A run of so many workers, its roles placed as the other keywords say."""
    return tiny_run(
        Path("nowhere"),
        policy=PolicyConfig(path="nowhere", device=device),
        trainer=TrainerConfig(updates=1, batch_decisions=16, ranks=ranks),
        inference=InferenceConfig(workers=services),
        rollout=RolloutConfig(workers=max(rollouts, services), environments=1, segment_length=3),
        imagination=ImaginationConfig(environments=2 if imagining else 0, path="nowhere"),
        launch=LaunchConfig(address="auto", placement=placement),
    )


def gpus(nodes: Nodes, config: RunConfig) -> dict[str, float]:
    """Share of a GPU of each role's workers."""
    placement = Placement(config, nodes, "a" * 56)
    roles = ("trainer", "inference", "world_model", "rollout", "replay")
    return {role: round(placement.options(role)["num_gpus"], 6) for role in roles}


@pytest.mark.parametrize(("count", "share"), [(0, 0.0), (1, 0.5), (2, 1.0)])
def test_by_default_all_is_here_and_shares_the_gpus(count: float, share: float):
    placement = Placement(run(), cluster((8, count), (64, 8)), "a" * 56)
    for role in ("trainer", "inference", "rollout", "replay"):
        options = placement.options(role)
        assert options["scheduling_strategy"].node_id == "a" * 56
        assert options["num_gpus"] == (share if role in ("trainer", "inference") else 0.0)


def test_each_role_goes_where_it_is_sent_and_shares_what_is_there():
    nodes = cluster((8, 2), (8, 1), (64, 0), (32, 0), n2="sim", n3="sim")
    sites = {"world_model": "node:10.0.0.2", "rollout": "sim"}
    config = run(ranks=2, services=2, rollouts=6, imagining=True, **sites)
    assert gpus(nodes, config) == {
        "trainer": 0.6, "inference": 0.4, "world_model": 0.0, "rollout": 0.0, "replay": 0.0
    }  # fmt: skip
    assert set(gpus(nodes, run(device="cpu")).values()) == {0.0}
    placement = Placement(config, nodes, "a" * 56)
    assert placement.options("rollout")["resources"].keys() == {"sim"}
    assert placement.rows() == [
        "2 trainer × 0.6 GPU on this node",
        "1 world_model on nodes with node:10.0.0.2",
        "2 inference × 0.4 GPU on this node",
        "6 rollout on nodes with sim",
        "1 replay on this node",
    ]
    everywhere = Placement(run(inference="all"), nodes, "a" * 56)
    assert everywhere.options("inference")["scheduling_strategy"] == "SPREAD"
    assert everywhere.options("inference")["num_gpus"] == 1.0


def test_a_resource_that_is_not_there_is_refused_with_those_that_are():
    with pytest.raises(InputError, match=r"rollout='simulators': .*there are node:10\.0\.0\.1, .*, sim, or"):
        Placement(run(rollout="simulators"), cluster((8, 0), (8, 0), n1="sim"))


def test_cuda_is_not_looked_for_on_nodes_without():
    with pytest.raises(InputError, match=r"policy\.device='cuda': there is no GPU on the nodes with sim"):
        Placement(run(device="cuda", inference="sim"), cluster((8, 1), (8, 0), n1="sim"))


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        (
            {"address": "auto", "engine": "local"},
            r"launch\.address='auto': launch\.engine=local is one process",
        ),
        ({"placement": {"rollout": "all"}}, r"placement=.*a private Ray has one"),
    ],
)
def test_a_cluster_that_is_none_is_refused_when_the_recipe_is_read(fields: dict[str, Any], match: str):
    with pytest.raises(InputError, match=match):
        LaunchConfig(**fields)


def test_a_run_that_does_not_fit_does_not_begin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Not even with what comes before its workers."""
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    trainer = TrainerConfig(updates=1, batch_decisions=16, ranks=2)
    config = tiny_run(Path("nowhere"), trainer=trainer, policy=PolicyConfig(path="nowhere"))
    with pytest.raises(
        InputError, match=r"trainer\.ranks=2: .* 2 ranks on 1 GPUs leave 1 without; use at most 1"
    ):
        Run(config, tmp_path, Console(), load=lambda policy: None).execute()
    assert [path.name for path in tmp_path.iterdir()] == ["config.yaml"]
