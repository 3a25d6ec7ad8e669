# SPDX-License-Identifier: Apache-2.0
"""The recipe of a run as differences from the defaults, and their consequences."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping
from typing import Any

from accerl_lerobot.config.parsing import TYPE, choices_of, decode, encode, section_of
from accerl_lerobot.engine.preflight import lag_limits
from accerl_lerobot.errors import InputError

Flat = dict[str, Any]
"""Dotted field → value."""

ABSENT = "–"
"""Stands where a recipe has no such field."""
PLACES = ("output_dir", "job_name")
"""Where results go says nothing about them."""


def flat(tree: Mapping[str, Any], prefix: str = "") -> Flat:
    """A tree of rooms as dotted fields; an empty mapping is a value."""
    found: Flat = {}
    for key, value in tree.items():
        here = f"{prefix}{key}"
        found |= flat(value, f"{here}.") if isinstance(value, dict) and value else {here: value}
    return found


def differences(config_class: type[Any], tree: dict[str, Any]) -> list[tuple[str, Any, Any]]:
    """Field, value and default, where the two differ.

    Defaults are those of the types that were chosen: GIPO's for a run of GIPO. That it was chosen is a
    difference too, and so is a room that is off unless it is given.
    """
    here = {key: value for key, value in flat(tree).items() if key not in PLACES}
    usual, untouched = (flat(_usual(None, config_class, given)) for given in (tree, {}))
    given = [k for k in untouched if k not in here and any(other.startswith(f"{k}.") for other in here)]
    for key in untouched:
        if key.rpartition(".")[2] == TYPE:
            usual[key] = untouched[key]
    changed = [(k, v, usual.get(k, ABSENT)) for k, v in here.items() if k not in usual or usual[k] != v]
    return [(k, here.get(f"{k}.{TYPE}", "given"), untouched[k]) for k in given] + changed


def apart(trees: list[dict[str, Any]]) -> list[tuple[str, list[Any]]]:
    """Fields in which runs differ, with each run's value; a dash where one does not have it."""
    flats = [flat(tree) for tree in trees]
    keys = dict.fromkeys(key for one in flats for key in one if key not in PLACES)
    rows = [(key, [one.get(key, ABSENT) for one in flats]) for key in keys]
    return [(key, values) for key, values in rows if any(v != values[0] for v in values)]


def lag_bound(config_class: type[Any], tree: dict[str, Any]) -> int | None:
    """The largest lag that a run's recipe allows; None if this version cannot read it, see `unreadable`."""
    return None if unreadable(config_class, tree) else lag_limits(decode(config_class, tree))[0]


def unreadable(config_class: type[Any], tree: dict[str, Any]) -> str:
    """Why this version does not understand a recipe, which another version wrote; empty if it does."""
    try:
        decode(config_class, tree)
    except InputError as error:
        return str(error)
    return ""


def _usual(instance: Any, config_class: type[Any], tree: dict[str, Any]) -> dict[str, Any]:
    """Default of every field where `tree` chooses types; unchecked, as some sections have no default.

    Args:
        instance: whose fields are the defaults; None: those of the class.
        config_class: of the room.
        tree: what was chosen in it.
    """
    usual: dict[str, Any] = {}
    hints = typing.get_type_hints(config_class)
    for field in dataclasses.fields(config_class):
        name, value = field.name, _default(field) if instance is None else getattr(instance, field.name)
        room, given = section_of(hints[name]), tree.get(name)
        if room is None or not isinstance(given, dict):
            usual[name] = encode(value) | _type(value) if dataclasses.is_dataclass(value) else encode(value)
            continue
        kind = choices_of(room).get(str(given.get(TYPE)), room)
        same = value if type(value) is kind else None
        usual[name] = _usual(same, kind, given) | ({TYPE: given[TYPE]} if TYPE in given else {})
    return usual


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return ABSENT if field.default is dataclasses.MISSING else field.default


def _type(room: Any) -> dict[str, Any]:
    """The name under which a config of several was registered."""
    return {TYPE: room.type} if hasattr(room, TYPE) else {}
