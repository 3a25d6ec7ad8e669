# SPDX-License-Identifier: Apache-2.0
"""``accerl report``: one HTML file about a run of ``accerl train``, or about several, with all that it needs.

The template escapes all text, and a content security policy forbids the browser every script and request, so
text of a run that got past the escaping could do nothing. Free of torch.
"""

from __future__ import annotations

import base64
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar
from urllib.parse import quote

from accerl_lerobot import __version__
from accerl_lerobot.checkpoint.layout import CONFIG, SUMMARY
from accerl_lerobot.config.ranges import Section
from accerl_lerobot.errors import InputError, check_output, expanded, reading
from accerl_lerobot.metrics import METRICS

NAME = "report.html"
VIDEO_MB = 20


@dataclass(frozen=True, kw_only=True)
class ReportConfig(Section):
    """Fields of ``accerl report``."""

    BARE: ClassVar[str] = "runs"

    runs: tuple[str, ...] = ()
    """Folders of runs of ``accerl train`` or ``accerl offline``; several make a page that compares them. Bare
    ones are runs."""
    output: str | None = None
    """The page. None: ``report.html`` in the run's folder, or here if there are several."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.runs:
            raise InputError("runs", "", "name the folder of a run: accerl report RUN")


def write_report(config: ReportConfig) -> Path:
    """Reads the runs and writes the page."""
    from accerl_lerobot.report.content import comparison, one_run
    from accerl_lerobot.report.read import read_run

    output = None if config.output is None else expanded(config.output, "output")
    runs = [read_run(expanded(name, "runs")) for name in config.runs]
    if len({run.path.resolve() for run in runs}) < len(runs):
        raise InputError("runs", ",".join(config.runs), "name each run once")
    if output is None:
        output = runs[0].path / NAME if len(runs) == 1 else Path(NAME)
    check_output(output)
    now = time.time()
    with reading("runs", ",".join(config.runs), f"{CONFIG}, {METRICS} or {SUMMARY}"):
        folder = output.resolve().parent
        if len(runs) == 1:
            html = _html("run.html", one_run(runs[0], now), folder)
        else:
            html = _html("comparison.html", comparison(runs, now), folder)
    try:
        output.write_text(html, encoding="utf-8")
    except OSError as error:
        raise InputError("output", str(output), f"cannot be written: {error.strerror}") from error
    return output


def _html(name: str, values: dict[str, Any], folder: Path) -> str:
    """A template filled in, as a page in this folder."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    from accerl_lerobot.console import percent
    from accerl_lerobot.report.charts import POINTS
    from accerl_lerobot.report.content import STATE_COLOURS

    environment = Environment(
        loader=PackageLoader("accerl_lerobot", "report"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {
        "percent": percent,
        "base64": lambda path: base64.b64encode(path.read_bytes()).decode(),
        "address": lambda path: quote(os.path.relpath(path.resolve(), folder)),
    }
    fixed = {"version": __version__, "points": POINTS, "colours": STATE_COLOURS, "video_mb": VIDEO_MB}
    return environment.get_template(name).render(**values, **fixed)
