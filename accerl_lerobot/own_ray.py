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
"""A run's own Ray, kept while workers come and go: after a loss they are started again, and not Ray."""

from __future__ import annotations

import logging

import ray
from ray.exceptions import GetTimeoutError, RayError

from accerl_lerobot.cluster import start_ray
from accerl_lerobot.config import LaunchConfig

logger = logging.getLogger(__name__)

RESPONDS_S = 20.0
"""How long Ray may take to start a process, or it is taken for broken."""


class OwnRay:
    """Ray, for as long as it is not closed; one that was there before is used and left running, and so is a
    cluster.

    Example:
        >>> own = OwnRay(config.launch)
        >>> own.start()     # for the first workers
        >>> own.start()     # for their successors: looks whether it still does what it is asked to
        >>> own.close()

    Args:
        launch: whether a cluster is to be joined.
    """

    def __init__(self, launch: LaunchConfig) -> None:
        self._launch, self._started = launch, False

    def start(self) -> None:
        """Starts it unless it is there, or if it does not respond any more.

        Raises:
            InputError: there is no such cluster, see `cluster.start_ray`.
        """
        if ray.is_initialized():
            if not self._started or _responds():
                return
            logger.warning("Ray does not respond any more and is started again")
            ray.shutdown()
        self._started = True
        start_ray(self._launch)

    def close(self) -> None:
        """Ends it, if it was started here. Safe to call twice."""
        if self._started and ray.is_initialized():
            ray.shutdown()
        self._started = False


def _responds() -> bool:
    """Whether a process can still be had."""
    try:
        return bool(ray.get(ray.remote(_there).options(num_cpus=0).remote(), timeout=RESPONDS_S))
    except (RayError, GetTimeoutError):
        return False


def _there() -> bool:
    return True
