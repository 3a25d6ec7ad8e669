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
"""``accerl VERB --help``: every field with its default and the docstring under it, read from the source."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import textwrap
import typing
from typing import Any

import yaml

from accerl_lerobot.parsing import TYPE, choices_of, room_of

WIDTH = 110
COLUMN = 44
"""Where explanations begin."""


def help_text(verb: str, config_class: type[Any], what: str) -> str:
    """The whole text.

    Args:
        verb: as it is typed.
        config_class: its config.
        what: what it does, one line.
    """
    lines = [
        f"usage: accerl {verb} {_bare(config_class)} [--room.field=value …]",
        "",
        textwrap.fill(f"{what[0].upper()}{what[1:]}. Fields not given keep the value shown.", WIDTH),
        "",
        *_fields(config_class, ""),
    ]
    return "\n".join(lines)


def _bare(config_class: type[Any]) -> str:
    """What stands on the command line without a name."""
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


def _fields(cls: type[Any], prefix: str, usual: Any = None) -> list[str]:
    """Lines of its fields with their defaults: those of `usual`, which is one of it, or its own."""
    hints, docs = typing.get_type_hints(cls), docstrings(cls)
    lines: list[str] = []
    rooms: list[str] = []
    for field in dataclasses.fields(cls):
        name, room = f"{prefix}{field.name}", room_of(hints[field.name])
        if room is None:
            text = " ".join([docs[field.name], *_choices(field)])
            lines += _entry(f"--{name}={_shown(_default(field, usual))}", text)
            continue
        choices, default = choices_of(room), _default(field, usual)
        if not choices:
            note = "" if default is not None else " (off unless given)"
            rooms += ["", f"{name}{note}: {_summary(room)}", *_fields(room, f"{name}.", default)]
            continue
        for kind, subclass in choices.items():
            chosen = default if getattr(default, TYPE, None) == kind else None
            note = "" if chosen is None else " (default)"
            rooms += ["", f"{name}.{TYPE}={kind}{note}: {_summary(subclass)}"]
            rooms += _fields(subclass, f"{name}.", chosen)
    return lines + rooms


def _entry(flag: str, text: str) -> list[str]:
    start = f"  {flag}"
    if not text:
        return [start]
    if len(start) < COLUMN:
        return textwrap.wrap(text, WIDTH, initial_indent=start.ljust(COLUMN), subsequent_indent=" " * COLUMN)
    return [start, *textwrap.wrap(text, WIDTH, initial_indent=" " * COLUMN, subsequent_indent=" " * COLUMN)]


def _choices(field: Any) -> list[str]:
    """What a field's values mean, where its metadata has a table of them: each entry has a `what`."""
    return [f"{name}: {entry.what}" for name, entry in field.metadata.get("choices", {}).items()]


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
