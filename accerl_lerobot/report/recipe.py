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
"""What a run was asked for: its recipe as differences from the defaults, and what that implies."""

from __future__ import annotations

import typing
from collections.abc import Mapping
from typing import Any

from accerl_lerobot.errors import InputError
from accerl_lerobot.parsing import TYPE, choices_of, decode, encode, room_of
from accerl_lerobot.staleness import lag_limits

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


def defaults(config_class: type[Any], tree: dict[str, Any]) -> Flat:
    """What every field is when only the types of `tree` are chosen: GIPO's for a run of GIPO.

    Raises:
        InputError: the types do not go together, or this version does not know one.
    """
    return flat(encode(decode(config_class, _types(config_class, tree))))


def differences(config_class: type[Any], tree: dict[str, Any]) -> list[tuple[str, Any, Any]]:
    """Field, value and default, where the two differ; types that were chosen too.

    Raises:
        InputError: as `defaults`.
    """
    usual, chosen = defaults(config_class, tree), flat(encode(decode(config_class, {})))
    usual |= {key: chosen[key] for key in chosen if key.rpartition(".")[2] == TYPE}
    here = {key: value for key, value in flat(tree).items() if key not in PLACES}
    return [(k, v, usual.get(k, ABSENT)) for k, v in here.items() if k not in usual or usual[k] != v]


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


def _types(config_class: type[Any], tree: dict[str, Any]) -> dict[str, Any]:
    """`tree` with nothing in it but which config of several was chosen, at any depth."""
    kept: dict[str, Any] = {}
    for name, hint in typing.get_type_hints(config_class).items():
        room, value = room_of(hint), tree.get(name)
        if room is None or not isinstance(value, dict):
            continue
        kind = choices_of(room).get(str(value.get(TYPE)))
        below = _types(kind or room, value) | ({TYPE: value[TYPE]} if kind else {})
        if below:
            kept[name] = below
    return kept
