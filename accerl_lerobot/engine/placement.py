# SPDX-License-Identifier: Apache-2.0
"""Which worker goes where: nodes and what is asked of them in; out a plan, or the sum that does not work out.

    nodes   what each has left: CPUs, GPUs, and whether it sees the run's files
    asked   by role: how many processes, what each takes, where they may be
    plan    a node for every worker, by name

Nothing said, everything is on the node that the run is started on, and those with a network share its GPUs.
What has a network reads the policy's files, and saves its state in the run's folder; so it stays there, or
goes to nodes that see both, under the same paths. Rollout workers need no files.

Knows no Ray: `cluster` looks at the nodes, and starts workers where the plan says.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

from accerl_lerobot.engine.contract import WorkerError
from accerl_lerobot.engine.placement_config import WHERE, RoleConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.metrics import numbered
from accerl_lerobot.transport.endpoint import FIELD

if TYPE_CHECKING:
    from accerl_lerobot.engine.config import RunConfig

ALL = "all"
TINY = 1e-6
"""Rest of a GPU up to which sums of shares count as equal to the share that is asked for."""


@dataclass(frozen=True, kw_only=True)
class Node:
    """A machine of the cluster, and what it has left for this run."""

    number: int
    """0: where the run is started."""
    key: str
    """Ray's."""
    name: str
    """For people: its address."""
    cpus: float
    gpus: float
    resources: frozenset[str] = frozenset()
    """Names of the resources that it was started with."""
    host: str = ""
    """Processes of equal hosts can share memory."""
    unseen: str = ""
    """Why nothing with a network can be here: what it does not see; empty: it sees all."""

    def __str__(self) -> str:
        return f"node {self.number} ({self.name})"


class Asked(NamedTuple):
    """The processes of a role."""

    role: str
    names: tuple[str, ...]
    config: RoleConfig
    network: bool = True
    """True if they have one, and so take part of a GPU and need files."""
    share: float | None = None
    """Share of a GPU that each takes if ``config`` does not say; None: what others on the same nodes
    leave."""


class Place(NamedTuple):
    """Where one worker is, and what it takes there."""

    node: Node
    gpus: float
    cpus: float


