# SPDX-License-Identifier: Apache-2.0
"""Command lines and recipes into configs, and every mistake in them into one line.

LeRobot's conventions, decoded by LeRobot's own draccus. Reading and merging is done here and not by draccus's
argument parser, for four reasons: a field of a choice (``--algorithm.sigma``) needs no second
``--algorithm.type``, unknown keys are named together with what they resemble, a key that stands twice in a
file is refused instead of winning silently, and every verb can read the recipe of a whole run and take the
sections it needs.
"""

from __future__ import annotations

import dataclasses
import difflib
import gc
import importlib
import importlib.metadata
import json
import os
import re
import shlex
import sys
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import draccus
import yaml

from accerl_lerobot.checkpoint.layout import CONFIG
from accerl_lerobot.checkpoint.safety import brief
from accerl_lerobot.config.lerobot import FLAGS, hint_for
from accerl_lerobot.config.ranges import (
    annotations_of,
    check,
    default_of,
    fits,
    is_optional,
    is_union,
    unmarked,
    wanted,
)
from accerl_lerobot.errors import InputError, expanded

DISCOVER = "discover_packages_path"
"""LeRobot's name for the field that names a package whose import registers new types."""
PLUGINS = ("lerobot_robot_", "lerobot_camera_", "lerobot_teleoperator_", "lerobot_policy_", "lerobot_env_")
"""Beginnings of the names of installed packages that LeRobot imports to have their types registered."""


def imported(path: str) -> Any:
    """Object behind a table's ``module:name``."""
    module, _, name = path.partition(":")
    collects, new = gc.isenabled(), module not in sys.modules
    gc.disable()  # LeRobot's modules leave little garbage, and looking for it is a fifth of their import
    try:
        return getattr(importlib.import_module(module), name)
    finally:
        if new and os.environ.get("ACCERL_ONE_POLICY"):  # a process of our own, see `policies.deferred`
            gc.freeze()  # or the next collection would look at all of them
        if collects:
            gc.enable()


def discover(package: str | None, section: str = "") -> None:
    """Imports a package that registers types; None does nothing. `section` is that of the field."""
    if package is None:
        return
    field = f"{section}.{DISCOVER}" if section else DISCOVER
    if not all(part.isidentifier() for part in package.split(".")):
        raise InputError(field, package, "use the name of a package as Python imports it, e.g. my_models")
    try:
        importlib.import_module(package)
    except (Exception, SystemExit) as error:  # it is somebody's code, which may do anything
        why = f"cannot be imported ({type(error).__name__}: {brief(error)})"
        if isinstance(error, ModuleNotFoundError) and error.name == package.partition(".")[0]:
            why += "; install it, or name the folder that it is in: PYTHONPATH=FOLDER accerl …"
        raise InputError(field, package, why) from error


def import_plugins(*prefixes: str) -> dict[str, str]:
    """Imports the installed packages whose names begin so; words on each one that cannot be imported.

    LeRobot's `register_third_party_plugins` logs the traceback of each that is broken, wanted or not.
    """
    broken: dict[str, str] = {}
    for distribution in importlib.metadata.distributions():
        package = re.sub(r"[-.]", "_", distribution.metadata["Name"] or "").lower()
        if package.startswith(prefixes):
            try:
                importlib.import_module(package)
            except (Exception, SystemExit) as error:  # it is somebody's code, which may do anything
                broken[package] = not_imported(package, error)
    return broken


def not_imported(package: str, error: BaseException) -> str:
    return f"{package} is installed and cannot be imported ({type(error).__name__}: {brief(error)})"


LARGEST_RECIPE = 2**18  # bytes of a recipe at most
LEROBOTS_FILES = ("config.json", "train_config.json")  # of a policy's folder, taken for recipes by mistake
RECIPES = "recipes"
TYPE = "type"  # the key that picks one config of several, as in ``env.type``
LONGEST_KEY = 80
REGISTERS = "registers"
"""In a field's metadata: the package that it names registers types of the section that the field is in."""
PREPARES = "prepares"
"""In the same field's metadata: a function to call before the package is imported."""
CONSENT = {"trust_remote_code", "hub_path", DISCOVER, "extra_args", "address"}
"""Names of the fields that let somebody's code run with the user's rights: from the Hub, from a package, by
further arguments of ``lerobot-train``, or from a Ray cluster, which exchanges pickles with the run. Only the
command line can set them. A recipe may have come with the very code that it would allow."""
UNSET: tuple[Any, ...] = (None, False, "", [], {})


