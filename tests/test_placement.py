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
from accerl_lerobot.engine.config import LaunchConfig, PlacementConfig, RoleConfig, RunConfig, decode
from accerl_lerobot.engine.contract import WorkerError
from accerl_lerobot.engine.placement import Node, Plan, place_workers, plan_workers
from accerl_lerobot.engine.run import train
from accerl_lerobot.errors import InputError
from accerl_lerobot.inference.worker import InferenceConfig
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.trainer.config import TrainerConfig
from accerl_lerobot.world_model.config import ImaginationConfig
from tests.runs import tiny_run


def cluster(*sizes: tuple[float, float], **resources: str) -> list[Node]:
    """Nodes of so many CPUs and GPUs; ``n1="sim"`` gives the second one a resource."""
    return [
        Node(
            number=i,
            key=f"key{i}",
            name=f"10.0.0.{i + 1}",
            cpus=cpus,
            gpus=gpus,
            host=f"host{i}",
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
    transport: Any = "auto",
    **placement: RoleConfig,
) -> RunConfig:
    """A run of so many workers, its roles placed as the other keywords say."""
    sharding = "zero2" if ranks > 1 else "none"
    return tiny_run(
        Path("nowhere"),
        policy=PolicyConfig(path="nowhere", device=device),
        trainer=TrainerConfig(updates=1, batch_decisions=16, ranks=ranks, sharding=sharding),
        inference=InferenceConfig(workers=services),
        rollout=RolloutConfig(workers=max(rollouts, services), worlds=1, segment_length=3),
        imagination=ImaginationConfig(share=0.5 if imagining else 0.0, model="oracle"),
        launch=LaunchConfig(address="auto", transport=transport, placement=PlacementConfig(**placement)),
    )


def at(nodes: str | None = None, gpus: float | None = None, cpus: float = 0.0) -> RoleConfig:
    return RoleConfig(nodes=nodes, gpus=gpus, cpus=cpus)


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
    with pytest.raises(InputError, match=r"inference\.gpus=0\.5: policy\.device=cpu takes none"):
        plan_workers(cluster((8, 4)), run(device="cpu", inference=at(gpus=0.5)))


def test_ranks_that_do_not_fit_are_refused_as_on_one_machine():
    with pytest.raises(InputError, match=r"trainer\.ranks=4: .* 4 ranks on 3 GPUs leave 1 without"):
        plan_workers(cluster((8, 3)), run(ranks=4))


def test_the_sum_is_in_the_error():
    config = run(ranks=4, services=2, trainer=at(gpus=1), inference=at(gpus=0.5))
    with pytest.raises(InputError) as caught:
        plan_workers(cluster((8, 4)), config)
    assert str(caught.value) == (
        "launch.placement.inference.gpus=0.5: 4 trainer × 1 + 2 inference × 0.5 = 5 GPUs, and there are 4 on "
        "node 0 (10.0.0.1); ask for less, or for other nodes"
    )
    found = where(plan_workers(cluster((8, 5)), config))
    assert [found[f"inference {i}"] for i in range(2)] == [(0, 0.5)] * 2


def test_parts_that_add_up_but_fit_on_no_single_gpu_are_refused():
    config = run(services=2, trainer=at(gpus=0.6), inference=at(gpus=0.6))
    with pytest.raises(
        InputError, match=r"1\.8 GPUs, and there are 2 on .*, of which no single one has room"
    ):
        plan_workers(cluster((8, 2)), config)


def test_each_role_goes_where_it_is_sent_and_shares_what_is_there():
    nodes = cluster((8, 2), (8, 1), (64, 0), (32, 0), n2="sim", n3="sim")
    config = run(ranks=2, services=2, rollouts=6, imagining=True, imagination=at("1"), rollout=at("sim"))
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


def test_cores_are_kept_where_they_are_asked_for():
    config = run(rollouts=6, rollout=at("all", cpus=2))
    assert rollouts_by_node(plan_workers(cluster((4, 0), (8, 0)), config)) == {0: 2, 1: 4}
    with pytest.raises(InputError, match=r"rollout\.cpus=2: 6 × 2 = 12 CPUs .* there are 4 on node 0 .*7 on"):
        plan_workers(cluster((4, 0), (7, 0)), config)


def test_a_node_that_is_not_there_is_refused_with_those_that_are():
    nodes = cluster((8, 0), (8, 0), n1="sim")
    for name in ("7", "simulators"):
        with pytest.raises(InputError, match=rf"rollout\.nodes='{name}': .*numbers 0 to 1 and resources sim"):
            plan_workers(nodes, run(rollout=at(name)))


def test_what_has_a_network_stays_where_the_files_are():
    nodes = cluster((8, 0), (64, 4))
    nodes[1] = replace(nodes[1], unseen="the run's folder, outputs/a")
    with pytest.raises(
        InputError, match=r"inference\.nodes='1': node 1 \(10\.0\.0\.2\) does not see the run's"
    ):
        plan_workers(nodes, run(inference=at("1")))
    plan = plan_workers(nodes, run(rollouts=9, inference=at("all"), rollout=at("all")))
    assert where(plan)["inference"] == (0, 0.0)
    assert rollouts_by_node(plan) == {1: 9}  # the cores of node 0 have a trainer and a policy already


def test_gpus_of_some_who_share_nodes_and_not_of_others_are_refused():
    config = run(trainer=at(gpus=0.5))
    with pytest.raises(InputError, match=r"trainer\.gpus=0\.5: say the same of inference, on the same nodes"):
        plan_workers(cluster((8, 1)), config)
    assert where(plan_workers(cluster((8, 1), (8, 1)), run(trainer=at(gpus=0.5), inference=at("1"))))


def test_two_ranks_never_share_a_gpu():
    with pytest.raises(InputError, match=r"trainer\.gpus=0\.5: two ranks could share a GPU"):
        plan_workers(cluster((8, 2)), run(ranks=2, trainer=at(gpus=0.5), inference=at(gpus=0.5)))


def test_cuda_is_not_looked_for_on_nodes_without():
    with pytest.raises(InputError, match=r"policy\.device='cuda': there is no GPU on node 1"):
        plan_workers(cluster((8, 1), (8, 0)), run(device="cuda", inference=at("1")))


def test_shared_memory_ends_where_the_machine_does():
    nodes, config = cluster((8, 0), (8, 0)), run(transport="shared_memory", rollout=at("all"))
    with pytest.raises(InputError, match=r"launch\.transport='shared_memory': node 1 .* shares no memory"):
        plan_workers(nodes, config)
    assert plan_workers([nodes[0], replace(nodes[1], host="host0")], config)  # two nodes of one machine


def test_a_rollout_worker_whose_node_has_left_goes_to_one_that_is_there():
    plan = plan_workers(cluster((4, 0), (8, 0), (8, 0)), run(rollouts=5, rollout=at("all", cpus=4)))
    assert rollouts_by_node(plan) == {0: 1, 1: 2, 2: 2}
    left = frozenset({"key0", "key1"})
    for name in [n for n, place in plan.places.items() if place.node.number == 2]:
        plan = plan.moved(name, left)
        assert plan.places[name].cpus == 0.0  # whether there is room for it or not
    assert rollouts_by_node(plan) == {0: 2, 1: 3}
    assert plan.moved("rollout 1", frozenset({"key0"})).places["rollout 1"].node.number == 0
    with pytest.raises(WorkerError, match="rollout 1 worker is lost, and no node is left"):
        plan.moved("rollout 1", frozenset())  # a worker's loss may be noticed before its node's


def test_rollout_workers_take_no_gpu():
    with pytest.raises(InputError, match=r"rollout\.gpus=0\.5: rollout workers have no network"):
        decode(RunConfig, {"launch": {"placement": {"rollout": {"gpus": 0.5}}}})


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"address": "here"}, r"launch\.address='here': use HOST:PORT"),
        ({"address": "here:0"}, r"launch\.address='here:0': use HOST:PORT"),
        (
            {"address": "auto", "engine": "local"},
            r"launch\.address='auto': launch\.engine=local is one process",
        ),
        ({"placement": PlacementConfig(rollout=RoleConfig(nodes="1"))}, r"placement=.*a private Ray has one"),
        ({"open_cluster": True}, r"launch\.open_cluster=True: it is about the cluster of launch\.address"),
    ],
)
def test_a_cluster_that_is_none_is_refused_when_the_recipe_is_read(fields: dict[str, Any], match: str):
    with pytest.raises(InputError, match=match):
        LaunchConfig(**fields)


