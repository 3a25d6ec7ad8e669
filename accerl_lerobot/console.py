# SPDX-License-Identifier: Apache-2.0
"""Progress for people, a bar per stage on a terminal and plain lines elsewhere; and numbers as text."""

from __future__ import annotations

import datetime
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console as RichConsole
from rich.progress import BarColumn, Progress, Task, TextColumn, TimeElapsedColumn
from rich.text import Text

from accerl_lerobot.errors import printable

PLAIN_EVERY_S = 15.0  # seconds between two lines of one stage when the output is not a terminal


class Stage:
    """One stage's bar."""

    def __init__(self, console: RichConsole, progress: Progress, task: Task) -> None:
        self._console = console
        self._progress = progress
        self._task = task
        self._said = time.monotonic()

    def update(self, done: int, status: str = "") -> None:
        """Move the bar, and show `status` beside it."""
        self._progress.update(self._task.id, completed=done)
        total = self._task.total
        parts = [f"{done}/{total:.0f} ({done / total:.0%})" if total else str(done)]
        seconds = self._task.time_remaining
        if seconds:
            left = datetime.timedelta(seconds=round(seconds))
            parts.append(f"{left} left")
        if status:
            parts.append(status)
        text = " · ".join(parts)
        self._progress.update(self._task.id, text=text)
        now = time.monotonic()
        if not self._console.is_terminal and now - self._said > PLAIN_EVERY_S:
            self._said = now
            self._console.print(f"  {self._task.description} {text}", highlight=False, soft_wrap=True)


class _Terminal(RichConsole):
    """Rich's console, which shows text without its control characters."""

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(printable(text, keep="\n"), **options)


class Console:
    """Where stages and results are announced."""

    def __init__(self) -> None:
        self.rich = _Terminal(stderr=True)
        self._started = time.monotonic()

    def say(self, text: str) -> None:
        """One line, with the seconds since the start."""
        seconds = time.monotonic() - self._started
        line = f"[{seconds:6.1f} s] {text}"
        # Not wrapped: commands and paths in it are there to be copied.
        self.rich.print(line, highlight=False, markup=False, soft_wrap=True)

    @contextmanager
    def stage(self, name: str, total: int | None = None) -> Iterator[Stage]:
        """Announces a stage, shows its bar, and says how long it took."""
        self.say(f"{name} …")
        started = time.monotonic()
        columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[text]}"))
        with Progress(
            *columns, TimeElapsedColumn(), console=self.rich, transient=True,
            disable=not self.rich.is_terminal, speed_estimate_period=600,
        ) as progress:  # fmt: skip
            progress.add_task(name, total=total, text="")
            yield Stage(self.rich, progress, progress.tasks[0])
        self.say(f"{name}: {time.monotonic() - started:.1f} s")


ABSENT = "–"
UNBROKEN = "\N{NO-BREAK SPACE}"


def number(value: float | None, digits: int = 4) -> str:
    """At most so many significant digits, thousands apart; a dash where there is none.

    Example:
        >>> number(136266.0), number(0.0512345), number(None)
        ('136,266', '0.05123', '–')
    """
    if value is None or not math.isfinite(value):
        return ABSENT
    if value == int(value) or abs(value) >= 10**digits:
        return f"{value:,.0f}"
    return f"{value:.{digits}g}"


def percent(share: float | None) -> str:
    """A share as ``98 %``, with a decimal where it has one; no line breaks before the sign."""
    if share is None or not math.isfinite(share):
        return ABSENT
    return f"{100 * share:.3g}{UNBROKEN}%"


def rate(success: float | None, interval: Sequence[float] | None) -> str:
    """``46 % [37, 56]``; a dash where there is none."""
    if success is None or interval is None:
        return ABSENT
    low, high = (f"{100 * end:.0f}" for end in interval)
    return f"{percent(success)} [{low}, {high}]"


def duration(seconds: float | None) -> str:
    """``3.2 s``, ``9 min 53 s`` or ``2 h 05 min``."""
    if seconds is None or not math.isfinite(seconds):
        return ABSENT
    if seconds < 60:
        return f"{seconds:.3g} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02} s"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02} min"


def count(n: int, thing: str) -> str:
    """``1 run``, ``2 runs``."""
    return f"{n:,} {thing}{'' if n == 1 else 's'}"
