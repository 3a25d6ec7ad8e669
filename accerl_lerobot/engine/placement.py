# SPDX-License-Identifier: Apache-2.0
"""Placement: which worker runs on which node, and what it takes there.

    nodes   each with its CPUs and GPUs, and whether it sees the run's files
    roles   how many processes, what each takes, and where they may be
    plan    a node for every worker, by name

By default everything is on the node where the run is started, and processes with a network share its GPUs.
These read the policy's files and write into the run's folder, so they need a node that sees both under the
same paths. Rollout workers need no files. Ray is told node by node: left to Ray, a worker that fits nowhere
is waited for without a word.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import secrets
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from accerl_lerobot.engine.contract import WorkerError
from accerl_lerobot.engine.ray_session import FIELD, start_ray
from accerl_lerobot.errors import InputError
from accerl_lerobot.metrics import numbered
from accerl_lerobot.transport import endpoint

if TYPE_CHECKING:
    from accerl_lerobot.engine.config import RoleConfig, RunConfig

logger = logging.getLogger(__name__)

SECTION = "launch.placement"
ALL = "all"
TINY = 1e-6
"""Rounding error of sums of GPU shares."""
REPORT_S = 120.0
"""Timeout for a node to start a process and report what it has."""
FREE_S = 30.0
"""Timeout for the planned resources of a cluster to be free."""
VERSIONS = ("python", "lerobot", "torch", "accerl_lerobot", "its code")
"""Versions that must be equal on all nodes. Ray compares its own version."""


@dataclass(frozen=True, kw_only=True)
class Node:
    """A machine of the cluster."""

    number: int
    """0: where the run is started."""
    key: str
    """Ray's id."""
    name: str
    """Its address."""
    cpus: float
    gpus: float
    resources: frozenset[str] = frozenset()
    """Names of its custom resources."""
    host: str = ""
    """Equal for nodes whose processes can share memory."""
    unseen: str = ""
    """A folder of the run that it does not see; empty: it sees all."""

    def __str__(self) -> str:
        return f"node {self.number} ({self.name})"


class Role(NamedTuple):
    """The workers of a kind."""

    name: str
    workers: tuple[str, ...]
    config: RoleConfig
    network: bool = True
    """True if they need a share of a GPU, and files."""
    gpus: float = 0.0
    """Share of a GPU for each."""


class Place(NamedTuple):
    """Where one worker is, and what it takes there."""

    node: Node
    gpus: float = 0.0
    cpus: float = 0.0


@dataclass(frozen=True)
class Plan:
    """A place for every worker.

    Example:
        >>> plan = plan_workers(nodes, config)
        >>> plan.places["trainer"].node.number
        0
    """

    nodes: tuple[Node, ...]
    places: dict[str, Place]

    def rows(self) -> Iterator[str]:
        """The plan as lines for people, one for each node."""
        for node in self.nodes:
            here: dict[tuple[str, float, float], int] = {}
            for name, place in self.places.items():
                if place.node.number == node.number:
                    kind = (name.rstrip("0123456789 "), place.gpus, place.cpus)
                    here[kind] = here.get(kind, 0) + 1
            parts = [
                _count(name, count)
                + (f" × {gpus:g} GPU" if gpus else "")
                + (f" × {cpus:g} CPU" if cpus else "")
                for (name, gpus, cpus), count in here.items()
            ]
            yield f"{node}, {node.cpus:g} CPUs, {node.gpus:g} GPUs: {', '.join(parts) or 'nothing'}"

    def moved(self, name: str, alive: frozenset[str]) -> Plan:
        """The plan with a rollout worker, whose node has left, on another one.

        It goes to the node with the fewest rollout workers for its cores, among node 0 and those that have
        any, and keeps no cores for itself there.

        Args:
            alive: keys of the nodes that are there.

        Raises:
            WorkerError: none is left, as when Ray itself has been lost.
        """
        used = [place.node for other, place in self.places.items() if other.startswith("rollout ")]
        left = {node.number: node for node in [self.nodes[0], *used] if node.key in alive}
        if not left:
            raise WorkerError(f"{name} worker is lost, and no node is left where another could be started")
        load = {number: sum(n.number == number for n in used) for number in left}
        best = min(left, key=lambda number: (load[number] + 1) / max(left[number].cpus, 1.0))
        return replace(self, places=self.places | {name: Place(left[best])})