def parse(config_class: type[Any], arguments: list[str], *, recipe_class: type[Any] | None = None) -> Any:
    """Parses ``--config_path=…`` and overrides into a config.

    Args:
        config_class: what to build.
        arguments: ``--section.field=value`` or ``--section.field value``; a bare first one is the recipe, or
            bare ones are the entries of the field that `config_class` names in ``BARE``.
        recipe_class: top-level keys of a *file* that this class has and `config_class` has not are ignored,
            and ``output_dir`` is, so that one recipe serves several verbs.
    """
    path, given = read_arguments(arguments, getattr(config_class, "BARE", None))
    tree = {} if path is None else read_recipe(path)
    if recipe_class is not None:
        # A run's own config is a recipe too, and its folder is taken.
        other = _names(recipe_class) - _names(config_class) | {"output_dir"}
        # A section that has types in a run and none here is another one of the same name.
        kinds = _sections(recipe_class), _sections(config_class)
        other |= {
            name
            for name in kinds[0].keys() & kinds[1].keys()
            if kinds[0][name] is not kinds[1][name] and TYPE in (tree.get(name) or {})
        }
        tree = {key: value for key, value in tree.items() if key not in other}
    register_types(config_class, given)
    merged = _overridden(config_class, tree, given)
    if from_file := consents(merged, given):
        flags = consent_flags(from_file)
        hint = f"a file cannot allow this, only the command line can: if you trust it, add {flags}"
        raise InputError(next(iter(from_file)), next(iter(from_file.values())), hint)
    return decode(config_class, merged)


def consents(tree: Any, given: Any = None) -> dict[str, Any]:
    """Dotted field → value, of the fields in `CONSENT` that a tree, read from a file, sets at any depth.

    Fields that the command line sets as well, in `given`, are left out.
    """
    asked = {name for name, _ in _leaves(given)}
    return {
        name: value
        for name, value in _leaves(tree)
        if name.rpartition(".")[2] in CONSENT and value not in UNSET and name not in asked
    }


def consent_flags(consented: dict[str, Any]) -> str:
    """Arguments of the command line that give these `consents`."""
    return " ".join(shlex.quote(f"--{name}={as_text(value)}") for name, value in consented.items())


