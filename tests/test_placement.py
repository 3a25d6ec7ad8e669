# SPDX-License-Identifier: Apache-2.0
"""Which worker goes where, on made-up clusters."""

from __future__ import annotations

import random
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from accerl_lerobot.console import Console
from accerl_lerobot.engine import placement
from accerl_lerobot.engine.config import LaunchConfig, RunConfig
from accerl_lerobot.engine.placement import Node, Plan, plan_workers
from accerl_lerobot.engine.run import execute
from accerl_lerobot.errors import InputError
from accerl_lerobot.inference.worker import InferenceConfig
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.trainer.config import TrainerConfig
from accerl_lerobot.world_model.config import ImaginationConfig
from tests.runs import tiny_run

ROLES = ("trainer", "inference", "rollout")


def cluster(*sizes: tuple[float, float], **resources: str) -> list[Node]:
    """Nodes of so many CPUs and GPUs; ``n1="sim"`` gives the second one a resource."""
    return [
        Node(
            number=i,
            key=f"key{i}",
            name=f"10.0.0.{i + 1}",
            cpus=cpus,
            gpus=gpus,
            resources=frozenset({resources[f"n{i}"]} if f"n{i}" in resources else ()),
        )
        for i, (cpus, gpus) in enumerate(sizes)
    ]


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
        imagination=ImaginationConfig(share=0.5 if imagining else 0.0, model="oracle"),
        launch=LaunchConfig(address="auto", placement=placement),
    )


def where(plan: Plan) -> dict[str, tuple[int, float]]:
    """Node and GPUs of every worker."""
    return {name: (place.node.number, round(place.gpus, 6)) for name, place in plan.places.items()}


def rollouts_by_node(plan: Plan) -> dict[int, int]:
    return Counter(p.node.number for name, p in plan.places.items() if name.startswith("rollout"))


@pytest.mark.parametrize(("gpus", "share"), [(0, 0.0), (1, 0.5), (2, 1.0)])
def test_nothing_said_all_is_here_and_shares_what_is_left_of_the_gpus(gpus: float, share: float):
    assert where(plan_workers(cluster((8, gpus), (64, 8)), run())) == {
        "trainer": (0, share),
        "inference": (0, share),
        "replay": (0, 0.0),
        "rollout 0": (0, 0.0),
        "rollout 1": (0, 0.0),
    }


def test_a_policy_on_the_cpu_leaves_gpus_alone():
    assert {gpus for _, gpus in where(plan_workers(cluster((8, 4)), run(device="cpu"))).values()} == {0.0}


def test_roles_whose_nodes_overlap_may_not_fit():
    config = run(ranks=2, services=2, inference="all")
    with pytest.raises(InputError) as caught:
        plan_workers(cluster((8, 2), (8, 1)), config)
    assert str(caught.value) == (
        "launch.placement.inference='all': 2 × 1 GPUs do not fit on node 0 (10.0.0.1), node 1 (10.0.0.2) "
        "beside others; name the same nodes for all of these, or nodes of their own"
    )
    found = where(plan_workers(cluster((8, 2), (8, 2)), config))
    assert [found[f"inference {i}"] for i in range(2)] == [(1, 1.0)] * 2


def test_each_role_goes_where_it_is_sent_and_shares_what_is_there():
    nodes = cluster((8, 2), (8, 1), (64, 0), (32, 0), n2="sim", n3="sim")
    config = run(ranks=2, services=2, rollouts=6, imagining=True, imagination="1", rollout="sim")
    plan = plan_workers(nodes, config)
    found = where(plan)
    assert [found[name] for name in ("trainer", "trainer rank 1")] == [(0, 0.6)] * 2
    assert [found[f"inference {i}"] for i in range(2)] == [(0, 0.4)] * 2
    assert found["imagination"] == (1, 1.0)
    assert rollouts_by_node(plan) == {2: 4, 3: 2}  # as their cores
    assert found["replay"] == (0, 0.0)
    assert list(plan.rows()) == [
        "node 0 (10.0.0.1), 8 CPUs, 2 GPUs: trainer × 0.6 GPU, trainer rank × 0.6 GPU, "
        "2 inference × 0.4 GPU, replay",
        "node 1 (10.0.0.2), 8 CPUs, 1 GPUs: imagination × 1 GPU",
        "node 2 (10.0.0.3), 64 CPUs, 0 GPUs: 4 rollout",
        "node 3 (10.0.0.4), 32 CPUs, 0 GPUs: 2 rollout",
    ]


