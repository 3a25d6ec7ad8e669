# SPDX-License-Identifier: Apache-2.0
"""Placement: the nodes of each role's workers, and their share of a GPU, as options that Ray schedules by.

By default everything is on the node where the run is started, and processes with a network share its GPUs.
``launch.placement`` sends a role to the nodes with a resource, or spreads it over all. Workers with a network
read the policy's files and write into the run's folder, so their nodes must see both under the same paths.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from accerl_lerobot.algorithms import ChunkCriticConfig
from accerl_lerobot.engines.ray_session import opened
from accerl_lerobot.errors import InputError

if TYPE_CHECKING:
    from accerl_lerobot.engines.config import RunConfig

SECTION = "launch.placement"
ALL = "all"
PART = 0.001  # share of a resource that a worker takes, so that any number of them fit where it is


class Placement:
    """Where the workers of a run go, in a Ray that is running or, without one, on this machine alone."""

    def __init__(self, config: RunConfig, nodes: list[dict[str, float]], this_node: str = "") -> None:
        """`nodes` are the resources of each node, this one first; `this_node` is Ray's id of that."""
        self._nodes, self._this_node, self._selectors = nodes, this_node, config.launch.placement
        self._workers = {
            "trainer": config.trainer.ranks,
            "world_model": int(learns_states(config) or config.imagination.learns),
            "inference": config.inference.workers,
            "rollout": config.rollout.workers,
        }
        # The world model of imagined environments predicts and learns on processors.
        self._on_cpu = {"rollout"} if learns_states(config) else {"rollout", "world_model"}
        self._check_resources()
        self._shares = {} if config.policy.device == "cpu" else self._gpu_shares(config)

    def options(self, role: str) -> dict[str, Any]:
        """Ray's options of an actor of this role; ``replay`` is on this node."""
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        options: dict[str, Any] = {"num_cpus": 0, "num_gpus": self._shares.get(role, 0.0)}
        selector = self._selectors.get(role)
        if selector is None:
            here = NodeAffinitySchedulingStrategy(self._this_node, soft=False)
            return options | {"scheduling_strategy": here}
        if selector == ALL:
            # Ray chooses the node of a worker that takes nothing by chance.
            return options | {"num_cpus": PART, "scheduling_strategy": "SPREAD"}
        return options | {"resources": {selector: PART}}

    def is_here(self, role: str) -> bool:
        """True if all workers of a role are on this node."""
        return role not in self._selectors

    def rows(self) -> list[str]:
        """The plan in words, one line a role."""
        rows = []
        for role, count in (self._workers | {"replay": 1}).items():
            if count:
                selector = self._selectors.get(role)
                where = "this node" if selector is None else f"nodes with {selector}"
                share = self._shares.get(role, 0.0)
                gpus = f" × {share:g} GPU" if share else ""
                rows.append(f"{count} {role}{gpus} on {'all nodes' if selector == ALL else where}")
        return rows

    def _on(self, selector: str | None) -> list[dict[str, float]]:
        """Resources of the nodes that a selector means."""
        if selector is None:
            return self._nodes[:1]
        return [node for node in self._nodes if selector == ALL or selector in node]

    def _check_resources(self) -> None:
        for role, selector in self._selectors.items():
            if not self._on(selector):
                names = {name for node in self._nodes for name in node} - {"CPU", "GPU", "memory"}
                known = ", ".join(sorted(names - {"object_store_memory"}))
                hint = f"no node of the cluster has this resource; there are {known}, or use all"
                raise InputError(f"{SECTION}.{role}", selector, hint)

    def _gpu_shares(self, config: RunConfig) -> dict[str, float]:
        """Share of a GPU for each process of a role; roles that are sent to the same nodes share what these
        have."""
        shares: dict[str, float] = {}
        groups: dict[str | None, list[str]] = {}
        for role, count in self._workers.items():
            if count and role not in self._on_cpu:
                groups.setdefault(self._selectors.get(role), []).append(role)
        for selector, roles in groups.items():
            gpus = sum(node.get("GPU", 0.0) for node in self._on(selector))
            if not gpus and config.policy.device.startswith("cuda") and selector is not None:
                hint = f"there is no GPU on the nodes with {selector}; use auto, cpu or other nodes"
                raise InputError("policy.device", config.policy.device, hint)
            others = sum(self._workers[role] for role in roles if role != "trainer")
            share = 1 / math.ceil(others / gpus) if gpus and others else 0.0
            if "trainer" in roles:
                shares["trainer"], share = config.trainer.gpu_shares(gpus, max(1, others))
            shares |= {role: share for role in roles if role != "trainer"}
        return shares


def learns_states(config: RunConfig) -> bool:
    """True if the run has a world model that critic and teacher stand on, and that learns."""
    from accerl_lerobot.world_model.states import can_learn

    return isinstance(config.algorithm, ChunkCriticConfig) and can_learn(config.state_model)


def place_workers(config: RunConfig) -> Placement:
    """The placement of a run on the nodes that Ray has now."""
    import ray

    this_node = ray.get_runtime_context().get_node_id()
    alive = [node for node in ray.nodes() if node["Alive"]]
    alive.sort(key=lambda node: node["NodeID"] != this_node)
    return Placement(config, [node["Resources"] for node in alive], this_node)


def check_placement(config: RunConfig) -> list[str]:
    """Plan where the workers will be, so that what does not fit is refused before anything long; as lines."""
    if config.launch.engine == "local":
        return []
    if config.launch.address is not None:
        with opened(config.launch):
            return place_workers(config).rows()
    import torch

    return Placement(config, [{"GPU": float(torch.cuda.device_count())}]).rows()
