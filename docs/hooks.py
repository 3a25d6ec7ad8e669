# SPDX-License-Identifier: Apache-2.0
"""Hook of MkDocs that writes the reference of all options from the config dataclasses."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from accerl_lerobot.cli import VERBS  # noqa: E402
from accerl_lerobot.cli.verbs import CONFIGS  # noqa: E402
from accerl_lerobot.config.help import docstrings, shown  # noqa: E402
from accerl_lerobot.config.parsing import choices_of, section_of  # noqa: E402
from accerl_lerobot.config.ranges import annotations_of, defaults_of, wanted  # noqa: E402


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Append the tables to options.md."""
    return markdown + options() if page.file.src_uri == "options.md" else markdown


def options() -> str:
    """A chapter for each verb. A section that several verbs read stands with the first of them."""
    seen: set[tuple[str, type]] = set()
    chapters = ["\n| verb | use |\n|---|---|"]
    chapters += [f"| `accerl {verb}` | {use} |" for verb, use in VERBS.items()]
    for verb, config_class in CONFIGS.items():
        if ("", config_class) in seen:
            continue
        seen.add(("", config_class))
        what = VERBS[verb.split()[0]]
        chapters.append(f"\n## accerl {verb}\n\n{what[0].upper()}{what[1:]}.\n")
        chapters.append(section(config_class, "", seen))
    return "\n".join(chapters)


def section(config_class: type[Any], prefix: str, seen: set[tuple[str, type]]) -> str:
    """Table of the fields of a config, then the sections inside it."""
    hints, texts = annotations_of(config_class), docstrings(config_class)
    defaults = defaults_of(config_class)
    rows, inner = [], []
    for field in dataclasses.fields(config_class):
        name, nested = f"{prefix}{field.name}", section_of(hints[field.name])
        if nested is None:
            span = wanted(hints[field.name])
            cells = (f"`{name}`", f"`{shown(defaults[field.name])}`", span, texts[field.name])
            rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        elif (name, nested) not in seen:
            seen.add((name, nested))
            for kind, one in (choices_of(nested) or {"": nested}).items():
                title = f"{name}.type={kind}" if kind else name
                about = (one.__doc__ or "").partition("\n\n")[0]
                inner.append(f"\n### {title}\n\n{about}\n\n{section(one, f'{name}.', seen)}")
    head = ["| field | default | values | meaning |", "|---|---|---|---|"]
    return "\n".join([*(head + rows if rows else []), *inner])