def this_machine() -> Node:
    """The only node of a private Ray."""
    import torch

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    gpus = torch.cuda.device_count()
    return Node(number=0, key="", name="this machine", cpus=float(cores), gpus=float(gpus))


def roles_of(config: RunConfig) -> list[Role]:
    """The roles of a run besides replay, in the order in which they are placed."""
    placement, c = config.launch.placement, config
    ranks = ("trainer", *(f"trainer rank {i}" for i in range(1, c.trainer.ranks)))
    roles = [
        Role("trainer", ranks, placement.trainer),
        Role("inference", tuple(numbered("inference", c.inference.workers)), placement.inference),
    ]
    if c.imagination.share:
        learns = ["world learning"] if c.imagination.learns else []
        roles.append(Role("imagination", ("imagination", *learns), placement.imagination))
    rollouts = tuple(f"rollout {i}" for i in range(c.rollout.workers))
    return [*roles, Role("rollout", rollouts, placement.rollout, network=False)]


def candidates(nodes: Sequence[Node], selector: str | None, field: str) -> list[Node]:
    """The nodes that a selector names.

    Raises:
        InputError: there is none.
    """
    if selector is None:
        return [nodes[0]]
    if selector == ALL:
        return list(nodes)
    if selector.isdecimal():
        chosen = [node for node in nodes if node.number == int(selector)]
    else:
        chosen = [node for node in nodes if selector in node.resources]
    if not chosen:
        names = sorted({name for node in nodes for name in node.resources})
        known = f"numbers 0 to {len(nodes) - 1}" + (f" and resources {', '.join(names)}" if names else "")
        raise InputError(field, selector, f"no node of the cluster is called that; there are {known}")
    return chosen


def plan_workers(nodes: Sequence[Node], config: RunConfig) -> Plan:
    """Place all workers of a run.

    Args:
        nodes: by number.

    Raises:
        InputError: something does not fit, with the sum.
    """
    free = _Free(nodes)
    roles = roles_of(config)
    sites = {role.name: _sites(nodes, role) for role in roles}
    places: dict[str, Place] = {}
    for role in _with_shares(roles, sites, config):
        places |= free.place(role, sites[role.name])
    places["replay"] = Place(nodes[0])
    far = next((p.node for p in places.values() if p.node.host != nodes[0].host), None)
    if config.launch.transport == "shared_memory" and far is not None:
        remedy = f"{far} shares no memory with {nodes[0]}; use auto, which takes Ray between them"
        raise InputError(endpoint.FIELD, config.launch.transport, remedy)
    return Plan(tuple(nodes), places)


def _sites(nodes: Sequence[Node], role: Role) -> list[Node]:
    """The nodes that a role names, and that see the files it needs."""
    field, selector = f"{SECTION}.{role.name}.nodes", role.config.nodes
    named = candidates(nodes, selector, field)
    if not role.network:
        return named
    seeing = [node for node in named if not node.unseen]
    blind = [node for node in named if node.unseen]
    if blind and (selector != ALL or not seeing):
        remedy = (
            f"{blind[0]} does not see {blind[0].unseen}, which its workers read or write; "
            "share it under the same path, or leave the field out"
        )
        raise InputError(field, selector, remedy)
    return seeing


