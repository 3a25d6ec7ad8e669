# SPDX-License-Identifier: Apache-2.0
"""``accerl VERB --help``: every field with its default and the docstring under it, read from the source."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import sys
import textwrap
from itertools import pairwise
from typing import Any, NamedTuple

import yaml

from accerl_lerobot.config.parsing import TYPE, choices_of, sections_of
from accerl_lerobot.config.ranges import annotations_of, defaults_of, range_in_words
from accerl_lerobot.errors import InputError

WIDTH = 110
COLUMN = 44  # where explanations begin
PAGE = 60  # lines that are shown at once; what is longer is shown by section
COMMON = (
    "output_dir", "job_name", "seed", "resume", "path", "repo_id", "env.type", "env.task", "env.image_size",
    "env.max_steps", "dataset.repo_id", "dataset.root", "demos.episodes", "root", "sft.steps",
    "sft.batch_size", "sft.lr", "policy.path", "policy.device", "policy.precision", "policy.tuning.mode",
    "device", "rollout.workers", "rollout.environments", "rollout.decision_cost", "replay.capacity",
    "replay.samples_per_insert", "algorithm.type", "trainer.updates", "trainer.batch_decisions",
    "trainer.lr", "trainer.value_lr", "evaluation.episodes",
    "evaluation.every_updates", "launch.engine", "wandb.enable", "save_every_s",
)  # fmt: skip
"""Fields that people change."""


class Line(NamedTuple):
    """A field of a config, or the heading of a section."""

    name: str  # dotted
    default: str | None  # as one would type it; None: a heading
    text: str
    choices: str = ""  # its range


def help_text(command: str, config_class: type[Any], what: str, section: str = "") -> str:
    """The text of ``--help``: all fields if they fit a page, otherwise those that people change.

    `what` says in one line what the command does; `section` is that of ``--help=SECTION``, or ``all``.
    """
    listed, sections = _listed(config_class), sections_of(config_class)
    if section not in ("", "all"):
        inside = [line for line in listed if f"{line.name}.".startswith(f"{section}.")]
        if not inside:
            hint = f"use all or one of {', '.join(sections)}" if sections else "use all"
            raise InputError("--help", section, hint)
        return "\n".join(_in_full(inside))
    head = [
        f"usage: {command} {_bare(config_class)} [--section.field=value …]",
        "",
        textwrap.fill(f"{what[0].upper()}{what[1:]}. Shown are defaults; a recipe counts more.", WIDTH),
        "",
    ]
    full = _in_full(listed)
    if section == "all" or len(head) + len(full) <= PAGE:
        return "\n".join(head + full)
    usual = {line.name: line for line in _listed(config_class, all_types=False)}
    head += [_in_brief(usual[name]) for name in COMMON if name in usual]
    head += ["", f"more: {command} --help=all, or --help=SECTION:"]
    for name, kind in sections.items():
        head.append(f"  {name:12}{' | '.join(choices_of(kind)) or _summary(kind)}"[:WIDTH])
    return "\n".join(head)


def brief(config_class: type[Any]) -> str:
    """The first sentence of the module that a config is in, on one line."""
    doc = sys.modules[config_class.__module__].__doc__ or ""
    return doc.partition("\n\n")[0].replace("\n", " ")


def _bare(config_class: type[Any]) -> str:
    name: str | None = getattr(config_class, "BARE", None)
    if name is None:
        return "[recipe.yaml | --config_path=recipe.yaml]"
    one = name.removesuffix("s").upper()
    return f"{one} [{one} …]"


def docstrings(cls: type[Any]) -> dict[str, str]:
    """Field name → the docstring under it, those of base classes included; "" where there is none."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        node = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        assert isinstance(node, ast.ClassDef)
        for pair in pairwise([*node.body, ast.Pass()]):
            match pair:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                    found[name] = " ".join(text.split())
                case ast.AnnAssign(target=ast.Name(id=name)), _:
                    found.setdefault(name, "")
    return found


def _listed(cls: type[Any], prefix: str = "", usual: Any = None, all_types: bool = True) -> list[Line]:
    """Fields of a config and of its sections, with the defaults of `usual`, which is one of it, or its own.

    Of a choice, all types, or, with `all_types` off, the default one and the choice itself as a field.
    """
    texts, defaults, sections = docstrings(cls), defaults_of(cls), sections_of(cls)
    fields: list[Line] = []
    below: list[Line] = []
    for name, annotation in annotations_of(cls).items():
        default = getattr(usual, name, defaults[name])
        if name in sections:
            below += _section(sections[name], f"{prefix}{name}", default, all_types)
        else:
            line = Line(f"{prefix}{name}", shown(default), texts[name], range_in_words(annotation))
            fields.append(line)
    return fields + below


def _section(section: type[Any], name: str, default: Any, all_types: bool) -> list[Line]:
    """Headings and fields of a section, see `_listed`."""
    choices, chosen = choices_of(section), getattr(default, TYPE, None)
    if not choices:
        note = " (off unless given)" if default is None else ""
        heading = Line(name, None, f"{name}{note}: {_summary(section)}")
        return [heading, *_listed(section, f"{name}.", default)]
    lines: list[Line] = []
    if all_types:
        for kind, subclass in choices.items():
            note = " (default)" if kind == chosen else ""
            lines.append(Line(name, None, f"{name}.{TYPE}={kind}{note}: {_summary(subclass)}"))
            lines += _listed(subclass, f"{name}.", default if kind == chosen else None)
    elif default is not None:
        lines.append(Line(f"{name}.{TYPE}", chosen, "", " | ".join(choices)))
        lines += _listed(type(default), f"{name}.", default, all_types=False)
    return lines


def _in_full(listed: list[Line]) -> list[str]:
    lines: list[str] = []
    for line in listed:
        if line.default is None:
            lines += ["", line.text]
            continue
        text = line.text
        if line.choices and not all(choice in text for choice in line.choices.split(" | ")):
            text = f"{text} {line.choices[0].upper()}{line.choices[1:]}.".strip()
        start = f"  --{line.name}={line.default}"
        if not text or len(start) >= COLUMN:
            lines.append(start)
            start = ""
        first, others = start.ljust(COLUMN), " " * COLUMN
        lines += textwrap.wrap(text, WIDTH, initial_indent=first, subsequent_indent=others)
    return lines


def _in_brief(line: Line) -> str:
    """A field in one line: its choices, or the first sentence about it."""
    text = line.choices if " | " in line.choices else line.text.partition(". ")[0].removesuffix(".")
    start = f"  --{line.name}={line.default}".ljust(COLUMN - 1)
    return f"{start} {textwrap.shorten(text, WIDTH - COLUMN, placeholder=' …')}"


def shown(value: Any) -> str:
    """A value as one would type it."""
    if isinstance(value, str):
        return value
    plain = list(value) if isinstance(value, tuple) else value
    text = yaml.safe_dump(plain, default_flow_style=True, width=10_000, allow_unicode=True)
    return text.removesuffix("\n").removesuffix("\n...")


def _summary(cls: type[Any]) -> str:
    text = inspect.getdoc(cls) or ""  # a dataclass without one shows its signature
    return "" if text.startswith(f"{cls.__name__}(") else text.split("\n\n")[0].replace("\n", " ")
