# SPDX-License-Identifier: Apache-2.0
"""Which way weights go to which reader.

shared memory   to readers on this machine
Ray             to all others
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any, get_args

from accerl_lerobot.errors import InputError
from accerl_lerobot.transport.endpoint import FIELD, Transport
from accerl_lerobot.transport.memfd import available
from accerl_lerobot.weights.publisher import FLUSH_S, Publisher
from accerl_lerobot.weights.ray_channel import RayPublisher, answered
from accerl_lerobot.weights.shared_memory import SharedMemoryPublisher

CONNECT_S = 60.0
"""How long readers may take to say whether they can map the trainer's memory."""


class Publishers:
    """Several, as one: some readers are on this machine, and some on others. Each copies a set for itself.

    Args:
        parts: of which each has its own readers.
    """

    def __init__(self, *parts: Publisher) -> None:
        self.parts = parts

    def publish(self, version: int, tensors: Mapping[str, Any]) -> None:
        """See `Publisher.publish`."""
        for part in self.parts:
            part.publish(version, tensors)

    def flush(self, timeout_s: float = FLUSH_S) -> None:
        """See `Publisher.flush`."""
        deadline = time.monotonic() + timeout_s
        for part in self.parts:
            part.flush(max(0.0, deadline - time.monotonic()))

    def close(self) -> None:
        """See `Publisher.close`."""
        for part in self.parts:
            part.close()


def make_publisher(
    readers: Sequence[Any],
    transport: str = "auto",
) -> Publisher | Publishers:
    """The trainer's end of the transport that is asked for, with its readers connected.

    Args:
        readers: actor handles with ``receive_weights(version, tensors, published_s)`` and
            ``open_weights(address)``, as `InferenceWorker` has them.
        transport: shared_memory, ray, or auto: the former for readers that can reach it, that is run on this
            machine, and the latter for the others.

    Raises:
        InputError: shared memory is asked for and not to be had.
        ray.exceptions.RayError: a reader has died.
    """
    if transport not in get_args(Transport):
        raise InputError(FIELD, transport, f"use one of {', '.join(get_args(Transport))}")
    if transport != "ray" and available():
        publisher = SharedMemoryPublisher(len(readers))
        try:
            answers = [reader.open_weights.remote(publisher.address) for reader in readers]
            near = [answered(answer, "open_weights", CONNECT_S) for answer in answers]
            if all(near):
                return publisher
            if any(near) and transport == "auto":
                publisher.expect(sum(near))
                far = [reader for reader, here in zip(readers, near, strict=True) if not here]
                return Publishers(publisher, RayPublisher(far))
        except BaseException:
            publisher.close()
            raise
        publisher.close()
    if transport == "shared_memory":
        raise InputError(FIELD, transport, "it needs Linux and all workers on one machine; use ray")
    return RayPublisher(readers)


def join(publisher: Publisher | Publishers, reader: Any) -> None:
    """Has another reader receive what is published, from the newest set on.

    Args:
        publisher: of `make_publisher`.
        reader: actor handle, see there.

    Raises:
        InputError: the trainer's memory is what is shared, and it cannot be reached from there.
        ray.exceptions.RayError: the reader has died.
    """
    for part in publisher.parts if isinstance(publisher, Publishers) else (publisher,):
        if not isinstance(part, SharedMemoryPublisher):
            part.add(reader)
            return
        if answered(reader.open_weights.remote(part.address), "open_weights", CONNECT_S):
            return
    raise InputError(FIELD, "shared_memory", "a worker that was started anew is elsewhere; use ray")
