# SPDX-License-Identifier: Apache-2.0
"""``accerl report``: one HTML file about a run of ``accerl train``, or about several, with all that it needs.

The template escapes all text, and a content security policy forbids the browser every script and request, so
text of a run that got past the escaping could do nothing. Free of torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from accerl_lerobot.config.ranges import RunsConfig
from accerl_lerobot.errors import expanded

NAME = "report.html"


@dataclass(frozen=True, kw_only=True)
class ReportConfig(RunsConfig):
    """Fields of ``accerl report``."""


def write_report(config: ReportConfig) -> Path:
    """Reads the runs and writes the page."""
    from accerl_lerobot.report.page import comparison, html, one_run
    from accerl_lerobot.report.read import read_run

    output = config.file(NAME)
    runs = [read_run(expanded(name, "runs")) for name in config.runs]
    page = one_run(runs[0]) if len(runs) == 1 else comparison(runs)
    text = html(page, output.resolve().parent)
    output.write_text(text, encoding="utf-8")
    return output
