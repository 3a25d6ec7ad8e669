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
"""Command lines and recipes into configs, and every mistake in them into one line.

LeRobot's conventions, decoded by LeRobot's own draccus::

    accerl train --config_path=recipes/quickstart.yaml --trainer.lr=1e-5 --env.task=drawer-open-v3

Reading and merging is done here and not by draccus's argument parser, for four reasons: a field of a choice
(``--algorithm.sigma``) needs no second ``--algorithm.type``, unknown keys are named together with what they
resemble, a key that stands twice in a file is refused instead of winning silently, and every verb can read
the recipe of a whole run and take the rooms it needs.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import draccus
import yaml

from accerl_lerobot.errors import InputError
from accerl_lerobot.hints import is_optional, is_union, wanted
from accerl_lerobot.imports import discover

TYPE = "type"
"""The key that picks one config of several, as in ``env.type``."""
REGISTERS = "registers"
"""In a field's metadata: the package that it names registers types of the room that the field is in."""


def parse(config_class: type[Any], arguments: list[str], *, recipe_class: type[Any] | None = None) -> Any:
    """Parses ``--config_path=…`` and overrides into a config.

    Args:
        config_class: what to build.
        arguments: ``--room.field=value`` or ``--room.field value``; a bare first argument is the recipe, or
            bare ones are the entries of the field that `config_class` names in ``BARE``.
        recipe_class: top-level keys of a *file* that this class has and `config_class` has not are ignored,
            so that one recipe serves several verbs.

    Raises:
        InputError: a file, key, type or value is wrong; names the field.
    """
    path, given = read_arguments(arguments, getattr(config_class, "BARE", None))
    tree = {} if path is None else read_recipe(path)
    if recipe_class is not None:
        other = _names(recipe_class) - _names(config_class)
        tree = {key: value for key, value in tree.items() if key not in other}
    _discover(config_class, _merged(tree, given), ())
    return decode(config_class, _overridden(config_class, tree, given))


def decode(config_class: type[Any], tree: dict[str, Any]) -> Any:
    """Builds a config from plain values; imports nothing that they name.

    Raises:
        InputError: a key, type or value is wrong; names the field.
    """
    checked = _checked(config_class, tree, (), config_class)
    try:
        config = draccus.decode(config_class, checked)
    except InputError:
        raise
    except draccus.utils.DraccusException as error:
        raise _as_input_error(error, config_class, checked) from error
    _refuse_nan(config, "")
    return config


def encode(config: Any) -> dict[str, Any]:
    """Plain JSON types, for files and loggers; `decode` makes the same config of them."""
    encoded: dict[str, Any] = draccus.encode(config)
    return encoded


def read_arguments(arguments: list[str], bare: str | None = None) -> tuple[Path | None, dict[str, Any]]:
    """Splits a command line into the recipe's path and a tree of overrides.

    Bare arguments are entries of the list that `bare` names; without it, the one there may be is the recipe.

    Raises:
        InputError: an argument is not of the form ``--room.field=value``, or there are two recipes.
    """
    path: str | None = None
    given: dict[str, Any] = {}
    entries: list[str] = []
    rest = list(arguments)
    while rest:
        argument = rest.pop(0)
        if argument.startswith("--"):
            key, equals, value = argument[2:].partition("=")
            if not equals:
                if not rest or rest[0].startswith("--"):
                    raise InputError(key or "--", "", f"give it a value: --{key}=…")
                value = rest.pop(0)
        elif bare is not None:
            entries.append(argument)
            continue
        elif path is None and not given:
            key, value = "config_path", argument
        else:
            raise InputError("argument", argument, "write --room.field=value")
        if key == "config_path":
            if path is not None:
                raise InputError("config_path", value, f"there is {path} already; give one recipe")
            path = value
        else:
            _set(given, key.split("."), _value(value), key)
    if bare is not None and entries:
        if bare in given:
            raise InputError(bare, given[bare], f"leave out --{bare} or {entries[0]}: name them in one way")
        given[bare] = entries
    return (None if path is None else Path(path).expanduser()), given


def read_recipe(path: Path) -> dict[str, Any]:
    """The tree in a YAML (or JSON) file.

    Raises:
        InputError: no such file, or it is not a mapping in good YAML.
    """
    if not path.is_file():
        near = difflib.get_close_matches(path.name, [p.name for p in path.parent.glob("*.y*ml")], n=3)
        hint = f"did you mean {' or '.join(str(path.parent / name) for name in near)}?" if near else ""
        raise InputError("config_path", str(path), f"no such file; {hint or 'see recipes/'}")
    try:
        tree = yaml.load(path.read_text(), _Loader)
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError("config_path", str(path), f"not good YAML: {_where(error)}") from error
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise InputError("config_path", str(path), "a recipe is a mapping such as 'env: {type: metaworld}'")
    return tree


