# SPDX-License-Identifier: Apache-2.0
"""Where a service is reached, and by which transport."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from accerl_lerobot.errors import InputError
from accerl_lerobot.transport.contract import Caller
from accerl_lerobot.transport.nameless import available
from accerl_lerobot.transport.shared_memory import Address, SharedMemoryCaller, this_node

Transport = Literal["auto", "ray", "shared_memory"]
FIELD = "launch.transport"


@dataclass(frozen=True, kw_only=True)
class Endpoint:
    """Address of a service, which a worker needs in order to call it.

    Example:
        >>> inference = Endpoint(name="inference", method=actor.decide, address=address)
        >>> caller = inference.connect()  # in the process that calls
    """

    name: str
    """Name of the service, for messages."""
    method: Any
    """Method of the actor's handle; the way through Ray."""
    address: Address | None = None
    """Address of its shared memory; None: only Ray leads there."""
    transport: Transport = "auto"

    def connect(self) -> Caller:
        """A connection of this process's own.

        Raises:
            InputError: shared memory was asked for, and the service is on another node.
            ServiceStoppedError: the service is gone.
        """
        if self.address is not None and available() and self.address.node == this_node():
            return SharedMemoryCaller(self.name, self.address)
        if self.transport == "shared_memory":
            remedy = f"{self.name} is on another node; use auto or ray"
            raise InputError(FIELD, self.transport, remedy)
        from accerl_lerobot.transport.ray_calls import RayCaller

        return RayCaller(self.name, self.method)


def listens(transport: Transport) -> bool:
    """True if services are to offer shared memory to their callers.

    Raises:
        InputError: it was asked for and this system does not have it.
    """
    if transport == "shared_memory" and not available():
        raise InputError(FIELD, transport, "this system has no memfd, epoll and eventfd; use auto or ray")
    return transport != "ray" and available()
