# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Settings of where workers are; `placement` makes a plan of them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from accerl_lerobot.errors import InputError

WHERE = "launch.placement"


@dataclass(frozen=True, kw_only=True)
class RoleConfig:
    """Where the processes of a role are, and what each takes."""

    nodes: str | None = None
    """Where they may be: the number of a node as ``accerl doctor`` prints it, 0 being the one that the run is
    started on; the name of a resource that its node was started with, as in ``ray start
    --resources='{"simulators": 1}'``; or all. None: node 0."""
    gpus: float | None = None
    """GPUs of each: a share in (0, 1], a whole number, or 0. None: those with a network on the same nodes
    share what these have."""
    cpus: float = 0.0
    """Cores that are kept for each; 0: they take what they find."""

    def check(self, where: str) -> None:
        """Refuses values that mean nothing.

        Raises:
            InputError: names the field below `where`.
        """
        if self.gpus is not None and not (0 <= self.gpus <= 1 or (self.gpus > 1 and self.gpus % 1 == 0)):
            raise InputError(f"{where}.gpus", self.gpus, "use a share in [0, 1] or a whole number")
        if not 0 <= self.cpus < math.inf:
            raise InputError(f"{where}.cpus", self.cpus, "use 0 (none are kept) or more")
        if self.nodes is not None and not self.nodes.strip():
            raise InputError(f"{where}.nodes", self.nodes, "name a node's number or resource, or use all")


@dataclass(frozen=True, kw_only=True)
class PlacementConfig:
    """Where the workers of each room are; replay is where the run is started."""

    trainer: RoleConfig = field(default_factory=RoleConfig)
    """Each of its ranks."""
    inference: RoleConfig = field(default_factory=RoleConfig)
    """Each of the services."""
    imagination: RoleConfig = field(default_factory=RoleConfig)
    """Each that dreams, and the one that goes on learning the world."""
    rollout: RoleConfig = field(default_factory=RoleConfig)
    """Each rollout worker."""

    def __post_init__(self) -> None:
        for role in ("trainer", "inference", "imagination", "rollout"):
            getattr(self, role).check(f"{WHERE}.{role}")
        if self.rollout.gpus:
            remedy = "rollout workers have no network; leave the field out"
            raise InputError(f"{WHERE}.rollout.gpus", self.rollout.gpus, remedy)

    @property
    def elsewhere(self) -> bool:
        """Whether any role may be on another node."""
        roles = (self.trainer, self.inference, self.imagination, self.rollout)
        return any(role.nodes not in (None, "0") for role in roles)
