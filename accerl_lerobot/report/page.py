# SPDX-License-Identifier: Apache-2.0
"""Writes a page: one HTML file with its style, its script and its videos inside, which loads nothing.

The browser is told so too: a content security policy forbids every request and every script but the page's
own, which it knows by its hash. So even text that got past the template's escaping could not run.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import os
import time
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined

from accerl_lerobot import __version__
from accerl_lerobot.errors import InputError, expanded
from accerl_lerobot.report.blocks import Page
from accerl_lerobot.report.charts import SPANS
from accerl_lerobot.report.comparison import comparison_page
from accerl_lerobot.report.config import ReportConfig
from accerl_lerobot.report.read import Run, read_run
from accerl_lerobot.report.run_page import run_page
from accerl_lerobot.report.world_model_page import world_model_page

NAME = "report.html"
MARK = '<meta name="generator" content="accerl report'
"""Tells a page of ours from any other file; near its beginning."""
HEAD = 1000
"""Characters within which the mark stands."""


def write_report(config: ReportConfig, recipes: Mapping[str, type[Any]]) -> Path:
    """Reads the runs and writes the page.

    Args:
        config: which runs, and where to.
        recipes: verb → class of its config.

    Returns:
        Where the page is.

    Raises:
        InputError: a run cannot be read, runs are of different kinds, or the page has no place.
    """
    output = None if config.output is None else expanded(config.output, "output")
    runs = [read_run(Path(name).expanduser()) for name in config.runs]
    if len({run.path.resolve() for run in runs}) < len(runs):
        raise InputError("runs", ",".join(config.runs), "name each run once")
    verbs = dict.fromkeys(run.verb for run in runs)
    if len(verbs) > 1:
        remedy = f"a page compares runs of one kind; these are of accerl {' and '.join(verbs)}"
        raise InputError("runs", ",".join(config.runs), remedy)
    if output is None:
        output = runs[0].path / NAME if len(runs) == 1 else Path(NAME)
    _check_place(output)
    page = page_of(runs, recipes, time.time())
    html = render(page, output.resolve().parent, config.video_mb)
    part = output.with_name(f".{output.name}.part")
    try:
        part.write_text(html, encoding="utf-8")
        os.replace(part, output)
    except OSError as error:
        with contextlib.suppress(OSError):
            part.unlink()
        raise InputError("output", str(output), f"cannot be written: {error.strerror}") from error
    return output


def page_of(runs: list[Run], recipes: Mapping[str, type[Any]], now: float) -> Page:
    """Makes the page of one run, or of several."""
    if len(runs) > 1:
        return comparison_page(runs, now)
    (run,) = runs
    return (run_page if run.verb == "train" else world_model_page)(run, recipes[run.verb], now)


def render(page: Page, folder: Path, video_mb: float) -> str:
    """The file's text.

    Args:
        page: what stands on it.
        folder: where it will lie, for links to videos that are too large.
        video_mb: above this, a video is linked.
    """
    files = resources.files("accerl_lerobot.report")
    style, script = (files.joinpath(name).read_text() for name in ("page.css", "page.js"))
    environment = Environment(
        loader=PackageLoader("accerl_lerobot", "report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("page.html").render(
        page=page,
        style=style,
        script=script,
        script_hash=_hash(script),
        version=__version__,
        spans=SPANS,
        film=lambda path: film(path, folder, video_mb),
        megabytes=lambda path: path.stat().st_size / 1e6,
    )


def film(path: Path, folder: Path, video_mb: float) -> tuple[bool, str]:
    """True if a video is inside the page, and its address: the video itself, or where it lies."""
    if path.stat().st_size <= video_mb * 1e6:
        return True, f"data:video/mp4;base64,{base64.b64encode(path.read_bytes()).decode()}"
    return False, quote(os.path.relpath(path.resolve(), folder))


def _check_place(output: Path) -> None:
    """Refuses to write over anything but an older page."""
    if output.is_dir():
        raise InputError("output", str(output), f"a folder; name a file in it, such as {output / NAME}")
    if not output.parent.is_dir():
        raise InputError("output", str(output), f"there is no folder {output.parent}; make it first")
    if output.exists():
        with output.open(encoding="utf-8", errors="replace") as file:
            if MARK not in file.read(HEAD):
                raise InputError("output", str(output), "there is another file of this name; choose another")


def _hash(script: str) -> str:
    """As a content security policy names a script: the browser hashes what is between the tags."""
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
