# SPDX-License-Identifier: Apache-2.0
"""Stand-ins for the few Ray calls that a worker makes, so that its loop runs in a test's own process."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from typing import Any


class Local:
    """Replaces the module `ray` in a worker's file; references are futures."""

    @staticmethod
    def get(reference: Future[Any], timeout: float | None = None) -> Any:
        return reference.result(timeout=30 if timeout is None else timeout)

    @staticmethod
    def put(value: Any) -> Any:
        return value

    @staticmethod
    def wait(
        references: Sequence[Future[Any]], num_returns: int = 1, timeout: float | None = None
    ) -> tuple[list[Future[Any]], list[Future[Any]]]:
        if timeout != 0:
            wait(references, timeout=timeout, return_when=FIRST_COMPLETED)
        done = [r for r in references if r.done()][:num_returns]
        return done, [r for r in references if r not in done]


class Remote:
    """``handle.method.remote(...)`` for one function."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def remote(self, *arguments: Any) -> Future[Any]:
        """The function's answer; a `Future` that it returns is the reference itself."""
        try:
            answer = self._function(*arguments)
        except Exception as error:
            future: Future[Any] = Future()
            future.set_exception(error)
            return future
        return answer if isinstance(answer, Future) else done(answer)


class Handle:
    """An actor handle made of functions.

    Example:
        >>> Handle(insert=lambda segments: True).insert.remote([]).result()
        True
    """

    def __init__(self, **methods: Callable[..., Any]) -> None:
        for name, function in methods.items():
            setattr(self, name, Remote(function))


def done(value: Any) -> Future[Any]:
    """A call that has returned."""
    future: Future[Any] = Future()
    future.set_result(value)
    return future
