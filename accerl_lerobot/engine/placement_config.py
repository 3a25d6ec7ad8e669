# SPDX-License-Identifier: Apache-2.0
"""Settings of where workers are; `placement` makes a plan of them."""

from __future__ import annotations

from dataclasses import dataclass, field

from accerl_lerobot.config.ranges import NonNegative, Section
from accerl_lerobot.errors import InputError

WHERE = "launch.placement"


@dataclass(frozen=True, kw_only=True)
class RoleConfig(Section, section="launch.placement"):
    """Where the processes of a role are, and what each takes."""

    nodes: str | None = None
    """Where they may be: the number of a node as ``accerl doctor`` prints it, 0 being the one that the run is
    started on; the name of a resource that its node was started with, as in ``ray start
    --resources='{"simulators": 1}'``; or all. None: node 0."""
    gpus: NonNegative | None = None
    """GPUs of each: a share in (0, 1], a whole number, or 0. None: those with a network on the same nodes
    share what these have."""
    cpus: NonNegative = 0.0
    """Cores that are kept for each; 0: they take what they find."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.gpus is not None and self.gpus > 1 and self.gpus % 1:
            raise InputError(f"{self.SECTION}.gpus", self.gpus, "use a share in [0, 1] or a whole number")
        if self.nodes is not None and not self.nodes.strip():
            remedy = "name a node's number or resource, or use all"
            raise InputError(f"{self.SECTION}.nodes", self.nodes, remedy)


@dataclass(frozen=True, kw_only=True)
class PlacementConfig(Section, section="launch.placement"):
    """Where the workers of each room are; replay is where the run is started."""

    trainer: RoleConfig = field(default_factory=RoleConfig)
    """Each of its ranks."""
    inference: RoleConfig = field(default_factory=RoleConfig)
    """Each of the services."""
    imagination: RoleConfig = field(default_factory=RoleConfig)
    """Each worker that imagines, and the one that trains the world model."""
    rollout: RoleConfig = field(default_factory=RoleConfig)
    """Each rollout worker."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.rollout.gpus:
            remedy = "rollout workers have no network; leave the field out"
            raise InputError("launch.placement.rollout.gpus", self.rollout.gpus, remedy)

    @property
    def elsewhere(self) -> bool:
        """True if any role may be on another node."""
        roles = (self.trainer, self.inference, self.imagination, self.rollout)
        return any(role.nodes not in (None, "0") for role in roles)
