# SPDX-License-Identifier: Apache-2.0
"""Fields of ``accerl timeline``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from accerl_lerobot.config.ranges import NonNegative, Positive, Section
from accerl_lerobot.errors import InputError


@dataclass(frozen=True, kw_only=True)
class TimelineConfig(Section):
    """Runs, and which part of them is drawn.

    Example:
        >>> TimelineConfig(runs=("outputs/synchronous", "outputs/asynchronous"), seconds=5.0)
    """

    BARE: ClassVar[str] = "runs"

    runs: tuple[str, ...] = ()
    """Folders of runs of ``accerl train``; the pictures of several stand above each other, the first on top.
    Bare arguments are runs."""
    start_s: NonNegative | None = None
    """First second that is drawn, since the first worker began. None: such that the window is in
    the middle of the training."""
    seconds: Positive | None = None
    """How much is drawn. None: about sixteen updates of the slowest run, 2 to 60 seconds."""
    trace_seconds: Positive = 60.0
    """How much of each run ``timeline.json`` has, around the middle of what is drawn."""
    output: str | None = None
    """The picture. None: ``timeline.png`` in the run's folder, or here if there are several. An older picture
    of accerl is replaced; any other file is left alone."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.runs:
            raise InputError("runs", "", "name the folder of a run: accerl timeline RUN")
