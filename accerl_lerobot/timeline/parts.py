# SPDX-License-Identifier: Apache-2.0
"""The timeline on disk: one section for each process, in parts, of which the newest two are kept.

``RUN/timeline/rollout-0.1.3.bin`` is part 3 of section 1, the second process, of ``rollout 0``: a line of
JSON, then 8 bytes per entry, nanoseconds since the section began << 4 | state, little-endian. A part's first
line has the totals up to it, so those are exact although older parts are gone: a worker keeps its newest
`PART_BYTES` / 8 entries at least, and twice as many at most. Nothing is ever written over; a process that was
killed leaves at worst half an entry, which is not read.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from array import array
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from accerl_lerobot.errors import InputError
from accerl_lerobot.fault_points import fault_point
from accerl_lerobot.timeline.states import RECOVERY, STATES, role_of

FORMAT = 1
BITS = 4
"""Bits of an entry that hold the state."""
PART_BYTES = 4_000_000
SUFFIX = ".bin"
BOOT = Path("/proc/sys/kernel/random/boot_id")
"""Tells one machine's monotonic clock from another's, and from its own before a restart; without such a
file all are taken for one."""


class Moment(NamedTuple):
    """A moment by two clocks."""

    node: str
    """Whose monotonic clock it is."""
    clock_ns: int
    """By that."""
    wall_ns: int
    """By the calendar, in nanoseconds since 1970."""


def this_moment() -> Moment:
    """Now, here."""
    node = BOOT.read_text().strip() if BOOT.is_file() else ""
    return Moment(node, time.monotonic_ns(), time.time_ns())


class Parts:
    """Where one process writes.

    Args:
        folder: of the timeline.
        worker: its name.
        begins: when the section does; None: now.
        part_bytes: after which another part begins.
    """

    def __init__(
        self, folder: Path, worker: str, begins: Moment | None = None, part_bytes: int = PART_BYTES
    ) -> None:
        begins = begins or this_moment()
        self.clock_ns = begins.clock_ns
        self._folder, self._part_bytes = folder, part_bytes
        self._head = {"timeline": FORMAT, "worker": worker, "pid": os.getpid(), **begins._asdict()}
        self._slug = worker.replace(" ", "-")
        self._point = f"{role_of(worker).split()[-1]}.timeline"
        self._part = 0
        folder.mkdir(parents=True, exist_ok=True)
        before = [
            section for slug, section, _ in map(_numbers, folder.glob(f"*{SUFFIX}")) if slug == self._slug
        ]
        self._section = max(before, default=-1) + 1
        self._begin(0, RECOVERY, [0] * len(STATES))

    def write(self, entries: array[int], at_ns: int, state: int, totals: Sequence[int]) -> None:
        """Appends; it is on its way to the disk, whatever becomes of this process, when this returns.

        Args:
            entries: see above.
            at_ns: time of the last one, since the section began.
            state: that it has entered.
            totals: nanoseconds in each state up to then.
        """
        fault_point(self._point)
        if sys.byteorder == "big":
            entries.byteswap()
        self._file.write(entries.tobytes())
        self._file.flush()
        if self._file.tell() >= self._part_bytes:
            self._file.close()
            self._part += 1
            self._begin(at_ns, state, totals)
            self._path(self._part - 2).unlink(missing_ok=True)

    @property
    def closed(self) -> bool:
        """True if `close` was called."""
        return self._file.closed

    def close(self) -> None:
        """Closes the file."""
        self._file.close()

    def _begin(self, at_ns: int, state: int, totals: Sequence[int]) -> None:
        head = {**self._head, "at_ns": at_ns, "state": STATES[state]}
        head["totals_ns"] = dict(zip(STATES, totals, strict=True))
        self._file = self._path(self._part).open("xb")
        self._file.write((json.dumps(head) + "\n").encode())
        self._file.flush()

    def _path(self, part: int) -> Path:
        return self._folder / f"{self._slug}.{self._section}.{part}{SUFFIX}"


@dataclass(frozen=True, kw_only=True)
class Head:
    """First line of a part."""

    worker: str
    begins: Moment
    """When the section did."""
    at_ns: int
    """When the part begins, since the section did."""
    state: int
    """In which it begins."""
    totals_ns: np.ndarray
    """int64, in each state up to then."""


@dataclass(frozen=True, kw_only=True)
class Section:
    """Kept part of one process; the intervals between `times` are spent in `states`."""

    head: Head
    """Head of the oldest part that is kept."""
    times: np.ndarray
    """int64 (n + 1,), nanoseconds since the section began."""
    states: np.ndarray
    """uint8 (n,)."""


def part_paths(folder: Path) -> dict[tuple[str, int], list[Path]]:
    """Parts that there are, in order, by worker and number of the section."""
    found: dict[tuple[str, int], list[Path]] = {}
    for path in sorted(folder.glob(f"*{SUFFIX}"), key=_numbers):
        found.setdefault(_numbers(path)[:2], []).append(path)
    return found


def read_sections(folder: Path) -> list[Section]:
    """All that is kept, in no order.

    Raises:
        InputError: a file is damaged, but for an end that is torn.
    """
    sections = []
    for paths in part_paths(folder).values():
        parts = []
        for path in paths:
            with contextlib.suppress(FileNotFoundError):  # its worker has begun another meanwhile
                head, start = read_head(path)
                if head is not None:
                    parts.append((head, *read_entries(path, start, head.at_ns)[:2]))
        if parts:
            head = parts[0][0]
            times = np.concatenate([[head.at_ns], *(times for _, times, _ in parts)])
            states = np.concatenate([[head.state], *(states for *_, states in parts)])
            sections.append(Section(head=head, times=times, states=states[:-1].astype(np.uint8)))
    return sections


def read_head(path: Path) -> tuple[Head | None, int]:
    """A part's first line and its length; None if it is torn.

    Raises:
        InputError: it is damaged.
    """
    with path.open("rb") as file:
        line = file.readline()
    if not line.endswith(b"\n"):
        return None, 0
    try:
        told = json.loads(line)
        if told["timeline"] != FORMAT:
            raise ValueError(f"format {told['timeline']}, not {FORMAT}")
        totals = [int(told["totals_ns"].get(name, 0)) for name in STATES]
        head = Head(
            worker=str(told["worker"]),
            begins=Moment(str(told["node"]), int(told["clock_ns"]), int(told["wall_ns"])),
            at_ns=int(told["at_ns"]),
            state=STATES.index(told["state"]),
            totals_ns=np.array(totals, dtype=np.int64),
        )
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise _damaged(path, " ".join(str(error).split())[:80]) from error
    return head, len(line)


def read_entries(path: Path, start: int, after_ns: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Whole entries from a byte on.

    Args:
        path: of the part.
        start: byte.
        after_ns: time of the entry before.

    Returns:
        Times, states, and the byte to go on from.

    Raises:
        InputError: they are no entries.
    """
    with path.open("rb") as file:
        file.seek(start)
        data = file.read()
    whole = len(data) // 8 * 8
    entries = np.frombuffer(data[:whole], "<u8")
    times, states = (entries >> np.uint64(BITS)).astype(np.int64), (entries % 2**BITS).astype(np.uint8)
    if (np.diff(times, prepend=after_ns) < 0).any():
        raise _damaged(path, "time goes back")
    if (states >= len(STATES)).any():
        raise _damaged(path, "no such state")
    return times, states, start + whole


def _numbers(path: Path) -> tuple[str, int, int]:
    """Worker, section and part."""
    try:
        slug, section, part = path.name.removesuffix(SUFFIX).rsplit(".", 2)
        return slug, int(section), int(part)
    except ValueError as error:
        raise _damaged(path, "no part of a timeline is called so") from error


def _damaged(path: Path, why: str) -> InputError:
    return InputError("runs", str(path), f"damaged ({why}); restore it, or remove it")