def _leaves(tree: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted name and value of everything in a tree that is not looked into."""
    entries = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in entries:
        name = f"{path}{key}"
        if isinstance(value, (dict, list)) and name.rpartition(".")[2] not in CONSENT:
            yield from _leaves(value, f"{name}.")
        else:
            yield name, value


def decode(config_class: type[Any], tree: dict[str, Any]) -> Any:
    """Builds a config from plain values; imports nothing that they name."""
    return _decoded(config_class, tree, (), config_class)


def encode(config: Any) -> dict[str, Any]:
    """Plain JSON types, for files and loggers; `decode` makes the same config of them."""
    encoded: dict[str, Any] = draccus.encode(config)
    return encoded


def read_arguments(arguments: list[str], bare: str | None = None) -> tuple[Path | None, dict[str, Any]]:
    """Splits a command line into the recipe's path and a tree of overrides.

    Bare arguments are entries of the list that `bare` names; without it, the one there may be is the recipe.
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
            raise InputError("argument", argument, "write --section.field=value")
        if key == "config_path":
            if path is not None:
                raise InputError("config_path", value, f"there is {path} already; give one recipe")
            path = value
        else:
            if not all(names := key.split(".")):
                raise InputError("argument", argument, "write --section.field=value")
            _set(given, names, _value(value), key)
    if bare is not None and entries:
        if bare in given:
            raise InputError(bare, given[bare], f"leave out --{bare} or {entries[0]}: name them in one way")
        given[bare] = entries
    return (None if path is None else _recipe_path(expanded(path, "config_path"))), given


def _recipe_path(path: Path) -> Path:
    """A recipe, that of a run for its folder, or that of a checkpoint for its folder or its policy's."""
    places = (path / CONFIG, path.parent / CONFIG)
    return next((place for place in places if place.is_file()), path) if path.is_dir() else path


def shipped_recipes() -> dict[str, Path]:
    """Recipes of this package by name: beside its code in a wheel, in ``recipes/`` of the repository."""
    package = Path(__file__).parents[1]
    folder = next((f for f in (package / RECIPES, package.parent / RECIPES) if f.is_dir()), None)
    return {} if folder is None else {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def read_recipe(path: Path) -> dict[str, Any]:
    """The tree in a YAML (or JSON) file, or in one of `shipped_recipes`."""
    if not path.is_file():
        shipped = shipped_recipes()
        bare = path.stem if str(path.parent) == RECIPES else str(path)  # as in the repository
        path = shipped.get(bare, path)
    if path.is_dir():
        hint = f"a folder without {CONFIG}, so no run or checkpoint; name a recipe"
        raise InputError("config_path", str(path), hint)
    if not path.is_file():
        names = [*(str(p) for p in path.parent.glob("*.y*ml")), *shipped]
        near = difflib.get_close_matches(str(path), names, n=3)
        hint = f"did you mean {' or '.join(near)}" if near else f"this package has {', '.join(shipped)}"
        raise InputError("config_path", str(path), f"no such file; {hint}")
    if path.name in LEROBOTS_FILES:
        hint = (
            "LeRobot wrote it; resume a run with RUN/config.yaml, and name a policy's folder by policy.path"
        )
        raise InputError("config_path", str(path), hint)
    if (size := path.stat().st_size) > LARGEST_RECIPE:
        raise InputError("config_path", str(path), f"{size:,} bytes; a recipe has a few thousand")
    try:
        tree = _load_yaml(path.read_text())
    except (yaml.YAMLError, ValueError) as error:
        raise InputError("config_path", str(path), f"not good YAML: {_where(error)}") from error
    except OSError as error:
        raise InputError("config_path", str(path), f"cannot be read: {error.strerror}") from error
    if not isinstance(tree, dict | None):
        raise InputError("config_path", str(path), "a recipe is a mapping such as 'env: {type: metaworld}'")
    return tree or {}


def section_of(annotation: Any) -> type[Any] | None:
    """The config class behind a field's annotation, ``X`` or ``X | None``; None for a plain value."""
    options = (
        [a for a in typing.get_args(annotation) if a is not type(None)]
        if is_union(annotation)
        else [annotation]
    )
    if len(options) == 1 and isinstance(options[0], type) and dataclasses.is_dataclass(options[0]):
        return options[0]
    return None


def choices_of(section: type[Any]) -> dict[str, type[Any]]:
    """Registered name → config class, where `section` is the root of a choice; otherwise empty."""
    return dict(section.get_known_choices()) if draccus.ChoiceRegistry in section.__bases__ else {}


class _Loader(yaml.SafeLoader):
    """YAML without aliases, which let a small file stand for billions of values, and with unique keys."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            problem = "an alias; write the value itself"
            raise yaml.constructor.ConstructorError(None, None, problem, self.peek_event().start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(None, None, "a key is not text", key_node.start_mark)
            if key_node.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"{key_node.value} is given twice", key_node.start_mark
                )
            seen.add(key_node.value)
        return super().construct_mapping(node, deep)


def _load_yaml(text: str) -> Any:
    try:
        return yaml.load(text, _Loader)
    except yaml.YAMLError:
        raise
    except Exception as error:  # of a number such as 0x_, a date such as 2024-13-45, or too many levels
        raise yaml.YAMLError(f"{type(error).__name__}: {error}") from error


def as_text(value: Any) -> str:
    """A value as it can be typed on a command line; control characters are escaped."""
    return value if isinstance(value, str) and value.isprintable() else json.dumps(value, default=str)


def _where(error: Exception) -> str:
    mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None)
    return str(error) if mark is None or problem is None else f"line {mark.line + 1}: {problem}"


def _value(text: str) -> Any:
    """A value as YAML reads it; text that is not YAML is text."""
    try:
        return _load_yaml(text) if text else text
    except yaml.YAMLError:
        return text


def _set(tree: dict[str, Any], keys: list[str], value: Any, dotted: str) -> None:
    for key in keys[:-1]:
        below = tree.setdefault(key, {})
        if not isinstance(below, dict):
            raise InputError(dotted, value, f"{key} is set to {below!r} already")
        tree = below
    if keys[-1] in tree:
        raise InputError(dotted, value, f"it is set to {tree[keys[-1]]!r} already; give it once")
    tree[keys[-1]] = value


def _overridden(config_class: type[Any], tree: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    """`tree` with `given` laid over it.

    Where `given` picks another type than the file's, what the file says about fields that the new type does
    not have is dropped: ``--algorithm.type=ppo`` replaces GIPO together with its ``sigma``. Defaults of the
    former type that the new one does not take are dropped too: a run's config holds them, chosen or not.
    """
    merged = _merged(tree, given)
    annotations = annotations_of(config_class)
    for field in dataclasses.fields(config_class):
        section, over, under = (
            section_of(annotations[field.name]),
            given.get(field.name),
            tree.get(field.name),
        )
        if section is None or not isinstance(over, dict) or not isinstance(under, dict):
            continue
        before = under.get(TYPE, _default_type(field))
        now = over.get(TYPE, before)
        kinds = choices_of(section)
        kind = kinds.get(str(now), section)
        if now != before and kind is not section:
            usual = encoded_defaults(kinds.get(str(before), section))
            taken = annotations_of(kind)
            under = {
                name: value
                for name, value in under.items()
                if name in taken and (value != usual.get(name) or fits(taken[name], value))
            }
        merged[field.name] = _overridden(kind, under, over)
    return merged


def encoded_defaults(cls: type[Any]) -> dict[str, Any]:
    """Field → default, as a file has it."""
    return {field.name: draccus.encode(default_of(field)) for field in dataclasses.fields(cls)}


def register_types(cls: type[Any], tree: dict[str, Any], path: tuple[str, ...] = ()) -> None:
    """Imports the packages that register types of what is to be decoded, as LeRobot's parser does."""
    for field in dataclasses.fields(cls):
        value, section = tree.get(field.name), section_of(annotations_of(cls)[field.name])
        if field.metadata.get(REGISTERS) and value is not None:
            field.metadata.get(PREPARES, bool)()
            discover(str(value), ".".join(path))
        elif section is not None and isinstance(value, dict):
            register_types(section, value, (*path, field.name))


def _merged(tree: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    merged = tree | given
    for key in tree.keys() & given.keys():
        if isinstance(tree[key], dict) and isinstance(given[key], dict):
            merged[key] = _merged(tree[key], given[key])
    return merged


def _decoded(cls: type[Any], tree: dict[str, Any], path: tuple[str, ...], whole: type[Any]) -> Any:
    """A config section, once all keys in `tree` are known to exist and all values fit."""
    annotations, by_name = annotations_of(cls), {field.name: field for field in dataclasses.fields(cls)}
    values = {}
    for key, value in tree.items():
        here = (*path, str(key))
        if key not in by_name:
            raise _unknown(str(key), value, path, list(by_name), whole)
        section = section_of(annotations[key])
        if section is None:
            values[key] = _leaf(annotations[key], value, ".".join(here))
        elif value is None and is_optional(annotations[key]):
            values[key] = None
        elif not isinstance(value, dict | None):
            raise InputError(".".join(here), value, f"a config section; use --{here[-1]}.field=value")
        else:
            values[key] = _section(section, value or {}, here, by_name[key], whole)
    for field in by_name.values():
        if field.name not in values and field.default is field.default_factory is dataclasses.MISSING:
            raise InputError(".".join((*path, field.name)), None, f"use {wanted(annotations[field.name])}")
    try:
        return cls(**values)
    except InputError as error:
        # A section that stands in several places, such as a replay, has one name for itself.
        usual, actual = (f"{name}." for name in (getattr(cls, "SECTION", ""), ".".join(path)))
        if usual in (".", actual) or not error.field.startswith(usual):
            raise
        moved = f"{actual}{error.field.removeprefix(usual)}"
        raise InputError(moved, error.value, error.hint.replace(usual, actual)) from error
    except (TypeError, ValueError) as error:  # of a class that is not ours
        raise InputError(".".join(path) or "config", type(error).__name__, str(error)) from error


def _section(
    section: type[Any], value: dict[str, Any], here: tuple[str, ...], field: Any, whole: type[Any]
) -> Any:
    choices, usual = choices_of(section), _default_type(field)
    if not choices:
        return _decoded(section, _merged(_apart(field, section), value), here, whole)
    kind = value.get(TYPE, usual)
    if not isinstance(kind, str) or kind not in choices:
        near = difflib.get_close_matches(str(kind), choices, n=1)
        hint = f"did you mean {near[0]}? Otherwise " if near else ""
        hint += f"use one of {', '.join(sorted(choices))}"
        if here == ("env",):
            hint += f"; one of LeRobot's own is --env.type=lerobot --env.name={kind}"
        raise InputError(".".join((*here, TYPE)), kind, hint)
    rest = {k: v for k, v in value.items() if k != TYPE}
    if kind == usual:
        rest = _merged(_apart(field, choices[kind]), rest)
    return _decoded(choices[kind], rest, here, whole)


def _leaf(annotation: Any, value: Any, field: str) -> Any:
    """A plain value, decoded by draccus unless draccus would quietly turn it into something else.

    ``a,b`` and a lone value are the list that the field holds.
    """
    plain = unmarked(annotation)
    kinds = set(typing.get_args(plain)) if is_union(plain) else {plain}
    entries = [typing.get_args(kind)[0] for kind in kinds if typing.get_origin(kind) in (list, tuple)]
    entry = entries[0] if len(entries) == 1 else None
    if entry is not None and isinstance(value, str):  # draccus would take text letter by letter
        parts = [part.strip() for part in value.split(",")]
        value = parts if entry is str else [_value(part) for part in parts]
    elif entry is not None and isinstance(value, (bool, int, float)):
        value = [value]
    wrong = (
        (value is None and plain is not Any and not is_optional(plain))
        or (isinstance(value, bool) and not kinds & {bool, Any})
        or (isinstance(value, (list, dict)) and kinds <= {str, int, float, bool, type(None)})
    )
    if isinstance(value, list) and entry not in (None, bool, Any):
        wrong |= any(isinstance(v, bool) for v in value)
    try:
        decoded = None if wrong else draccus.decode(plain, value)
    except Exception:  # whatever draccus raises, the value does not fit
        wrong = True
    if wrong:
        raise InputError(field, value, f"use {wanted(annotation)}")
    check(annotation, decoded, field)
    return decoded


def _apart(field: Any, section: type[Any]) -> dict[str, Any]:
    """Differences of a field's default of a section from the section's own class.

    draccus takes the class's word for all that is not given, so one field given would change the others.
    """
    default = None if field.default_factory is dataclasses.MISSING else field.default_factory()
    return {} if default is None or default == section() else encode(default)


def dotted_fields(cls: type[Any]) -> Iterator[str]:
    """Every field as it is written on the command line, those of all choices included."""
    return (name for name, _ in _fields(cls))


def _fields(cls: type[Any], path: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Dotted name and annotation of every field."""
    annotations = annotations_of(cls)
    for field in dataclasses.fields(cls):
        section, here = section_of(annotations[field.name]), (*path, field.name)
        if section is None:
            yield ".".join(here), annotations[field.name]
            continue
        for kind in choices_of(section).values() or (section,):
            yield from _fields(kind, here)


def _unknown(key: str, value: Any, path: tuple[str, ...], names: list[str], whole: type[Any]) -> InputError:
    """The error for a field that a config does not have: what it resembles, or where it belongs."""
    if len(key) > LONGEST_KEY:
        return InputError(key[:LONGEST_KEY], value, "no such field")
    here = leaf_name = ".".join((*path, key))
    leaf = value
    while isinstance(leaf, dict) and leaf:
        below, leaf = next(iter(leaf.items()))
        leaf_name += f".{below}"
    annotations = dict(_fields(whole))
    near = [".".join((*path, name)) for name in difflib.get_close_matches(key, names, n=3)]
    # Only what is no misspelling is of a section of LeRobot's.
    lerobot_name = leaf_name in FLAGS or here in FLAGS or not near
    if lerobot_name and (hint := hint_for(leaf_name, leaf, annotations.keys())):
        return InputError(leaf_name, leaf, f"the name is LeRobot's; {hint}")
    # The same name elsewhere, where the value would fit or no section was named.
    near += [
        name
        for name, kind in annotations.items()
        if name.rpartition(".")[2] == key and name != here and (not path or _takes(kind, value))
    ]
    where = f"{'.'.join(path)} has" if path else "there are"
    hint = f"did you mean {' or '.join(dict.fromkeys(near[:4]))}?" if near else f"{where} {', '.join(names)}"
    return InputError(here, value, f"no such field; {hint}")


def _takes(annotation: Any, value: Any) -> bool:
    try:
        _leaf(annotation, value, "")
    except InputError:
        return False
    return True


def _sections(cls: type[Any]) -> dict[str, type[Any]]:
    """Field → class, of the fields that are sections."""
    found = {name: section_of(annotation) for name, annotation in annotations_of(cls).items()}
    return {name: section for name, section in found.items() if section is not None}


def _names(cls: type[Any]) -> set[str]:
    return {field.name for field in dataclasses.fields(cls)}


def _default_type(field: Any) -> str | None:
    """The type a choice has when nobody names one: that of the field's default."""
    if field.default_factory is dataclasses.MISSING:
        return None
    kind: str | None = getattr(field.default_factory(), TYPE, None)
    return kind
