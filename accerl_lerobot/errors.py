# SPDX-License-Identifier: Apache-2.0
"""Messages to people: bad input and other errors, each on one line, and those of other processes.

People do not look into the files of workers and child processes. So such a process keeps its warnings
(`collect_warnings`) and hands them over with its answers (`collected_warnings`), and the run's process shows
each of them once (`show_warnings`). The exception that ends a child is handed over as JSON (`error_as_json`).
"""

from __future__ import annotations

import contextlib
import functools
import logging
import math
import os
import re
import traceback
import unicodedata
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

logger = logging.getLogger(__name__)

ERROR_LOG = "error.log"  # file of a run's folder with the tracebacks of unexpected errors
TOKEN = re.compile(r"\bhf_\w{6,}")  # of the Hub, which somebody may have typed where it does not belong
BAR = re.compile(r"[^\r\n]*?\d%\|[^\]\r\n]*\]|\r")  # of progress, which no line end follows
LONGEST, MOST_SHOWN = 200, 600
"""Characters that are shown of a value, and of an unexpected error."""

MAX_NONFINITE = 5  # steps in a row with a non-finite loss or gradient that are an error; fewer are skipped


class NonFiniteError(RuntimeError):
    """Too many steps in a row had a non-finite loss or gradient."""


def step_if_finite(optimizer: Any, step: str, loss: float, norm: float, in_a_row: int, hint: str) -> int:
    """Makes a step unless its loss or its gradient's norm is not finite; returns the steps in a row left out.

    `step` names the step in the error, and `in_a_row` are the steps that were left out before it.

    Raises:
        NonFiniteError: `MAX_NONFINITE` steps in a row are left out.
    """
    if math.isfinite(loss + norm):
        optimizer.step()
        return 0
    in_a_row += 1
    if in_a_row >= MAX_NONFINITE:
        raise NonFiniteError(
            f"{in_a_row} steps in a row had a non-finite loss or gradient (the last one, {step}: "
            f"loss {loss:g}, gradient norm {norm:g}); {hint}"
        )
    return in_a_row


class InputError(ValueError):
    """Bad input, refused before any long work: a field as it is written on the command line, and a sentence.

    Example:
        >>> raise InputError("env.task", "push-v2", "use one of: push-v3, reach-v3")
        Traceback (most recent call last):
        accerl_lerobot.errors.InputError: env.task='push-v2': use one of: push-v3, reach-v3
    """

    def __init__(self, field: str, value: object, hint: str) -> None:
        self.field = field
        self.value = value
        self.hint = hint
        super().__init__(field, value, hint)

    def __str__(self) -> str:
        value = shortened(repr(self.value), LONGEST)
        text = f"{self.field}={value}: {self.hint}"
        line = " ".join(text.split())
        return TOKEN.sub("<token>", printable(line))


def shortened(text: str, length: int = 80) -> str:
    """A text cut off after so many characters."""
    return text if len(text) <= length else f"{text[: length - 1]}…"


def printable(text: str, keep: str = "") -> str:
    """Text whose control characters, bidirectional ones included, are escaped, except those in `keep`.

    Messages quote files and servers, and a terminal obeys control characters.
    """
    if text.isprintable():
        return text
    characters = []
    for character in text:
        space = unicodedata.category(character) == "Zs"  # of which only the usual one is printable
        shown = space or character.isprintable() or character in keep
        characters.append(character if shown else repr(character)[1:-1])
    return "".join(characters)


def check_absent(path: Path, field: str = "output_dir") -> None:
    """Refuses a folder for results that exists, or that cannot be created."""
    if os.path.lexists(path):
        raise InputError(field, str(path), "the folder exists; choose another or remove it")
    above = next(folder for folder in path.absolute().parents if folder.exists())
    if not os.access(above, os.W_OK | os.X_OK):
        raise InputError(field, str(path), f"{above} cannot be written to; name another folder")


def causes(error: BaseException | None) -> Iterator[BaseException]:
    """An error and what it came from, newest first."""
    known: list[BaseException] = []
    while error is not None and error not in known:
        known.append(error)
        yield error
        error = error.__cause__ or error.__context__


def input_error(error: BaseException) -> InputError | None:
    """The `InputError` that another error wraps, if there is one."""
    return next((link for link in causes(error) if isinstance(link, InputError)), None)