def _with_shares(roles: list[Role], sites: dict[str, list[Node]], config: RunConfig) -> list[Role]:
    """The roles with their share of GPUs; roles on the same nodes share what these have."""
    cpu = config.policy.device == "cpu"
    groups: dict[tuple[int, ...], list[Role]] = {}
    for role in roles:
        if role.network:
            groups.setdefault(tuple(node.number for node in sites[role.name]), []).append(role)
            if cpu and role.config.gpus:
                remedy = "policy.device=cpu takes none; leave the field out, or use another device"
                raise InputError(f"{SECTION}.{role.name}.gpus", role.config.gpus, remedy)
    shares: dict[str, float] = {}
    for group in groups.values():
        unset = [role for role in group if role.config.gpus is None]
        here = sites[group[0].name]
        if unset and len(unset) < len(group):
            told = next(role for role in group if role.config.gpus is not None)
            names = " and ".join(role.name for role in unset)
            remedy = f"say the same of {names}, on the same nodes, or of none"
            raise InputError(f"{SECTION}.{told.name}.gpus", told.config.gpus, remedy)
        gpus = 0.0 if cpu else sum(node.gpus for node in here)
        if unset and not gpus and config.policy.device.startswith("cuda") and any(n.number for n in here):
            remedy = f"there is no GPU on {_listed(here)}; use auto, cpu or other nodes"
            raise InputError("policy.device", config.policy.device, remedy)
        for role in group:
            shares[role.name] = _share(role, group, gpus, config)
    return [role._replace(gpus=shares.get(role.name, 0.0)) for role in roles]


def _share(role: Role, group: list[Role], gpus: float, config: RunConfig) -> float:
    """Share of a GPU for each process of a role."""
    if (given := role.config.gpus) is not None:
        if role.name == "trainer" and len(role.workers) > 1 and 0 < given <= 0.5:
            remedy = "two ranks could share a GPU, which NCCL refuses; use more than 0.5"
            raise InputError(f"{SECTION}.trainer.gpus", given, remedy)
        return given
    if not gpus:
        return 0.0
    others = sum(len(r.workers) for r in group if r.name != "trainer")
    if any(r.name == "trainer" for r in group):
        of_rank, of_other = config.trainer.gpu_shares(gpus, max(1, others))
        return of_rank if role.name == "trainer" else of_other
    return 1 / math.ceil(others / gpus)


class _Free:
    """Free CPUs and GPUs of every node while workers are placed; GPUs are filled as Ray fills them."""

    def __init__(self, nodes: Sequence[Node]) -> None:
        self._cpus = {node.number: node.cpus for node in nodes}
        self._gpus = {node.number: [1.0] * round(node.gpus) for node in nodes}
        self._load = {node.number: 0 for node in nodes}
        """Workers without a GPU."""
        self._taken: list[tuple[str, int, float]] = []

    def place(self, role: Role, sites: list[Node]) -> dict[str, Place]:
        """A place for each worker of a role."""
        if role.gpus:
            self._taken.append((role.name, len(role.workers), role.gpus))
        cpus = role.config.cpus
        return {name: Place(self._node(role, sites), role.gpus, cpus) for name in role.workers}

    def _node(self, role: Role, sites: list[Node]) -> Node:
        cpus = role.config.cpus
        fitting = [node for node in sites if self._cpus[node.number] >= cpus - TINY]
        if not fitting:
            free = ", ".join(f"{node.cpus:g} on {node}" for node in sites)
            total = f"{len(role.workers)} × {cpus:g} = {len(role.workers) * cpus:g} CPUs"
            remedy = (
                f"{total} beside what others keep, and there are {free}; ask for fewer, or start another node"
            )
            raise InputError(f"{SECTION}.{role.name}.cpus", cpus, remedy)
        if role.gpus:
            chosen = next((node for node in fitting if self._take_gpu(node, role.gpus)), None)
            if chosen is None:
                raise InputError(f"{SECTION}.{role.name}.gpus", role.gpus, self._sum(sites))
        else:
            chosen = min(fitting, key=lambda n: (self._load[n.number] + 1) / max(n.cpus, 1.0))
            self._load[chosen.number] += 1
        self._cpus[chosen.number] -= cpus
        return chosen

    def _take_gpu(self, node: Node, share: float) -> bool:
        """Take a share of the fullest GPU of a node that has room for it; False if none has."""
        free = self._gpus[node.number]
        fitting = [i for i, left in enumerate(free) if left >= share - TINY]
        if fitting:
            free[min(fitting, key=lambda i: free[i])] -= share
        return bool(fitting)

    def _sum(self, sites: list[Node]) -> str:
        """Reason why no GPU is left."""
        terms = " + ".join(f"{_count(role, n)} × {gpus:g}" for role, n, gpus in self._taken)
        total = sum(n * gpus for _, n, gpus in self._taken)
        there = sum(node.gpus for node in sites)
        text = f"{terms} = {total:g} GPUs, and there are {there:g} on {_listed(sites)}"
        if total <= there:
            text += ", of which no single one has room for all that are left"
        return f"{text}; ask for less, or for other nodes"