@dataclass(frozen=True)
class Plan:
    """A place for every worker.

    Example:
        >>> plan = planned(nodes, config)
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

    def instead(self, name: str, alive: frozenset[str]) -> Place:
        """Where a rollout worker goes whose node has left.

        To the node with the fewest rollout workers for its cores, of those where there are any and of node 0;
        it keeps no cores for itself there, since what it had is gone.

        Args:
            name: of the worker.
            alive: keys of the nodes that are there.

        Raises:
            WorkerError: none of those is, as when Ray itself has been lost.
        """
        used = [place.node for other, place in self.places.items() if other.startswith("rollout ")]
        candidates = {node.number: node for node in [self.nodes[0], *used] if node.key in alive}
        if not candidates:
            raise WorkerError(f"{name} worker is lost, and no node is left where another could be started")
        load = {number: sum(n.number == number for n in used) for number in candidates}
        best = min(candidates, key=lambda number: (load[number] + 1) / max(candidates[number].cpus, 1.0))
        return Place(candidates[best], 0.0, 0.0)

    def moved(self, name: str, place: Place) -> Plan:
        """The plan with one worker somewhere else."""
        return replace(self, places=self.places | {name: place})


def this_machine() -> Node:
    """The only node of a private Ray."""
    import torch

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    gpus = torch.cuda.device_count()
    return Node(number=0, key="", name="this machine", cpus=float(cores), gpus=float(gpus))


def asked(config: RunConfig) -> list[Asked]:
    """Needs of a run besides replay, those first that take most of a GPU."""
    placement, c = config.launch.placement, config
    ranks = ("trainer", *(f"trainer rank {i}" for i in range(1, c.trainer.ranks)))
    found = [
        Asked("trainer", ranks, placement.trainer),
        Asked("inference", tuple(numbered("inference", c.inference.workers)), placement.inference),
    ]
    if c.imagination.share:
        names = numbered("imagination", c.imagination.workers)
        learns = ["world learning"] if c.imagination.learns else []
        found.append(Asked("imagination", (*names, *learns), placement.imagination))
    rollouts = tuple(f"rollout {i}" for i in range(c.rollout.workers))
    return [*found, Asked("rollout", rollouts, placement.rollout, network=False)]


def candidates(nodes: Sequence[Node], selector: str | None, field: str) -> list[Node]:
    """The nodes that a role may be on.

    Raises:
        InputError: there is none.
    """
    if selector is None:
        return [nodes[0]]
    if selector == ALL:
        return list(nodes)
    if selector.isdecimal():
        found = [node for node in nodes if node.number == int(selector)]
    else:
        found = [node for node in nodes if selector in node.resources]
    if not found:
        names = sorted({name for node in nodes for name in node.resources})
        known = f"numbers 0 to {len(nodes) - 1}" + (f" and resources {', '.join(names)}" if names else "")
        raise InputError(field, selector, f"no node of the cluster is called that; there are {known}")
    return found


def planned(nodes: Sequence[Node], config: RunConfig) -> Plan:
    """Places all workers of a run.

    Args:
        nodes: by number; the first is the one that the run is started on.
        config: the run.

    Raises:
        InputError: something does not fit, with the sum.
    """
    room = _Room(nodes)
    places: dict[str, Place] = {}
    roles = asked(config)
    sites = {role.role: _sites(nodes, role) for role in roles}
    for role in _shared(roles, sites, config):
        places |= room.place(role, sites[role.role])
    places["replay"] = Place(nodes[0], 0.0, 0.0)
    plan = Plan(tuple(nodes), places)
    _check_memory(plan, config)
    return plan


def _sites(nodes: Sequence[Node], role: Asked) -> list[Node]:
    """Where a role may be: nodes that it names, and that see what it needs."""
    field, selector = f"{WHERE}.{role.role}.nodes", role.config.nodes
    found = candidates(nodes, selector, field)
    if not role.network:
        return found
    seeing = [node for node in found if not node.unseen]
    blind = [node for node in found if node.unseen]
    if blind and (selector != ALL or not seeing):
        remedy = (
            f"{blind[0]} does not see {blind[0].unseen}, which whoever has a network reads or writes; "
            "share it under the same path, or leave the field out"
        )
        raise InputError(field, selector, remedy)
    return seeing


def _shared(roles: list[Asked], sites: dict[str, list[Node]], config: RunConfig) -> list[Asked]:
    """The roles with what each process takes of a GPU; roles on the same nodes share what these have."""
    cpu = config.policy.device == "cpu"
    groups: dict[tuple[int, ...], list[Asked]] = {}
    for role in roles:
        if role.network:
            groups.setdefault(tuple(node.number for node in sites[role.role]), []).append(role)
            if cpu and role.config.gpus:
                remedy = "policy.device=cpu takes none; leave the field out, or use another device"
                raise InputError(f"{WHERE}.{role.role}.gpus", role.config.gpus, remedy)
    found: dict[str, Asked] = {}
    for group in groups.values():
        silent = [role for role in group if role.config.gpus is None]
        here = sites[group[0].role]
        if silent and len(silent) < len(group):
            told = next(role for role in group if role.config.gpus is not None)
            remedy = (
                f"say the same of {' and '.join(role.role for role in silent)}, on the same nodes, or of none"
            )
            raise InputError(f"{WHERE}.{told.role}.gpus", told.config.gpus, remedy)
        gpus = 0.0 if cpu else sum(node.gpus for node in here)
        if silent and not gpus and config.policy.device.startswith("cuda") and any(n.number for n in here):
            remedy = f"there is no GPU left on {_listed(here)}; use auto, cpu or other nodes"
            raise InputError("policy.device", config.policy.device, remedy)
        for role in group:
            found[role.role] = role._replace(share=_share(role, group, gpus, config))
    return [found.get(role.role, role) for role in roles]


def _share(role: Asked, group: list[Asked], gpus: float, config: RunConfig) -> float:
    """Share of GPUs, for each process of a role."""
    if role.config.gpus is not None:
        if role.role == "trainer" and len(role.names) > 1 and 0 < role.config.gpus <= 0.5:
            remedy = "two ranks could share a GPU, which NCCL refuses; use more than 0.5"
            raise InputError(f"{WHERE}.trainer.gpus", role.config.gpus, remedy)
        return role.config.gpus
    whole = float(math.floor(gpus + TINY)) or gpus
    if not whole:
        return 0.0
    others = sum(len(r.names) for r in group if r.role != "trainer")
    if any(r.role == "trainer" for r in group):
        of_rank, of_other = config.trainer.gpu_shares(whole, max(1, others))
        return of_rank if role.role == "trainer" else of_other
    return 1 / math.ceil(others / whole)


class _Room:
    """Free part of every node while workers are placed; GPUs are filled up as Ray does it."""

    def __init__(self, nodes: Sequence[Node]) -> None:
        self._cpus = {node.number: node.cpus for node in nodes}
        self._gpus = {node.number: _bins(node.gpus) for node in nodes}
        self._load = {node.number: 0 for node in nodes}
        """Workers without a GPU."""
        self._taken: list[tuple[str, int, float]] = []

    def place(self, role: Asked, sites: list[Node]) -> dict[str, Place]:
        """A place for each process of a role."""
        gpus, cpus = role.share or 0.0, role.config.cpus
        if gpus:
            self._taken.append((role.role, len(role.names), gpus))
        return {name: Place(self._one(role, sites, gpus, cpus), gpus, cpus) for name in role.names}

    def _one(self, role: Asked, sites: list[Node], gpus: float, cpus: float) -> Node:
        fitting = [node for node in sites if self._cpus[node.number] >= cpus - TINY]
        if not fitting:
            free = ", ".join(f"{node.cpus:g} on {node}" for node in sites)
            remedy = (
                f"{len(role.names)} × {cpus:g} = {len(role.names) * cpus:g} CPUs beside what others keep, "
                f"and there are {free}; ask for fewer, or start another node"
            )
            raise InputError(f"{WHERE}.{role.role}.cpus", cpus, remedy)
        if gpus:
            chosen = next((node for node in fitting if self._take(node, gpus)), None)
            if chosen is None:
                raise InputError(f"{WHERE}.{role.role}.gpus", gpus, self._sum(sites))
        else:
            chosen = min(fitting, key=lambda n: (self._load[n.number] + 1) / max(n.cpus, 1.0))
            self._load[chosen.number] += 1
        self._cpus[chosen.number] -= cpus
        return chosen

    def _take(self, node: Node, gpus: float) -> bool:
        """Takes so much of a GPU, or so many whole ones, if the node has them."""
        bins = self._gpus[node.number]
        if gpus > 1:
            whole = [i for i, free in enumerate(bins) if free >= 1 - TINY][: int(gpus)]
            for i in whole if len(whole) == gpus else ():
                bins[i] = 0.0
            return len(whole) == gpus
        fitting = [i for i, free in enumerate(bins) if free >= gpus - TINY]
        if fitting:
            bins[min(fitting, key=lambda i: bins[i])] -= gpus
        return bool(fitting)

    def _sum(self, sites: list[Node]) -> str:
        """Why a GPU cannot be had."""
        terms = " + ".join(f"{_count(role, n)} × {gpus:g}" for role, n, gpus in self._taken)
        total = sum(n * gpus for _, n, gpus in self._taken)
        there = sum(node.gpus for node in sites)
        text = f"{terms} = {total:g} GPUs, and there are {there:g} on {_listed(sites)}"
        if total <= there:
            text += ", of which no single one has room for all that are left"
        return f"{text}; ask for less, or for other nodes"


def _check_memory(plan: Plan, config: RunConfig) -> None:
    """Refuses what needs shared memory between nodes."""
    hosts = {name: place.node for name, place in plan.places.items()}
    first = plan.nodes[0].host
    if config.launch.transport == "shared_memory":
        far = next((n for n in hosts.values() if n.host != first), None)
        if far is not None:
            remedy = f"{far} shares no memory with {plan.nodes[0]}; use auto, which takes Ray between them"
            raise InputError(FIELD, config.launch.transport, remedy)


def _bins(gpus: float) -> list[float]:
    """GPUs of a node, each with what is left of it."""
    whole = math.floor(gpus + TINY)
    rest = gpus - whole
    return [1.0] * whole + ([rest] if rest > TINY else [])


def _listed(nodes: Sequence[Node]) -> str:
    return ", ".join(map(str, nodes))


def _count(name: str, count: int) -> str:
    return name if count == 1 else f"{count} {name}"