def expanded(path: str, field: str) -> Path:
    """A path in which ``~`` stands for a home folder."""
    try:
        found = Path(path).expanduser()
        os.fspath(found).encode()
        os.lstat(found)
    except FileNotFoundError:
        pass
    except (OSError, RuntimeError, ValueError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise InputError(field, path, f"cannot be a path: {why}") from error
    return found


@functools.cache
def warn_once(text: str, name: str = __name__) -> None:
    """Warns by the logger of this name, unless this process has warned so before."""
    logging.getLogger(name).warning("%s", text)


@contextmanager
def for_viewing(what: str) -> Iterator[None]:
    """Turns an error into one warning where the result, such as a film, is only for people to look at."""
    try:
        yield
    except Exception as error:
        logger.debug("no %s", what, exc_info=error)
        warn_once(f"there is no {what} ({one_line(error)})")


@contextmanager
def kept_traceback(directory: Path) -> Iterator[None]:
    """Appends the traceback of an unexpected error to `ERROR_LOG` in a run's folder, and notes that."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        log = directory / ERROR_LOG
        with contextlib.suppress(OSError):  # the disk may be full
            with log.open("a") as file:
                traceback.print_exception(error, file=file)
            error.add_note(f"the traceback is in {log}")
        raise


def last_exception(text: str) -> str:
    """The exception at the end of a traceback, on one line; of any other text its last line."""
    lines = [line for line in BAR.sub("", text).splitlines() if line.strip()]
    inside = [number for number, line in enumerate(lines) if line.startswith(("  ", "Traceback"))]
    end = lines[inside[-1] + 1 :] if inside else []
    words = " ".join(end or lines[-1:])
    return " ".join(words.split())


def in_one_line(error: BaseException, length: int = 300) -> str:
    """Type and text of an error in one line of so many characters at most.

    Of a text of several lines it has the first one, and the exception at its end.
    """
    cause = getattr(error, "cause", error)  # Ray's errors carry a traceback as their text
    if not isinstance(cause, BaseException):
        cause = error
    name = type(cause).__name__
    text = str(cause)
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if not lines:
        return name
    words = f"{name}: {lines[0]}"
    if len(lines) > 1:
        words += f" … {last_exception(text)}"
    return shortened(words, length)


def one_line(error: BaseException) -> str:
    """An unexpected error in one line, with its traceback's place or how to see it."""
    text = in_one_line(error, MOST_SHOWN)
    notes = getattr(error, "__notes__", ()) or ("ACCERL_LOG=DEBUG shows the traceback",)
    words = "; ".join([TOKEN.sub("<token>", text), *notes])
    line = " ".join(words.split())
    return printable(line)


PACKAGE = "accerl_lerobot"
LONGEST_HANDED = 1000  # characters of a message of another process


class Once(logging.Filter):
    """Passes each distinct warning of this package once, whatever process or place it comes from."""

    def __init__(self) -> None:
        super().__init__(PACKAGE)
        self._passed: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        if record.levelno != logging.WARNING or not super().filter(record):
            return True
        text = record.getMessage()
        known = text in self._passed
        self._passed.add(text)
        return not known


class _Collector(logging.Handler):
    """Keeps the warnings of this package until they are handed over."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.addFilter(Once())
        self.new: deque[tuple[str, str]] = deque()  # texts, and names of their loggers

    def emit(self, record: logging.LogRecord) -> None:
        self.new.append((record.getMessage()[:LONGEST_HANDED], record.name))


_collector = _Collector()


def collect_warnings() -> None:
    """Keep the warnings of this process from now on."""
    _collector.new.clear()  # of the parent, where this process was forked
    logging.getLogger(PACKAGE).addHandler(_collector)


def collected_warnings(worker: object = None) -> list[tuple[str, str]]:
    """Warnings of this process since the last call; `worker` is not used, Ray hands it over."""
    return [_collector.new.popleft() for _ in range(len(_collector.new))]


def show_warnings(warnings: Iterable[Any]) -> None:
    """Log warnings of other processes, each once."""
    for text, name in warnings:
        warn_once(text, name)


def error_as_json(error: BaseException) -> dict[str, Any]:
    """An exception as plain values: the `InputError` in its chain, or its type and text in one line."""
    refused = input_error(error)
    if refused is None:
        return {"error": in_one_line(error, LONGEST_HANDED)}
    return {"refused": [refused.field, refused.value, refused.hint]}


def raise_refusal(answer: dict[str, Any]) -> None:
    """Raise the `InputError` that `error_as_json` has described, if it was one."""
    if "refused" in answer:
        raise InputError(*answer["refused"])