def room_of(hint: Any) -> type[Any] | None:
    """The config class behind a field's annotation, ``X`` or ``X | None``; None for a plain value."""
    options = [a for a in typing.get_args(hint) if a is not type(None)] if is_union(hint) else [hint]
    if len(options) == 1 and isinstance(options[0], type) and dataclasses.is_dataclass(options[0]):
        return options[0]
    return None


def choices_of(room: type[Any]) -> dict[str, type[Any]]:
    """Registered name → config class, where `room` is the root of a choice; otherwise empty."""
    return dict(room.get_known_choices()) if draccus.ChoiceRegistry in room.__bases__ else {}


class _Loader(yaml.SafeLoader):
    """YAML that refuses a key given twice, of which PyYAML silently keeps the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            if key_node.value in seen and key_node.tag != "tag:yaml.org,2002:merge":
                raise yaml.constructor.ConstructorError(
                    None, None, f"{key_node.value} is given twice", key_node.start_mark
                )
            seen.add(key_node.value)
        return super().construct_mapping(node, deep)


def _where(error: Exception) -> str:
    mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None)
    if mark is None or problem is None:
        return str(error)
    return f"line {mark.line + 1}: {problem}"


def _value(text: str) -> Any:
    """What YAML makes of a value; text that is no YAML is text."""
    if text == "":
        return text
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError:
        return text


def _set(tree: dict[str, Any], keys: list[str], value: Any, dotted: str) -> None:
    for key in keys[:-1]:
        below = tree.get(key)
        if below is None:
            below = tree[key] = {}
        if not isinstance(below, dict):
            raise InputError(dotted, value, f"{key} is set to {below!r} already")
        tree = below
    tree[keys[-1]] = value


def _overridden(config_class: type[Any], tree: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    """`tree` with `given` laid over it.

    Where `given` picks another type than the file's, what the file says about fields that the new type does
    not have is dropped: ``--algorithm.type=ppo`` replaces GIPO together with its ``sigma``.
    """
    merged = _merged(tree, given)
    hints = typing.get_type_hints(config_class)
    for field in dataclasses.fields(config_class):
        room, over, under = room_of(hints[field.name]), given.get(field.name), tree.get(field.name)
        if room is None or not isinstance(over, dict) or not isinstance(under, dict):
            continue
        before = under.get(TYPE, _default_type(field))
        now = over.get(TYPE, before)
        kind = choices_of(room).get(str(now), room)
        if now != before and kind is not room:
            under = {k: v for k, v in under.items() if k in _names(kind)}
        merged[field.name] = _overridden(kind, under, over)
    return merged


def _discover(cls: type[Any], tree: dict[str, Any], path: tuple[str, ...]) -> None:
    """Imports the packages that register types of what is to be decoded, as LeRobot's parser does."""
    for field in dataclasses.fields(cls):
        value, room = tree.get(field.name), room_of(typing.get_type_hints(cls)[field.name])
        if field.metadata.get(REGISTERS) and value is not None:
            discover(str(value), ".".join(path))
        elif room is not None and isinstance(value, dict):
            _discover(room, value, (*path, field.name))


