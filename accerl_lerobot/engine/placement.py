# SPDX-License-Identifier: Apache-2.0
"""Placement: which worker runs on which node, and its share of a GPU there.

By default everything is on the node where the run is started, and processes with a network share its GPUs.
These read the policy's files and write into the run's folder, so they need a node that sees both under the
same paths. Rollout workers need no files. Ray is told node by node: left to Ray, a worker that fits nowhere
is waited for without a word.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import logging
import math
import os
import platform
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from accerl_lerobot.algorithms import ChunkCriticConfig
from accerl_lerobot.engine.ray_session import FIELD, RaySession, prepare
from accerl_lerobot.engine.stopping import WorkerError
from accerl_lerobot.errors import InputError
from accerl_lerobot.metrics import numbered

if TYPE_CHECKING:
    from accerl_lerobot.engine.config import RunConfig

logger = logging.getLogger(__name__)

SECTION = "launch.placement"
ALL = "all"
TINY = 1e-6  # rounding error of sums of GPU shares
REPORT_S = 120.0  # timeout for a node to start a process and report what it has


@dataclass(frozen=True, kw_only=True)
class Node:
    """A machine of the cluster."""

    number: int  # 0: where the run is started
    key: str  # Ray's id
    name: str
    cpus: float
    gpus: float
    resources: frozenset[str] = frozenset()  # names of its custom resources
    unseen: str = ""  # a folder of the run that it does not see; empty: it sees all

    def __str__(self) -> str:
        return f"node {self.number} ({self.name})"


class Role(NamedTuple):
    """The workers of a kind, and their nodes, see `LaunchConfig.placement`."""

    name: str
    workers: list[str]
    selector: str | None

    @property
    def network(self) -> bool:
        """True if they need a share of a GPU, and files."""
        return self.name != "rollout"


class Place(NamedTuple):
    """Where one worker is, and its share of a GPU there."""

    node: Node
    gpus: float = 0.0


@dataclass(frozen=True)
class Plan:
    """A place for every worker."""

    nodes: tuple[Node, ...]
    places: dict[str, Place]

    def rows(self) -> Iterator[str]:
        for node in self.nodes:
            here = Counter(
                (name.rstrip("0123456789 "), place.gpus)
                for name, place in self.places.items()
                if place.node.number == node.number
            )
            parts = [
                (name if count == 1 else f"{count} {name}") + (f" × {gpus:g} GPU" if gpus else "")
                for (name, gpus), count in here.items()
            ]
            yield f"{node}, {node.cpus:g} CPUs, {node.gpus:g} GPUs: {', '.join(parts) or 'nothing'}"


def this_machine() -> Node:
    """The only node of a private Ray."""
    import torch

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    gpus = torch.cuda.device_count()
    return Node(number=0, key="", name="this machine", cpus=float(cores), gpus=float(gpus))


def roles_of(config: RunConfig) -> list[Role]:
    """The roles of a run besides replay, in the order in which they are placed."""
    c = config
    imagining = ["imagination"] * bool(c.imagination.share) + ["world-model learning"] * c.imagination.learns
    workers = {
        "trainer": ["trainer", *(f"trainer rank {i}" for i in range(1, c.trainer.ranks))],
        "world_model": ["world model"] * learns_states(c),
        "inference": numbered("inference", c.inference.workers),
        "imagination": imagining,
        "rollout": [f"rollout {i}" for i in range(c.rollout.workers)],
    }
    return [Role(name, own, c.launch.placement.get(name)) for name, own in workers.items() if own]


def learns_states(config: RunConfig) -> bool:
    """True if the run has a world model that critic and teacher stand on, and that learns."""
    from accerl_lerobot.world_model.states import can_learn

    return isinstance(config.algorithm, ChunkCriticConfig) and can_learn(config.state_model)


def candidates(nodes: Sequence[Node], role: Role) -> list[Node]:
    if role.selector is None:
        return [nodes[0]]
    if role.selector == ALL:
        return list(nodes)
    chosen = [node for node in nodes if role.selector in (str(node.number), *node.resources)]
    if not chosen:
        names = sorted({name for node in nodes for name in node.resources if ":" not in name})
        known = f"numbers 0 to {len(nodes) - 1}" + (f" and resources {', '.join(names)}" if names else "")
        hint = f"no node of the cluster is called that; there are {known}"
        raise InputError(f"{SECTION}.{role.name}", role.selector, hint)
    return chosen


def plan_workers(nodes: Sequence[Node], config: RunConfig) -> Plan:
    roles = roles_of(config)
    sites = {role.name: _sites(nodes, role) for role in roles}
    shares = _gpu_shares(roles, sites, config)
    free = {node.number: [1.0] * round(node.gpus) for node in nodes}
    load: Counter[int] = Counter()  # workers without a GPU
    places: dict[str, Place] = {}
    for role in roles:
        share = shares.get(role.name, 0.0)
        for name in role.workers:
            if share:
                places[name] = Place(_take_gpu(sites[role.name], free, share, role), share)
            else:  # where the fewest are for its cores, this one counted
                node = min(sites[role.name], key=lambda node: (load[node.number] + 1) / max(node.cpus, 1.0))
                places[name] = Place(node)
                load[node.number] += 1
    return Plan(tuple(nodes), places | {"replay": Place(nodes[0])})


def _sites(nodes: Sequence[Node], role: Role) -> list[Node]:
    named = candidates(nodes, role)
    seeing = [node for node in named if not (role.network and node.unseen)]
    if seeing == named or (role.selector == ALL and seeing):
        return seeing
    blind = next(node for node in named if node.unseen)
    hint = "which its workers read or write; share it under the same path, or leave the field out"
    raise InputError(f"{SECTION}.{role.name}", role.selector, f"{blind} does not see {blind.unseen}, {hint}")


def _gpu_shares(roles: list[Role], sites: dict[str, list[Node]], config: RunConfig) -> dict[str, float]:
    """Share of a GPU for each process of a role; roles on the same nodes share what these have."""
    shares: dict[str, float] = {}
    groups: dict[tuple[Node, ...], list[Role]] = {}
    for role in roles:
        if role.network and config.policy.device != "cpu":
            groups.setdefault(tuple(sites[role.name]), []).append(role)
    for here, group in groups.items():
        gpus = sum(node.gpus for node in here)
        if not gpus and config.policy.device.startswith("cuda") and any(node.number for node in here):
            hint = f"there is no GPU on {', '.join(map(str, here))}; use auto, cpu or other nodes"
            raise InputError("policy.device", config.policy.device, hint)
        others = sum(len(role.workers) for role in group if role.name != "trainer")
        share = 1 / math.ceil(others / gpus) if gpus and others else 0.0
        ranks = 0.0
        if group[0].name == "trainer":
            ranks, share = config.trainer.gpu_shares(gpus, max(1, others))
        shares |= {role.name: ranks if role.name == "trainer" else share for role in group}
    return shares


def _take_gpu(sites: list[Node], free: dict[int, list[float]], share: float, role: Role) -> Node:
    """The first node with enough left, which is taken from its fullest GPU that has it, as Ray does."""
    for node in sites:
        left = free[node.number]
        if fitting := [i for i, rest in enumerate(left) if rest >= share - TINY]:
            left[min(fitting, key=lambda i: left[i])] -= share
            return node
    hint = (
        f"{len(role.workers)} × {share:g} GPUs do not fit on {', '.join(map(str, sites))} beside others; "
        "name the same nodes for all of these, or nodes of their own"
    )
    raise InputError(f"{SECTION}.{role.name}", role.selector, hint)


def place_workers(config: RunConfig) -> Plan:
    """Plan where the workers of a run go on the nodes that Ray has now."""
    plan = plan_workers(_nodes(config), config)
    for row in plan.rows():
        logger.info("%s", row)
    return plan


def check_placement(config: RunConfig) -> list[str]:
    """Plan where the workers will be, so that what does not fit is refused before anything long; as lines."""
    if config.launch.engine == "local":
        return []
    if config.launch.address is None:
        return list(plan_workers([this_machine()], config).rows())
    prepare(joins=True)
    with contextlib.closing(RaySession(config.launch)) as session:
        session.start()
        return list(place_workers(config).rows())


def actor_options(place: Place) -> dict[str, Any]:
    """Ray's options of an actor or task at a place."""
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    strategy = NodeAffinitySchedulingStrategy(place.node.key, soft=False)
    return {"num_cpus": 0, "num_gpus": place.gpus, "scheduling_strategy": strategy}