def test_a_node_that_leaves_while_it_is_asked_is_planned_without(monkeypatch: pytest.MonkeyPatch):
    there = [frozenset({"key0", "key1"})]
    asked: list[int] = []

    def nodes(config: object) -> list[Node]:
        asked.append(len(there[0]))
        if len(asked) == 1:
            there[0] = frozenset({"key0"})
            raise WorkerError("node 1 could not report its versions")
        return cluster((8, 0))

    monkeypatch.setattr(placement, "alive_nodes", lambda: there[0])
    monkeypatch.setattr(placement, "_nodes", nodes)
    assert set(where(place_workers(run())).values()) == {(0, 0.0)} and asked == [2, 1]
    asked.clear()
    there[0] = frozenset({"key0"})
    with pytest.raises(WorkerError, match="could not report"):  # it is there, and broken
        place_workers(run())


def test_whatever_is_planned_fits():
    """On 300 random clusters no more is taken than there is, GPU by GPU as Ray fills them."""
    rng, made = random.Random(0), 0
    for _ in range(300):
        nodes = cluster(
            *[(rng.choice([2, 8, 64]), rng.choice([0, 1, 2, 4])) for _ in range(rng.randint(1, 4))]
        )
        sites = [rng.choice([None, "all", str(rng.randrange(len(nodes)))]) for _ in range(3)]
        said = rng.random() < 0.5
        config = run(
            ranks=rng.choice([1, 1, 2, 3]),
            services=rng.randint(1, 3),
            rollouts=rng.randint(3, 8),
            trainer=at(sites[0], rng.choice([0.6, 1.0]) if said else None),
            inference=at(sites[1], rng.choice([0.25, 0.6, 1.0]) if said else None),
            rollout=at(sites[2], cpus=rng.choice([0, 0, 1, 2])),
        )
        try:
            plan = plan_workers(nodes, config)
        except InputError as error:
            assert "GPU" in str(error) or "CPUs" in str(error), error
            continue
        made += 1
        assert (
            len(plan.places) == 1 + config.trainer.ranks + config.inference.workers + config.rollout.workers
        )
        for node in nodes:
            here = [place for place in plan.places.values() if place.node.number == node.number]
            assert sum(place.cpus for place in here) <= node.cpus + 1e-6
            free = [1.0] * int(node.gpus)
            for share in [place.gpus for place in here if place.gpus]:
                fullest = min((g for g in range(len(free)) if free[g] >= share - 1e-6), key=lambda g: free[g])
                free[fullest] -= share
    assert made > 80


def test_a_run_that_does_not_fit_does_not_begin(tmp_path: Path):
    """Not even with what comes before its workers."""
    config = tiny_run(Path("nowhere"), launch=LaunchConfig(placement=PlacementConfig(rollout=at(cpus=4096))))
    with pytest.raises(
        InputError, match=r"rollout\.cpus=4096: 1 × 4096 = 4096 CPUs .* node 0 \(this machine\)"
    ):
        train(config, tmp_path, Console())
    assert [path.name for path in tmp_path.iterdir()] == ["config.yaml"]
