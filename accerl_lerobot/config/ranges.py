# SPDX-License-Identifier: Apache-2.0
"""Ranges of config fields, declared in the annotation: checked in one place, and shown by ``--help``.

Example:
    >>> @dataclass(frozen=True, kw_only=True)
    ... class OptimizerConfig(Section, section="trainer"):
    ...     lr: Annotated[float, Range("[0, 1)")] = 1e-4
    ...     schedule: Literal["constant", "cosine"] = "constant"
    >>> OptimizerConfig(lr=2)
    Traceback (most recent call last):
    accerl_lerobot.errors.InputError: trainer.lr=2: use a number in [0, 1)
"""

from __future__ import annotations

import dataclasses
import functools
import math
import numbers
import re
import types
import typing
from collections.abc import Hashable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

from accerl_lerobot.errors import InputError, expanded


class Range:
    """An interval of numbers as mathematics writes it: ``Range("[0, 1)")``, ``Range("(0, inf)")``.

    Infinity is a value only where the interval is closed there; NaN never is.
    """

    def __init__(self, text: str) -> None:
        match = re.fullmatch(r"([\[(])(\S+), (\S+)([\])])", text)
        if match is None:
            raise ValueError(f"{text}: write an interval such as [0, 1)")
        opening, low, high, closing = match.groups()
        self.text = text
        self._low_open = opening == "("
        self._high_open = closing == ")"
        self.low = float(low)
        self.high = float(high)

    def __repr__(self) -> str:
        return f"Range({self.text!r})"

    def __contains__(self, value: Any) -> bool:
        if value == self.low:
            return not self._low_open
        if value == self.high:
            return not self._high_open
        return bool(self.low < value < self.high)


class Pattern:
    """Texts that match a regular expression; `words` says which these are."""

    def __init__(self, pattern: str, words: str) -> None:
        self.pattern = re.compile(pattern)
        self.words = words

    def __repr__(self) -> str:
        return f"Pattern({self.pattern.pattern!r})"

    def __contains__(self, value: Any) -> bool:
        return self.pattern.fullmatch(value) is not None


Share = Annotated[float, Range("[0, 1]")]
Positive = Annotated[float, Range("(0, inf)")]
NonNegative = Annotated[float, Range("[0, inf)")]
LearningRate = Annotated[float, Range("(0, 1)")]
Seed = Annotated[int, Range("[0, 4294967295]")]  # a seed that Python, NumPy, torch and all simulators accept
Steps = Annotated[int, Range("[0, 1000000000]")]  # a number of steps, updates or episodes that may be 0
Device = Annotated[str, Pattern(r"auto|cpu|cuda(:\d{1,2})?", "auto, cpu, cuda or cuda:0")]
Threads = Annotated[int, Range("[1, 1024]")]
NewFolder = Annotated[str, Pattern(r"(?s).+", "the name of a folder to create")]
Repeats = Annotated[int, Range("[1, 100000]")]
Commit = Annotated[str, Pattern(r"[0-9a-f]{40}", "the 40 hexadecimal digits of a commit")]


registered_name = property(lambda section: str(section.get_choice_name(section.__class__)))
"""Name under which a section's class is registered: its `type`."""


class Section:
    """Base of every config section: construction checks each field against its annotation.

    A subclass with a ``__post_init__`` of its own, for what concerns several fields, calls this one first.
    """

    SECTION: ClassVar[str] = ""  # name on the command line, dotted; empty for the config of a whole command

    def __init_subclass__(cls, section: str | None = None, **rest: Any) -> None:
        super().__init_subclass__(**rest)
        if section is not None:
            cls.SECTION = section

    def __post_init__(self) -> None:
        for name, annotation in annotations_of(type(self)).items():
            dotted = f"{self.SECTION}.{name}" if self.SECTION else name
            check(annotation, getattr(self, name), dotted)