def is_alive(node: Node) -> bool:
    """True if the node is in the cluster still."""
    import ray

    return any(row["NodeID"] == node.key and row["Alive"] for row in ray.nodes())


def _nodes(config: RunConfig) -> list[Node]:
    """The nodes that are there, this one first, with what they report where a cluster was joined."""
    import ray

    here = ray.get_runtime_context().get_node_id()
    rows = sorted(
        (node for node in ray.nodes() if node["Alive"]),
        key=lambda node: (node["NodeID"] != here, node["NodeManagerAddress"], node["NodeID"]),
    )
    nodes = [
        Node(
            number=number,
            key=row["NodeID"],
            name=row["NodeManagerAddress"],
            cpus=row["Resources"].get("CPU", 0.0),
            gpus=row["Resources"].get("GPU", 0.0),
            resources=frozenset(row["Resources"]) - {"CPU", "GPU", "memory", "object_store_memory"},
        )
        for number, row in enumerate(rows)
    ]
    if config.launch.address is None and len(nodes) == 1:
        return nodes
    wanted = {0}.union(*({n.number for n in candidates(nodes, role)} for role in roles_of(config)))
    folders = {"the run's folder": config.output_dir, "policy.path": config.policy.path}
    if config.imagination.share:
        folders["imagination.path"] = config.imagination.path
        folders["imagination.learn.dataset.root"] = config.imagination.learn.dataset.root
    files = {  # of folders that are here
        f"{name}, {folder}": Path(folder).absolute()
        for name, folder in folders.items()
        if folder is not None and Path(folder).is_dir()
    }
    task, paths = ray.remote(report_node), list(files.values())
    asked = {n: task.options(**actor_options(Place(nodes[n]))).remote(paths) for n in sorted(wanted)}
    for number, reference in asked.items():
        seen = _report(nodes[number], reference, str(config.launch.address))
        unseen = [name for name, sees in zip(files, seen, strict=True) if not sees]
        nodes[number] = replace(nodes[number], unseen=unseen[0] if unseen else "")
    return nodes


