# SPDX-License-Identifier: Apache-2.0
"""Fields of ``accerl report``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from accerl_lerobot.config.ranges import NonNegative, Section
from accerl_lerobot.errors import InputError


@dataclass(frozen=True, kw_only=True)
class ReportConfig(Section):
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
    video_mb: NonNegative = 20.0
    """Videos up to so many megabytes each are put into the page, larger ones are linked."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.runs:
            raise InputError("runs", "", "name the folder of a run: accerl report RUN")
