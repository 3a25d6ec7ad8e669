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
"""Follows the timeline of a run that is going on, for its metrics."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np

from accerl_lerobot.timeline.parts import part_paths, read_entries, read_head
from accerl_lerobot.timeline.read import divided
from accerl_lerobot.timeline.states import STATES, bubble, role_of


class Watch:
    """Follows a timeline while it is written.

    Args:
        folder: of the timeline; need not be there.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._read: dict[Path, tuple[int, int, int, str]] = {}
        """Of each part, bytes read, the last entry's time and state, role."""
        self.news()

    def news(self) -> dict[str, float]:
        """``timeline_<role>_<state>_share`` and ``timeline_<role>_bubble`` since the last call."""
        spent: dict[str, np.ndarray] = {}
        for path in [path for paths in part_paths(self._folder).values() for path in paths]:
            with contextlib.suppress(FileNotFoundError):  # its worker has begun another meanwhile
                self._follow(path, spent)
        found: dict[str, float] = {}
        for role, own in spent.items():
            if own.sum() > 0:
                parts, name = divided(own), f"timeline_{role.replace(' ', '_')}"
                found |= {f"{name}_{state}_share": share for state, share in parts.items()}
                found[f"{name}_bubble"] = bubble(parts)
        return found

    def _follow(self, path: Path, spent: dict[str, np.ndarray]) -> None:
        if path not in self._read:
            head, start = read_head(path)
            if head is None:
                return
            self._read[path] = (start, head.at_ns, head.state, role_of(head.worker))
        start, last, state, role = self._read[path]
        times, states, start = read_entries(path, start, last)
        if len(times):
            own = spent.setdefault(role, np.zeros(len(STATES), np.int64))
            np.add.at(own, np.append(np.uint8(state), states[:-1]), np.diff(times, prepend=last))
            self._read[path] = (start, int(times[-1]), int(states[-1]), role)
