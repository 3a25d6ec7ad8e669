# SPDX-License-Identifier: Apache-2.0
"""``accerl VERB --help``: every field with its default and the docstring under it, read from the source."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import sys
import textwrap
import typing
from collections.abc import Collection, Mapping
from typing import Any

import yaml

from accerl_lerobot.config.parsing import TYPE, choices_of, section_of
from accerl_lerobot.config.ranges import hints_of, range_in_words
from accerl_lerobot.errors import InputError

WIDTH = 110
COLUMN = 44
"""Where explanations begin."""


PAGE = 60
"""Lines that are shown at once; what is longer is shown by section."""
COMMON = (
    "output_dir", "job_name", "seed", "resume", "path", "repo_id", "env.type", "env.task", "env.image_size",
    "env.max_steps", "dataset.repo_id", "dataset.root", "demos.episodes", "root", "sft.steps",
    "sft.batch_size", "sft.lr", "policy.path", "policy.device", "policy.precision", "policy.tuning.mode",
    "device", "rollout.workers", "rollout.worlds", "rollout.decision_cost", "replay.capacity",
    "replay.samples_per_insert", "algorithm.type", "trainer.updates", "trainer.batch_decisions",
    "trainer.lr", "trainer.value_lr", "evaluation.episodes",
    "evaluation.every_updates", "launch.engine", "wandb.enable", "save_every_s",
)  # fmt: skip
"""Fields that people change."""


def help_text(command: str, config_class: type[Any], what: str, section: str = "") -> str:
    """The text of ``--help``: all fields if they fit a page, otherwise those that people change.

    `what` says in one line what the command does; `section` is that of ``--help=SECTION``, or ``all``.
    """
    lines = [
        f"usage: {command} {_bare(config_class)} [--section.field=value …]",
        "",
        textwrap.fill(f"{what[0].upper()}{what[1:]}. Fields not given keep the value shown.", WIDTH),
        "",
    ]
    every = _fields(config_class, "")
    if section not in ("", "all"):
        return "\n".join(_of_section(every, section, config_class))
    if section == "all" or len(lines) + len(every) <= PAGE:
        return "\n".join(lines + every)
    lines += [line for name in COMMON for line in _brief(config_class, name)]
    lines += ["", f"more: {command} --help=all, or --help=SECTION:"]
    hints = hints_of(config_class)
    for name, section_class in ((name, section_of(hint)) for name, hint in hints.items()):
        if section_class is not None:
            text = " | ".join(choices_of(section_class)) or _summary(section_class)
            lines.append(f"  {name:12}{text}"[:WIDTH])
    return "\n".join(lines)


def brief(config_class: type[Any]) -> str:
    """The first sentence of the module that a config is in, on one line."""
    doc = sys.modules[config_class.__module__].__doc__ or ""
    return doc.partition("\n\n")[0].replace("\n", " ")


def _of_section(every: list[str], section: str, config_class: type[Any]) -> list[str]:
    """The lines that are about a section, such as ``trainer`` or ``policy.sampler``, and those below it."""
    chosen, inside = [], False
    for line in every:
        if line and not line.startswith(" "):
            name = line.partition(":")[0].partition(" ")[0].partition("=")[0].removesuffix(f".{TYPE}")
            inside = name == section or name.startswith(f"{section}.")
        if inside:
            chosen.append(line)
    if not chosen:
        names = [name for name, hint in hints_of(config_class).items() if section_of(hint) is not None]
        raise InputError("--help", section, f"use all or one of {', '.join(names)}" if names else "use all")
    return chosen


def _brief(config_class: type[Any], dotted: str) -> list[str]:
    """A field in one line, if the config has it."""
    cls: type[Any] | None = config_class
    default: Any = None
    *sections, last = dotted.split(".")
    for depth, name in enumerate(sections):
        field = next((f for f in dataclasses.fields(cls) if f.name == name), None) if cls else None
        if cls is None or field is None:
            return []
        default, cls = _default(field, default), section_of(hints_of(cls)[name])
        if cls is not None and last == TYPE and depth == len(sections) - 1:
            return [_one_line(f"--{dotted}={getattr(default, TYPE, '')}", " | ".join(choices_of(cls)))]
        cls = type(default) if default is not None else cls
    field = next((f for f in dataclasses.fields(cls) if f.name == last), None) if cls else None
    if cls is None or field is None:
        return []
    choices = range_in_words(hints_of(cls)[last])
    text = choices if " | " in choices else docstrings(cls)[last]
    return [_one_line(f"--{dotted}={_shown(_default(field, default))}", text)]


def _one_line(flag: str, text: str) -> str:
    """Its first sentence, shortened to a line."""
    first = text.partition(". ")[0].removesuffix(".")
    return textwrap.shorten(first, WIDTH - COLUMN, placeholder=" …").join(
        [f"  {flag}".ljust(COLUMN - 1) + " ", ""]
    )


def _bare(config_class: type[Any]) -> str:
    """Positional arguments of the command line."""
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
        for statement, below in zip(node.body, [*node.body[1:], None], strict=True):
            if not (isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name)):
                continue
            text = below.value.value if _is_text(below) else ""
            if text or statement.target.id not in found:
                found[statement.target.id] = " ".join(text.split())
    return found


def _fields(cls: type[Any], prefix: str, usual: Any = None, without: Collection[str] = ()) -> list[str]:
    """Lines of its fields with their defaults: those of `usual`, which is one of it, or its own."""
    hints = hints_of(cls)
    lines: list[str] = []
    sections: list[str] = []
    for field in dataclasses.fields(cls):
        if field.name in without:
            continue
        name, section = f"{prefix}{field.name}", section_of(hints[field.name])
        if section is None:
            lines += _field(cls, field, prefix, usual)
            continue
        choices, default = choices_of(section), _default(field, usual)
        if choices:
            sections += _types(choices, name, default)
            continue
        note = "" if default is not None else " (off unless given)"
        sections += ["", f"{name}{note}: {_summary(section)}", *_fields(section, f"{name}.", default)]
    return lines + sections


def _field(cls: type[Any], field: Any, prefix: str, usual: Any) -> list[str]:
    """Lines of a field that is no section."""
    text = docstrings(cls)[field.name]
    span = range_in_words(hints_of(cls)[field.name])
    if span and not all(choice in text for choice in span.split(" | ")):
        text = f"{text} {span[0].upper()}{span[1:]}.".strip()
    return _entry(f"--{prefix}{field.name}={_shown(_default(field, usual))}", text)


def _types(choices: Mapping[str, type[Any]], name: str, default: Any) -> list[str]:
    """Lines of the types of a choice: what they have in common, then each."""
    usual = {kind: default if getattr(default, TYPE, None) == kind else None for kind in choices}
    owners: dict[tuple[str, ...], list[str]] = {}
    for kind, subclass in choices.items():
        for field in dataclasses.fields(subclass):
            if section_of(hints_of(subclass)[field.name]) is None:
                entry = (field.name, *_field(subclass, field, f"{name}.", usual[kind]))
                owners.setdefault(entry, []).append(kind)
    common: dict[tuple[str, ...], list[tuple[str, ...]]] = {}
    for entry, kinds in owners.items():
        if len(kinds) > 1:
            common.setdefault(tuple(kinds), []).append(entry)
    lines: list[str] = []
    for alike, entries in common.items():
        lines += ["", f"{name}.{TYPE}={' | '.join(alike)}: Fields that these have in common."]
        lines += [line for entry in entries for line in entry[1:]]
    for kind, subclass in choices.items():
        note = "" if usual[kind] is None else " (default)"
        shared = {entry[0] for entry, kinds in owners.items() if kind in kinds and len(kinds) > 1}
        lines += ["", f"{name}.{TYPE}={kind}{note}: {_summary(subclass)}"]
        lines += _fields(subclass, f"{name}.", usual[kind], shared)
    return lines


def _entry(flag: str, text: str) -> list[str]:
    start = f"  {flag}"
    if not text:
        return [start]
    if len(start) < COLUMN:
        return textwrap.wrap(text, WIDTH, initial_indent=start.ljust(COLUMN), subsequent_indent=" " * COLUMN)
    return [start, *textwrap.wrap(text, WIDTH, initial_indent=" " * COLUMN, subsequent_indent=" " * COLUMN)]


def _default(field: Any, usual: Any = None) -> Any:
    if usual is not None:
        return getattr(usual, field.name)
    if field.default is not dataclasses.MISSING:
        return field.default
    return None if field.default_factory is dataclasses.MISSING else field.default_factory()


def _shown(value: Any) -> str:
    """A value as one would type it."""
    if isinstance(value, str):
        return value
    if isinstance(value, tuple):
        value = list(value)
    return yaml.safe_dump(value, default_flow_style=True, width=1000).removesuffix("\n...\n").strip()


def _summary(cls: type[Any]) -> str:
    return (inspect.getdoc(cls) or "").split("\n\n")[0].replace("\n", " ")


def _is_text(node: ast.stmt | None) -> typing.TypeGuard[Any]:
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )
