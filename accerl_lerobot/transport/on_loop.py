# SPDX-License-Identifier: Apache-2.0
"""Shared memory for a service that lives on an event loop: its coroutine answers, no thread is needed."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

from accerl_lerobot.transport.contract import Asked
from accerl_lerobot.transport.shared_memory import SharedMemoryServer


def serve_on_loop(answer: Callable[[Any], Awaitable[Any]]) -> SharedMemoryServer:
    """Has a coroutine function answer messages from now on, each in a task; called on the loop.

    Messages own their arrays. What a caller has sent before it died is dealt with as if it lived.
    """
    tasks: set[asyncio.Task[None]] = set()

    async def deal_with(asked: Asked) -> None:
        try:
            asked.answer(await answer(asked.message))
        except Exception as error:
            asked.fail(error)

    def take(asked: Asked) -> None:
        task = asyncio.ensure_future(deal_with(asked))
        tasks.add(task)  # the loop itself refers to tasks weakly
        task.add_done_callback(tasks.discard)

    server = SharedMemoryServer(take, copy=True)
    asyncio.get_running_loop().add_reader(server.fileno(), server.poll, 0.0)
    return server