def _report(node: Node, reference: Any, address: str) -> list[bool]:
    """Folders that a node sees, if its versions are ours."""
    import ray
    from ray.exceptions import RayError, RayTaskError

    try:
        versions, seen = ray.get(reference, timeout=REPORT_S)
        wrong = [
            f"has {k} {versions[k]}, and this is {v}" for k, v in node_versions().items() if versions[k] != v
        ]
    except RayTaskError as error:
        wrong = [f"cannot say its versions ({str(error).strip().splitlines()[-1]})"]
    except RayError as error:
        raise WorkerError(f"{node} did not report its versions:\n{error}") from error
    if wrong:
        raise InputError(FIELD, address, f"{node} {wrong[0]}; install the same on all")
    return list(seen)


def node_versions() -> dict[str, str]:
    """Versions that must be equal on all nodes. Ray compares its own version, and Python's."""
    versions = {name: importlib.metadata.version(name) for name in ("lerobot", "torch", "accerl-lerobot")}
    code = b"".join(path.read_bytes() for path in sorted(Path(__file__).parents[1].rglob("*.py")))
    digest = hashlib.sha256(code).hexdigest()[:12]
    return {"python": platform.python_version(), **versions, "code": digest}


def report_node(folders: Sequence[Path]) -> tuple[dict[str, str], list[bool]]:
    """On a node: its versions, and which of these folders it sees."""
    return node_versions(), [folder.is_dir() for folder in folders]
