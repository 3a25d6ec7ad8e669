# SPDX-License-Identifier: Apache-2.0
"""Follows the timeline of a run that is going on, for its metrics."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from accerl_lerobot.errors import InputError
from accerl_lerobot.timeline.parts import part_paths, read_entries, read_head
from accerl_lerobot.timeline.read import divided
from accerl_lerobot.timeline.states import bubble, role_of


@dataclass
class _Place:
    """How far a section has been read."""

    path: Path
    """Path of its newest part."""
    byte: int
    at_ns: int
    state: int
    totals: np.ndarray
    role: str


class Watch:
    """Tells how the time of each role has divided since it was last asked.

    Args:
        folder: of the timeline; need not be there.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._places: dict[tuple[str, int], _Place] = {}
        self.news()

    def news(self) -> dict[str, float]:
        """``timeline_<role>_<state>_share`` and ``timeline_<role>_bubble`` since the last call."""
        spent: dict[str, np.ndarray] = {}
        for section, paths in part_paths(self._folder).items():
            before = self._places.get(section)
            # Its worker has begun another part meanwhile; or it is damaged, which must not end a run.
            with contextlib.suppress(FileNotFoundError, InputError):
                if (place := _read_on(paths[-1], before)) is not None:
                    self._places[section] = place
                    new = place.totals if before is None else place.totals - before.totals
                    spent[place.role] = spent.get(place.role, 0) + new
        found: dict[str, float] = {}
        for role, own in spent.items():
            if own.sum() > 0:
                parts, name = divided(own), f"timeline_{role.replace(' ', '_')}"
                found |= {f"{name}_{state}_share": share for state, share in parts.items()}
                found[f"{name}_bubble"] = bubble(parts)
        return found


def _read_on(path: Path, before: _Place | None) -> _Place | None:
    """Reads what is new in a section's newest part; a new part's first line has what went before it."""
    if before is not None and before.path == path:
        byte, at, state, totals, role = before.byte, before.at_ns, before.state, before.totals, before.role
    else:
        head, byte = read_head(path)
        if head is None:
            return None
        at, state, totals, role = head.at_ns, head.state, head.totals_ns, role_of(head.worker)
    times, states, byte = read_entries(path, byte, at)
    if len(times):
        totals = totals.copy()
        np.add.at(totals, np.append(np.uint8(state), states[:-1]), np.diff(times, prepend=at))
        at, state = int(times[-1]), int(states[-1])
    return _Place(path, byte, at, state, totals, role)
