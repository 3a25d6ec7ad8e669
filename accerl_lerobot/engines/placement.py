# SPDX-License-Identifier: Apache-2.0
"""Placement: the nodes of each role's workers, and their share of a GPU, as options that Ray schedules by.

By default everything is on the node where the run is started, and processes with a network share its GPUs.
``launch.placement`` sends a role to the nodes with a resource, or spreads it over all. Workers with a network
read the policy's files and write into the run's folder, so their nodes must see both under the same paths.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from accerl_lerobot.algorithms import ChunkCriticConfig
from accerl_lerobot.engines.ray_session import opened
from accerl_lerobot.errors import InputError

if TYPE_CHECKING:
    from accerl_lerobot.engines.config import RunConfig

ALL = "all"
PART = 0.001  # share of a resource that a worker takes, so that any number of them fit where it is


class Placement:
    """Where the workers of a run go, in a Ray that is running or, without one, on this machine alone."""

    def __init__(self, config: RunConfig, nodes: list[dict[str, float]], this_node: str = "") -> None:
        """`nodes` are the resources of each node, this one first; `this_node` is Ray's id of that."""
        self._nodes = nodes
        self._this_node = this_node
        self._selectors = config.launch.placement
        learns = learns_states(config)
        self._workers = {
            "trainer": config.trainer.ranks,
            "world_model": int(learns or config.imagination.learns),
            "inference": config.inference.workers,
            "rollout": config.rollout.workers,
        }
        for role in self._selectors:
            self._nodes_of(role)
        # The world model of imagined environments predicts and learns on processors.
        on_gpu = ("trainer", "inference", "world_model") if learns else ("trainer", "inference")
        self._shares = {} if config.policy.device == "cpu" else self._gpu_shares(config, on_gpu)

    def options(self, role: str) -> dict[str, Any]:
        """Ray's options of an actor of this role; ``replay`` is on this node."""
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        options: dict[str, Any] = {"num_cpus": 0, "num_gpus": self._shares.get(role, 0.0)}
        selector = self._selectors.get(role)
        if selector is None:
            options["scheduling_strategy"] = NodeAffinitySchedulingStrategy(self._this_node, soft=False)
        elif selector == ALL:
            # Ray chooses the node of a worker that takes nothing by chance.
            options |= {"num_cpus": PART, "scheduling_strategy": "SPREAD"}
        else:
            options["resources"] = {selector: PART}
        return options

    def rows(self) -> list[str]:
        """One line for each role: its workers, their share of a GPU, and their nodes."""
        rows = []
        for role, count in (self._workers | {"replay": 1}).items():
            selector = self._selectors.get(role)
            if selector is None:
                where = "this node"
            else:
                where = "all nodes" if selector == ALL else f"nodes with {selector}"
            share = self._shares.get(role, 0.0)
            gpus = f" × {share:g} GPU" if share else ""
            if count:
                rows.append(f"{count} {role}{gpus} on {where}")
        return rows

    def _nodes_of(self, role: str) -> list[dict[str, float]]:
        """Resources of the nodes that a role's workers may be on."""
        selector = self._selectors.get(role)
        if selector is None:
            return self._nodes[:1]
        if selector == ALL:
            return self._nodes
        nodes = [node for node in self._nodes if selector in node]
        if not nodes:
            known = set().union(*self._nodes) - {"CPU", "GPU", "memory"}
            names = ", ".join(sorted(known))
            hint = f"no node of the cluster has this resource; there are {names}, or use all"
            raise InputError(f"launch.placement.{role}", selector, hint)
        return nodes

    def _gpu_shares(self, config: RunConfig, on_gpu: Sequence[str]) -> dict[str, float]:
        """Share of a GPU for each process of a role. Roles on the same nodes share their GPUs."""
        shares: dict[str, float] = {}
        for selector in {self._selectors.get(role) for role in on_gpu}:
            roles = [role for role in on_gpu if self._selectors.get(role) == selector]
            gpus = sum(node.get("GPU", 0.0) for node in self._nodes_of(roles[0]))
            if not gpus and config.policy.device.startswith("cuda") and selector is not None:
                hint = f"there is no GPU on the nodes with {selector}; use auto, cpu or other nodes"
                raise InputError("policy.device", config.policy.device, hint)
            others = sum(self._workers[role] for role in roles if role != "trainer")
            share = 1 / math.ceil(others / gpus) if gpus and others else 0.0
            of_trainer = 0.0
            if "trainer" in roles:
                of_trainer, share = config.trainer.gpu_shares(gpus, max(1, others))
            for role in roles:
                shares[role] = of_trainer if role == "trainer" else share
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
    """Refuse a placement that does not fit before any long work; returns the placement as lines."""
    if config.launch.engine == "local":
        return []
    if config.launch.address is not None:
        with opened(config.launch):
            return place_workers(config).rows()
    import torch

    return Placement(config, [{"GPU": float(torch.cuda.device_count())}]).rows()
