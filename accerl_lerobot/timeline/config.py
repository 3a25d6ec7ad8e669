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
"""What ``accerl timeline`` is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from accerl_lerobot.errors import InputError


@dataclass(frozen=True, kw_only=True)
class TimelineConfig:
    """Runs, and which part of them is drawn.

    Example:
        >>> TimelineConfig(runs=("outputs/synchronous", "outputs/asynchronous"), seconds=5.0)
    """

    BARE: ClassVar[str] = "runs"

    runs: tuple[str, ...] = ()
    """Folders of runs of ``accerl train``; the pictures of several stand above each other, the first on top.
    Bare arguments are runs."""
    start_s: float | None = None
    """First second that is drawn, since the first worker began; 0 or more. None: such that the window is in
    the middle of the training."""
    seconds: float | None = None
    """How much is drawn, above 0. None: about sixteen updates of the slowest run, 2 to 60 seconds."""
    trace_seconds: float = 60.0
    """How much of each run ``timeline.json`` has, around the middle of what is drawn; above 0."""
    output: str | None = None
    """The picture. None: ``timeline.png`` in the run's folder, or here if there are several. An older picture
    of accerl is replaced; any other file is left alone."""

    def __post_init__(self) -> None:
        if not self.runs:
            raise InputError("runs", "", "name the folder of a run: accerl timeline RUN")
        if self.start_s is not None and not self.start_s >= 0:
            raise InputError("start_s", self.start_s, "use 0 or more seconds")
        for name in ("seconds", "trace_seconds"):
            value = getattr(self, name)
            if value is not None and not 0 < value < float("inf"):
                raise InputError(name, value, "use a positive number of seconds")
