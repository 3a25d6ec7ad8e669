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
"""What ``accerl report`` is asked for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from accerl_lerobot.errors import InputError


@dataclass(frozen=True, kw_only=True)
class ReportConfig:
    """Runs, and the page about them.

    Example:
        >>> ReportConfig(runs=("outputs/a", "outputs/b"), output="both.html")
    """

    BARE: ClassVar[str] = "runs"

    runs: tuple[str, ...] = ()
    """Folders of runs, of one kind; several make one page that compares them. Bare arguments are runs."""
    output: str | None = None
    """The page. None: ``report.html`` in the run's folder, or here if there are several. An older page of
    accerl is replaced; any other file is left alone."""
    video_mb: float = 20.0
    """Videos up to so many megabytes each are put into the page, larger ones are linked; 0 or more."""

    def __post_init__(self) -> None:
        if not self.runs:
            raise InputError("runs", "", "name the folder of a run: accerl report RUN")
        if not self.video_mb >= 0:
            raise InputError("video_mb", self.video_mb, "use 0 (link every video) or more megabytes")