def test_a_node_that_is_not_there_is_refused_with_those_that_are():
    nodes = cluster((8, 0), (8, 0), n1="sim")
    for name in ("7", "simulators"):
        with pytest.raises(InputError, match=rf"rollout='{name}': .*numbers 0 to 1 and resources sim"):
            plan_workers(nodes, run(rollout=name))


def test_what_has_a_network_stays_where_the_files_are():
    nodes = cluster((8, 0), (64, 4))
    nodes[1] = replace(nodes[1], unseen="the run's folder, outputs/a")
    with pytest.raises(InputError, match=r"inference='1': node 1 \(10\.0\.0\.2\) does not see the run's"):
        plan_workers(nodes, run(inference="1"))
    plan = plan_workers(nodes, run(rollouts=9, inference="all", rollout="all"))
    assert where(plan)["inference"] == (0, 0.0)
    assert rollouts_by_node(plan) == {1: 9}  # the cores of node 0 have a trainer and a policy already


def test_cuda_is_not_looked_for_on_nodes_without():
    with pytest.raises(InputError, match=r"policy\.device='cuda': there is no GPU on node 1"):
        plan_workers(cluster((8, 1), (8, 0)), run(device="cuda", inference="1"))


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"address": "here"}, r"launch\.address='here': use HOST:PORT"),
        ({"address": "here:0"}, r"launch\.address='here:0': use HOST:PORT"),
        (
            {"address": "auto", "engine": "local"},
            r"launch\.address='auto': launch\.engine=local is one process",
        ),
        ({"placement": {"rollout": "1"}}, r"placement=.*a private Ray has one"),
    ],
)
def test_a_cluster_that_is_none_is_refused_when_the_recipe_is_read(fields: dict[str, Any], match: str):
    with pytest.raises(InputError, match=match):
        LaunchConfig(**fields)


def test_whatever_is_planned_fits():
    """On 300 random clusters no more is taken than there is, GPU by GPU as Ray fills them."""
    rng, made = random.Random(0), 0
    for _ in range(300):
        nodes = cluster(
            *[(rng.choice([2, 8, 64]), rng.choice([0, 1, 2, 4])) for _ in range(rng.randint(1, 4))]
        )
        sites = {name: rng.choice(["0", "all", str(rng.randrange(len(nodes)))]) for name in ROLES}
        config = run(
            ranks=rng.choice([1, 1, 2, 3]), services=rng.randint(1, 3), rollouts=rng.randint(3, 8), **sites
        )
        try:
            plan = plan_workers(nodes, config)
        except InputError as error:
            assert "GPU" in str(error), error
            continue
        made += 1
        assert (
            len(plan.places) == 1 + config.trainer.ranks + config.inference.workers + config.rollout.workers
        )
        for node in nodes:
            here = [place for place in plan.places.values() if place.node.number == node.number]
            free = [1.0] * int(node.gpus)
            for share in [place.gpus for place in here if place.gpus]:
                fullest = min((g for g in range(len(free)) if free[g] >= share - 1e-6), key=lambda g: free[g])
                free[fullest] -= share
    assert made > 80


def test_a_run_that_does_not_fit_does_not_begin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Not even with what comes before its workers."""
    machine = replace(cluster((8, 1))[0], name="this machine")
    monkeypatch.setattr(placement, "this_machine", lambda: machine)
    trainer = TrainerConfig(updates=1, batch_decisions=16, ranks=2)
    config = tiny_run(Path("nowhere"), trainer=trainer, policy=PolicyConfig(path="nowhere"))
    with pytest.raises(
        InputError, match=r"trainer\.ranks=2: .* 2 ranks on 1 GPUs leave 1 without; use at most 1"
    ):
        execute(config, tmp_path, Console())
    assert [path.name for path in tmp_path.iterdir()] == ["config.yaml"]