@dataclass(frozen=True, kw_only=True)
class DatasetConfig(Section, section="dataset"):
    """A LeRobotDataset, on the Hub or in a folder."""

    repo_id: str | None = None
    """Hub id, or a label for `root`. None: the run records its own demonstrations."""
    root: str | None = None
    """Local folder; None uses the Hub and its cache."""
    revision: str | None = None
    """Hub revision."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.root is not None and self.repo_id is None:
            hint = "name the dataset in dataset.root; any owner/name will do"
            raise InputError("dataset.repo_id", None, hint)


@dataclass(frozen=True, kw_only=True)
class RunsConfig(Section):
    """Runs that a verb reads, and the file that it makes of them."""

    BARE: ClassVar[str] = "runs"

    runs: tuple[str, ...] = ()
    """Folders of runs; several go into one file. Bare arguments are runs."""
    output: str | None = None
    """The file. None: ``report.html`` or ``timeline.json`` in the run's folder, here if there are several."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.runs:
            raise InputError("runs", "", "name the folder of a run")

    def file(self, name: str) -> Path:
        """The file to write, which is called `name` by default; refused if it is a folder, or in none."""
        if self.output is not None:
            path = expanded(self.output, "output")
        elif len(self.runs) == 1:
            path = expanded(self.runs[0], "runs") / name
        else:
            path = Path(name)
        missing = self.output is not None and not path.parent.is_dir()
        if missing or path.is_dir():
            raise InputError("output", str(path), "name a file in a folder that exists")
        return path


def annotations_of(cls: type[Any]) -> dict[str, Any]:
    """Field name → annotation, with its range."""
    return _annotations_of(typing.cast(Hashable, cls))


@functools.cache
def _annotations_of(cls: Any) -> dict[str, Any]:
    annotations = typing.get_type_hints(cls, include_extras=True)
    return {field.name: annotations[field.name] for field in dataclasses.fields(cls)}


def defaults_of(cls: type[Any]) -> dict[str, Any]:
    """Field name → default; None where there is none."""
    defaults: dict[str, Any] = {}
    for field in dataclasses.fields(cls):
        if field.default_factory is not dataclasses.MISSING:
            defaults[field.name] = field.default_factory()
        elif field.default is not dataclasses.MISSING:
            defaults[field.name] = field.default
        else:
            defaults[field.name] = None
    return defaults


def check(annotation: Any, value: Any, field: str) -> None:
    """Refuses a value that does not fit an annotation."""
    if not fits(annotation, value):
        raise InputError(field, value, f"use {wanted(annotation)}")


def fits(annotation: Any, value: Any) -> bool:
    """True if a value fits an annotation and its range."""
    origin = typing.get_origin(annotation)
    arguments = typing.get_args(annotation)
    if origin is Annotated:
        kind, mark = arguments
        kind_fits = _is_number(value) if kind is float else fits(kind, value)
        return kind_fits and value in mark
    if is_union(annotation):
        return any(fits(kind, value) for kind in arguments)
    if origin is typing.Literal:
        return value in arguments
    if origin is dict:
        if not isinstance(value, dict):
            return False
        return all(fits(arguments[1], entry) for entry in value.values())
    if origin in (list, tuple):
        if not isinstance(value, (list, tuple)):
            return False
        fixed = origin is tuple and Ellipsis not in arguments
        if fixed and len(value) != len(arguments):
            return False
        return all(fits(arguments[0], entry) for entry in value)
    if annotation is float:
        return _is_number(value) and math.isfinite(value)
    if annotation is int:
        return _is_number(value) and isinstance(value, numbers.Integral)
    if annotation in (bool, str, type(None)):
        return isinstance(value, annotation)
    return True


def _is_number(value: Any) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool)


PLAIN = {int: "a whole number", float: "a number", bool: "true or false", str: "text", type(None): "null"}


def wanted(annotation: Any) -> str:
    """Values that fit an annotation, in words."""
    origin = typing.get_origin(annotation)
    arguments = typing.get_args(annotation)
    if origin is Annotated:
        kind, mark = arguments
        if isinstance(mark, Pattern):
            return mark.words
        return f"{wanted(kind)} in {mark.text}"
    if is_union(annotation):
        return " or ".join(wanted(kind) for kind in arguments)
    if origin is typing.Literal:
        return " or ".join(map(str, arguments))
    if origin is tuple and Ellipsis not in arguments:
        return f"a list of {len(arguments)}, each {wanted(arguments[0])}"
    if origin in (list, tuple):
        return f"a list such as [a, b], each {wanted(arguments[0])}"
    if origin is dict:
        return "a mapping such as {key: value}"
    return PLAIN.get(annotation, str(annotation))


def is_union(annotation: Any) -> bool:
    """True for ``X | Y``."""
    return typing.get_origin(annotation) in (typing.Union, types.UnionType)


def is_optional(annotation: Any) -> bool:
    """True for ``X | None``."""
    return is_union(annotation) and type(None) in typing.get_args(annotation)
