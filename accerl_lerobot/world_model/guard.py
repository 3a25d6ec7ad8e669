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
"""When not to believe in dreams.

A dream begins in a real episode, and for most of them it is known whether that achieved the task in as many
decisions as the dream has. So the two shares are of the same starts, and differ by what the policy has learnt
since, and by what the world model makes up.
"""

from __future__ import annotations

from collections import deque


class KillSwitch:
    """Says when dreams succeed too much more often than reality.

    Args:
        gap: largest difference of the two shares of successes.
        window: dreams over which they are taken; before there are so many, nothing is said.
    """

    def __init__(self, gap: float, window: int) -> None:
        self.gap = gap
        self._seen: deque[tuple[bool, bool]] = deque()
        self._window = window
        # Kept as numbers: they are also read on another thread.
        self._imagined = self._real = self._count = 0
        self.tripped = False

    def add(self, imagined: bool, real: bool | None) -> None:
        """Takes note of a dream that has ended, and of what had happened; None is not counted."""
        if real is None:
            return
        self._take(imagined, real, 1)
        self._seen.append((imagined, real))
        if self._count > self._window:
            self._take(*self._seen.popleft(), -1)
        dreamt, happened = self.shares
        if self._count == self._window and dreamt - happened > self.gap:
            self.tripped = True

    def reset(self) -> None:
        """Another world model dreams from now on."""
        self._seen.clear()
        self._imagined = self._real = self._count = 0
        self.tripped = False

    def _take(self, imagined: bool, real: bool, sign: int) -> None:
        self._imagined, self._real = self._imagined + sign * imagined, self._real + sign * real
        self._count += sign

    @property
    def shares(self) -> tuple[float, float]:
        """Of successes, imagined and real; NaN before anything was seen."""
        count = self._count
        return (self._imagined / count, self._real / count) if count else (float("nan"), float("nan"))