def _listed(nodes: Sequence[Node]) -> str:
    return ", ".join(map(str, nodes))


def _count(name: str, count: int) -> str:
    return name if count == 1 else f"{count} {name}"


def place_workers(config: RunConfig) -> Plan:
    """Plan where the workers of a run go on the nodes that Ray has now.

    Raises:
        InputError: they do not fit, or a node has other versions.
        WorkerError: a node does not answer.
    """
    known = alive_nodes()
    try:
        nodes = _nodes(config)
    except WorkerError:
        if known <= alive_nodes():
            raise
        nodes = _nodes(config)  # one has left, which Ray finds out when it is asked for something
    plan = plan_workers(nodes, config)
    for row in plan.rows():
        logger.info("%s", row)
    if config.launch.address is not None:
        _check_free(plan)
    return plan


def rehearse(config: RunConfig) -> list[str]:
    """The plan as lines, of a run that joins a cluster; leaves it as it was.

    Raises:
        InputError: see `start_ray` and `place_workers`.
    """
    import ray

    if ray.is_initialized():
        return list(place_workers(config).rows())
    start_ray(config.launch)
    try:
        return list(place_workers(config).rows())
    finally:
        ray.shutdown()


def actor_options(place: Place) -> dict[str, Any]:
    """Ray's options of an actor or task at a place."""
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    strategy = NodeAffinitySchedulingStrategy(place.node.key, soft=False)
    return {"num_cpus": place.cpus, "num_gpus": place.gpus, "scheduling_strategy": strategy}


def alive_nodes() -> frozenset[str]:
    """Keys of the nodes that are there."""
    import ray

    return frozenset(node["NodeID"] for node in ray.nodes() if node["Alive"])


def _check_free(plan: Plan) -> None:
    """Take the planned resources of every node for a moment.

    Raises:
        InputError: other runs hold them.
    """
    import ray
    from ray.exceptions import GetTimeoutError

    for node in plan.nodes:
        here = [place for place in plan.places.values() if place.node.number == node.number]
        cpus, gpus = sum(place.cpus for place in here), sum(place.gpus for place in here)
        if cpus or gpus:
            whole = Place(node, math.ceil(gpus) if gpus > 1 else gpus, cpus)
            taken = ray.remote(lambda: True).options(**actor_options(whole)).remote()
            try:
                ray.get(taken, timeout=FREE_S)
            except GetTimeoutError as error:
                ray.cancel(taken)
                remedy = (
                    f"the plan takes {cpus:g} CPUs and {gpus:g} GPUs of {node}, part of which others hold; "
                    "wait for them, or ask for less"
                )
                raise InputError(SECTION, "…", remedy) from error


def _nodes(config: RunConfig) -> list[Node]:
    """The nodes that are there, this one first, with what they report where a cluster was joined.

    Raises:
        InputError: a node that a worker may be on has other versions.
        WorkerError: it does not answer.
    """
    import ray

    from accerl_lerobot.transport.shared_memory import this_node

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
            resources=frozenset(name for name in row["Resources"] if _is_custom(name)),
            host=row["NodeID"] if len(rows) > 1 else this_node(),
        )
        for number, row in enumerate(rows)
    ]
    if config.launch.address is None and len(nodes) == 1:
        return nodes
    wanted = {0}
    for role in roles_of(config):
        wanted |= {n.number for n in candidates(nodes, role.config.nodes, f"{SECTION}.{role.name}.nodes")}
    reports = _reports([node for node in nodes if node.number in wanted], config)
    return [reports.get(node.key, node) for node in nodes]


