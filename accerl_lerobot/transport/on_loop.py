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