def _merged(tree: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    merged = dict(tree)
    for key, value in given.items():
        under = merged.get(key)
        both = isinstance(under, dict) and isinstance(value, dict)
        merged[key] = _merged(typing.cast(dict[str, Any], under), value) if both else value
    return merged


def _checked(cls: type[Any], tree: dict[str, Any], path: tuple[str, ...], whole: type[Any]) -> dict[str, Any]:
    """`tree` with types filled in where a choice has a default, once all its keys are known to exist."""
    hints, by_name = typing.get_type_hints(cls), {f.name: f for f in dataclasses.fields(cls)}
    out: dict[str, Any] = {}
    for key, value in tree.items():
        here = (*path, str(key))
        if key not in by_name:
            raise InputError(".".join(here), value, _unknown(str(key), path, list(by_name), whole))
        hint, room = hints[key], room_of(hints[key])
        if room is None:
            out[key] = value = _as_list(hint, value)
            _check_leaf(hint, value, here)
        elif value is None:
            if is_optional(hint):
                out[key] = None  # otherwise an empty room: all defaults
        elif not isinstance(value, dict):
            raise InputError(".".join(here), value, f"a room, not a value; use --{here[-1]}.field=value")
        else:
            out[key] = _checked_room(room, value, here, by_name[key], whole)
    return out


def _checked_room(
    room: type[Any], value: dict[str, Any], here: tuple[str, ...], field: Any, whole: type[Any]
) -> dict[str, Any]:
    choices, usual = choices_of(room), _default_type(field)
    if not choices:
        return _checked(room, _merged(_apart(field, room), value), here, whole)
    kind = value.get(TYPE, usual)
    if not isinstance(kind, str) or kind not in choices:
        near = difflib.get_close_matches(str(kind), choices, n=1)
        hint = f"did you mean {near[0]}? Otherwise " if near else ""
        raise InputError(".".join((*here, TYPE)), kind, f"{hint}use one of {', '.join(sorted(choices))}")
    rest = {k: v for k, v in value.items() if k != TYPE}
    if kind == usual:
        rest = _merged(_apart(field, choices[kind]), rest)
    return {TYPE: kind} | _checked(choices[kind], rest, here, whole)


def _apart(field: Any, room: type[Any]) -> dict[str, Any]:
    """What a field's default says of a room where it is not what the room's own class would say.

    draccus takes the class's word for all that is not given, so one field given would change the others.
    """
    default = None if field.default_factory is dataclasses.MISSING else field.default_factory()
    if default is None or default == room():
        return {}
    return encode(default)


def _as_list(hint: Any, value: Any) -> Any:
    """``a,b`` and a lone value as the list that the field holds; draccus would take text letter by letter."""
    lists = [kind for kind in _kinds(hint) if typing.get_origin(kind) in (list, tuple)]
    if len(lists) != 1:
        return value
    if isinstance(value, str):
        entries = [entry.strip() for entry in value.split(",")]
        return entries if typing.get_args(lists[0])[0] is str else [_value(entry) for entry in entries]
    return [value] if isinstance(value, (bool, int, float)) else value


def _kinds(hint: Any) -> set[Any]:
    return set(typing.get_args(hint)) if is_union(hint) else {hint}


def _check_leaf(hint: Any, value: Any, here: tuple[str, ...]) -> None:
    """Refuses what draccus would quietly turn into something else."""
    kinds = _kinds(hint)
    wrong = (
        (value is None and hint is not Any and not is_optional(hint))
        or (isinstance(value, bool) and not kinds & {bool, Any})
        or (isinstance(value, (list, dict)) and kinds <= {str, int, float, bool, type(None)})
    )
    lists = [kind for kind in kinds if typing.get_origin(kind) in (list, tuple)]
    if isinstance(value, list) and len(lists) == 1:
        (entry, *_) = typing.get_args(lists[0])
        wrong = wrong or any(isinstance(v, bool) and entry not in (bool, Any) for v in value)
    if wrong:
        raise InputError(".".join(here), value, f"use {wanted(hint)}")


def dotted_fields(cls: type[Any], path: tuple[str, ...] = ()) -> Iterator[str]:
    """Every field as it is written on the command line, those of all choices included."""
    hints = typing.get_type_hints(cls)
    for field in dataclasses.fields(cls):
        room, here = room_of(hints[field.name]), (*path, field.name)
        if room is None:
            yield ".".join(here)
            continue
        for kind in choices_of(room).values() or (room,):
            yield from dotted_fields(kind, here)


def _unknown(key: str, path: tuple[str, ...], names: list[str], whole: type[Any]) -> str:
    near = [".".join((*path, name)) for name in difflib.get_close_matches(key, names, n=3)]
    everywhere = list(dict.fromkeys(dotted_fields(whole)))
    known = {*near, ".".join((*path, key))}
    near += [f for f in everywhere if f.rpartition(".")[2] == key and f not in known]
    if near:
        return f"no such field; did you mean {' or '.join(near[:4])}?"
    where = f"{'.'.join(path)} has" if path else "there are"
    return f"no such field; {where} {', '.join(names)}"


def _as_input_error(error: BaseException, cls: type[Any], tree: dict[str, Any]) -> InputError:
    """The InputError inside draccus's wrapping, or the innermost of draccus's own errors as one."""
    chain = [error]
    while (cause := chain[-1].__cause__ or chain[-1].__context__) is not None:
        chain.append(cause)
    for link in chain:
        if isinstance(link, InputError):
            return link
    if not (located := [link for link in chain if isinstance(link, draccus.utils.DecodingError)]):
        return InputError("config", type(chain[-1]).__name__, str(chain[-1]))
    hint: Any = cls
    value: Any = tree
    names = []
    for key in located[-1].key_path:
        if not isinstance(value, dict):  # an entry of a list: the list is the field
            break
        room = room_of(hint)
        if room is not None:
            kind = choices_of(room).get(str(value.get(TYPE)), room)
            hint = typing.get_type_hints(kind).get(key, Any)
        else:
            break  # an entry of a mapping
        value = value.get(key)
        names.append(key)
    return InputError(".".join(names), value, f"use {wanted(hint)}")


def _refuse_nan(config: Any, path: str) -> None:
    """Range checks of the form ``x < 0`` let NaN through."""
    for field in dataclasses.fields(config):
        value, here = getattr(config, field.name), f"{path}{field.name}"
        if dataclasses.is_dataclass(value):
            _refuse_nan(value, f"{here}.")
        elif isinstance(value, float) and math.isnan(value):
            raise InputError(here, value, "use a number")


def _names(cls: type[Any]) -> set[str]:
    return {field.name for field in dataclasses.fields(cls)}


def _default_type(field: Any) -> str | None:
    """The type a choice has when nobody names one: that of the field's default."""
    if field.default_factory is dataclasses.MISSING:
        return None
    kind: str | None = getattr(field.default_factory(), TYPE, None)
    return kind