def _is_custom(name: str) -> bool:
    own = ("CPU", "GPU", "memory", "object_store_memory")
    return name not in own and not name.startswith(("node:", "accelerator_type:"))


def _reports(nodes: list[Node], config: RunConfig) -> dict[str, Node]:
    """Nodes by key with their ``host`` and ``unseen``, once their versions have been compared with ours."""
    import ray
    from ray.exceptions import GetTimeoutError, RayError

    policy = config.policy.path if config.policy.path and Path(config.policy.path).is_dir() else None
    report = _reporter()
    reports: dict[str, Node] = {}
    with _mark(config) as mark:
        here, task = report(mark, policy), ray.remote(report)
        asked = [(n, task.options(**actor_options(Place(n))).remote(mark, policy)) for n in nodes]
        for node, reference in asked:
            try:
                there = ray.get(reference, timeout=REPORT_S)
            except GetTimeoutError as error:
                raise WorkerError(f"{node} has not reported its versions within {REPORT_S:.0f} s") from error
            except RayError as error:
                raise WorkerError(f"{node} could not report its versions:\n{error}") from error
            for name in VERSIONS:
                if there[name] != here[name]:
                    said = f"{node} has {name} {there[name] or 'missing'}, and this is {here[name]}"
                    raise InputError(FIELD, config.launch.address, f"{said}; install the same on all")
            unseen = ""
            if policy is not None and there["policy"] != here["policy"]:
                unseen = f"policy.path, {policy}"
            if there["mark"] != here["mark"]:
                unseen = f"the run's folder, {config.output_dir}"
            reports[node.key] = replace(node, host=there["host"], unseen=unseen)
    return reports


@contextlib.contextmanager
def _mark(config: RunConfig) -> Iterator[str | None]:
    """A file in the run's folder while nodes look for it."""
    if config.output_dir is None:
        yield None
        return
    path = Path(config.output_dir).absolute() / f".seen-{secrets.token_hex(8)}"
    path.touch()
    try:
        yield str(path)
    finally:
        path.unlink(missing_ok=True)


def _reporter() -> Callable[[str | None, str | None], dict[str, str]]:
    """The function that a node runs; it travels by value, since the package may be missing there."""

    def report(mark: str | None, policy: str | None) -> dict[str, str]:
        import hashlib
        import importlib.metadata
        import importlib.util
        import platform
        from pathlib import Path

        def version(name: str) -> str:
            try:
                return importlib.metadata.version(name)
            except importlib.metadata.PackageNotFoundError:
                return ""

        def digest(paths: list[Path]) -> str:
            state = hashlib.sha256()
            for path in paths:
                state.update(path.name.encode() + b"\0" + path.read_bytes())
            return state.hexdigest()[:12]

        spec = importlib.util.find_spec("accerl_lerobot")
        folder = None if spec is None or spec.origin is None else Path(spec.origin).parent
        config = None if policy is None else Path(policy) / "config.json"
        host = ""
        if folder is not None:
            from accerl_lerobot.transport.shared_memory import this_node

            host = this_node()
        return {
            "python": ".".join(platform.python_version_tuple()[:2]),
            "lerobot": version("lerobot"),
            "torch": version("torch"),
            "accerl_lerobot": version("accerl-lerobot"),
            "its code": "" if folder is None else digest(sorted(folder.rglob("*.py"))),
            "host": host,
            "policy": "" if config is None or not config.is_file() else digest([config]),
            "mark": "" if mark is None or not Path(mark).is_file() else "seen",
        }

    return report
