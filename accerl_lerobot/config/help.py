# SPDX-License-Identifier: Apache-2.0
"""``accerl VERB --help``: every field with its default and the docstring under it, read from the source."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import textwrap
from collections import defaultdict
from collections.abc import Iterator
from itertools import pairwise
from typing import Any, NamedTuple

import yaml

from accerl_lerobot.config.parsing import TYPE, choices_of, sections_of
from accerl_lerobot.config.ranges import annotations_of, defaults_of, wanted
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
    usual: bool  # False in a type that is not the default one


def help_text(command: str, config_class: type[Any], what: str, section: str = "") -> str:
    """The text of ``--help``: all fields if they fit a page, otherwise those that people change.

    `what` says in one line what the command does; `section` is that of ``--help=SECTION``, or ``all``.
    """
    lines = list(_lines(config_class))
    sections = sections_of(config_class)
    if section not in ("", "all"):
        inside = [line for line in lines if f"{line.name}.".startswith(f"{section}.")]
        if not inside:
            raise InputError("--help", section, f"use all or one of {', '.join(sections) or 'none'}")
        return "\n".join(map(_in_full, inside))
    bare: str = getattr(config_class, "BARE", "")
    recipe = f"{bare.upper()} …" if bare else "[recipe.yaml | --config_path=recipe.yaml]"
    usage = f"usage: {command} {recipe} [--section.field=value …]"
    about = f"{_capital(what)}. Shown are defaults; a recipe counts more."
    head = [usage, "", textwrap.fill(about, WIDTH), ""]
    full = "\n".join([*head, *map(_in_full, lines)])
    if section == "all" or full.count("\n") < PAGE:
        return full
    common = [_in_brief(line) for line in lines if line.name in COMMON and line.usual]
    more = ["", f"more: {command} --help=all, or --help=SECTION:"]
    for name, kind in sections.items():
        content = " | ".join(choices_of(kind)) or _summary(kind)
        line = f"  {name:12}{content}"
        more.append(line[:WIDTH])
    return "\n".join(head + common + more)


def _capital(text: str) -> str:
    """The text with a capital letter at its beginning."""
    return f"{text[0].upper()}{text[1:]}"


def docstrings(cls: type[Any]) -> dict[str, str]:
    """Field name → the docstring under it, those of base classes included; "" where there is none."""
    texts: dict[str, str] = defaultdict(str)
    for base in reversed(cls.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        node = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        assert isinstance(node, ast.ClassDef)
        for pair in pairwise(node.body):
            match pair:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                    texts[name] = " ".join(text.split())
    return texts


def _lines(cls: type[Any], prefix: str = "", default: Any = None, usual: bool = True) -> Iterator[Line]:
    """Fields of a config and of its sections, of a choice those of all types.

    `default` is an instance with the defaults to show; None: those of the class.
    """
    texts = docstrings(cls)
    defaults = defaults_of(cls)
    sections = sections_of(cls)
    for name, annotation in annotations_of(cls).items():
        if name not in sections:
            value = getattr(default, name, defaults[name])
            text = f"{texts[name]} {in_words(annotation)}"
            yield Line(f"{prefix}{name}", shown(value), text, usual)
    for name, section in sections.items():
        dotted = f"{prefix}{name}"
        inner = getattr(default, name, defaults[name])
        types = choices_of(section)
        if not types:
            note = " (off unless given)" if inner is None else ""
            yield Line(dotted, None, f"{dotted}{note}: {_summary(section)}", usual)
            yield from _lines(section, f"{dotted}.", inner, usual)
            continue
        chosen = getattr(inner, TYPE, None)
        if chosen is not None:
            yield Line(f"{dotted}.{TYPE}", chosen, " | ".join(types), usual)
        for kind, subclass in types.items():
            default_one = kind == chosen
            note = " (default)" if default_one else ""
            yield Line(dotted, None, f"{dotted}.{TYPE}={kind}{note}: {_summary(subclass)}", usual)
            yield from _lines(subclass, f"{dotted}.", inner if default_one else None, usual and default_one)


def in_words(annotation: Any) -> str:
    """The values of a field as a sentence; empty for any text."""
    words = wanted(annotation)
    if words.startswith(("text", "true", "the ", "a list", "a mapping")):
        return ""
    return f"{_capital(words)}."


def _in_full(line: Line) -> str:
    """A field with all that is said about it, or a heading."""
    if line.default is None:
        return f"\n{line.text}"
    start = f"  --{line.name}={line.default}"
    above = ""
    if len(start) >= COLUMN:
        above = f"{start}\n"
        start = ""
    first = start.ljust(COLUMN)
    others = " " * COLUMN
    text = textwrap.fill(line.text or " ", WIDTH, initial_indent=first, subsequent_indent=others)
    return above + text


def _in_brief(line: Line) -> str:
    """A field in one line: the first sentence about it."""
    start = f"  --{line.name}={line.default}".ljust(COLUMN - 1)
    sentence = line.text.partition(". ")[0].strip().removesuffix(".")
    text = textwrap.shorten(sentence, WIDTH - COLUMN, placeholder=" …")
    return f"{start} {text}"


def shown(value: Any) -> str:
    """A value as one would type it."""
    if isinstance(value, str):
        return value
    plain = list(value) if isinstance(value, tuple) else value
    text = yaml.safe_dump(plain, default_flow_style=True, width=10_000, allow_unicode=True)
    return text.removesuffix("\n").removesuffix("\n...")


def _summary(cls: type[Any]) -> str:
    """The first paragraph of a class's docstring."""
    text = inspect.getdoc(cls) or ""
    if text.startswith(f"{cls.__name__}("):  # a dataclass without a docstring shows its signature
        return ""
    paragraph = text.split("\n\n")[0]
    return paragraph.replace("\n", " ")
