# SPDX-License-Identifier: Apache-2.0
"""Command lines and recipes into configs, and every mistake in them into one line.

The conventions are LeRobot's: dotted flags, sections, and a ``type`` that chooses one config of several.
Reading and merging is done here and not by draccus's argument parser, for four reasons. A field of a choice
(``--algorithm.sigma``) needs no second ``--algorithm.type``. An unknown key is named together with what it
resembles. A key that stands twice in a file is refused. Every verb can read the recipe of a whole run and
take the sections it needs.
"""

from __future__ import annotations

import dataclasses
import datetime
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
from typing import Annotated, Any

import draccus
import yaml

from accerl_lerobot.checkpoint.layout import CONFIG
from accerl_lerobot.checkpoint.safety import brief
from accerl_lerobot.config.lerobot import FLAGS, hint_for
from accerl_lerobot.config.ranges import annotations_of, defaults_of, fits, is_optional, is_union, wanted
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
    try:
        importlib.import_module(package)
    except (Exception, SystemExit) as error:  # it is somebody's code, which may do anything
        field = f"{section}.{DISCOVER}" if section else DISCOVER
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
SYNTAX = "write --section.field=value"
PLAIN = (int, float, str, bool, type(None), dict, list, Any)
"""Kinds of values that YAML makes."""


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
        tree = _for_verb(tree, config_class, recipe_class)
    register_types(config_class, given)
    merged = _overridden(config_class, tree, given)
    from_file = consents(merged, given)
    for name, value in from_file.items():
        flags = consent_flags(from_file)
        hint = f"a file cannot allow this, only the command line can: if you trust it, add {flags}"
        raise InputError(name, value, hint)
    return decode(config_class, merged)


def _for_verb(tree: dict[str, Any], config_class: type[Any], recipe_class: type[Any]) -> dict[str, Any]:
    """The part of a run's recipe that is for the config of another verb."""
    known, taken, left = annotations_of(recipe_class), annotations_of(config_class), {}
    for key, value in tree.items():
        if key in known and (key not in taken or key == "output_dir"):
            continue  # a run's own config is a recipe too, and its folder is taken
        chosen = isinstance(value, dict) and TYPE in value
        if chosen and key in known and section_of(known[key]) is not section_of(taken[key]):
            continue  # a section that has types in a run and none here is another one of the same name
        left[key] = value
    return left


def consents(tree: Any, given: Any = None) -> dict[str, Any]:
    """Dotted field → value, of the fields in `CONSENT` that a tree, read from a file, sets at any depth.

    Fields that the command line sets as well, in `given`, are left out.
    """
    asked = {name for name, _ in _leaves(given)}
    found = {}
    for name, value in _leaves(tree):
        if name.rpartition(".")[2] in CONSENT and value not in UNSET and name not in asked:
            found[name] = value
    return found


def consent_flags(consented: dict[str, Any]) -> str:
    """Arguments of the command line that give these `consents`."""
    return " ".join(shlex.quote(f"--{name}={as_text(value)}") for name, value in consented.items())


def _leaves(tree: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted name and value of everything in a tree that is not looked into."""
    if isinstance(tree, list):
        tree = dict(enumerate(tree))
    for key, value in tree.items() if isinstance(tree, dict) else ():
        name = f"{path}{key}"  # a key may have dots itself
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
    paths: list[str] = []
    given: dict[str, Any] = {}
    entries: list[str] = []
    rest = list(arguments)
    while rest:
        argument = rest.pop(0)
        if not argument.startswith("--"):
            if bare is None and (paths or given):
                raise InputError("argument", argument, SYNTAX)
            (paths if bare is None else entries).append(argument)
            continue
        key, equals, value = argument[2:].partition("=")
        if not equals:
            if not rest or rest[0].startswith("--"):
                raise InputError(key or "--", "", f"give it a value: --{key}=…")
            value = rest.pop(0)
        if key == "config_path":
            paths.append(value)
        elif all(key.split(".")):
            _set(given, key, _value(value))
        else:
            raise InputError("argument", argument, SYNTAX)
    if len(paths) > 1:
        raise InputError("config_path", paths[1], f"there is {paths[0]} already; give one recipe")
    if bare is not None and entries:
        if bare in given:
            raise InputError(bare, given[bare], f"leave out --{bare} or {entries[0]}: name them in one way")
        given[bare] = entries
    return (_recipe_path(expanded(paths[0], "config_path")) if paths else None), given


def _recipe_path(path: Path) -> Path:
    """A recipe, that of a run for its folder, or that of a checkpoint for its folder or its policy's."""
    for place in (path / CONFIG, path.parent / CONFIG):
        if path.is_dir() and place.is_file():
            return place
    return path


def shipped_recipes() -> dict[str, Path]:
    """Recipes of this package by name: beside its code in a wheel, in ``recipes/`` of the repository."""
    package = Path(__file__).parents[1]
    for folder in (package / RECIPES, package.parent / RECIPES):
        if folder.is_dir():
            return {path.stem: path for path in sorted(folder.glob("*.yaml"))}
    return {}


def read_recipe(path: Path) -> dict[str, Any]:
    """The tree in a YAML (or JSON) file, or in one of `shipped_recipes`."""
    shipped = shipped_recipes()
    if not path.is_file():
        bare = path.stem if str(path.parent) == RECIPES else str(path)  # as in the repository
        path = shipped.get(bare, path)
    if path.is_dir():
        hint = f"a folder without {CONFIG}, so no run or checkpoint; name a recipe"
        raise InputError("config_path", str(path), hint)
    if not path.is_file():
        names = [*map(str, path.parent.glob("*.y*ml")), *shipped]
        near = difflib.get_close_matches(str(path), names, n=3)
        hint = f"did you mean {' or '.join(near)}" if near else f"this package has {', '.join(shipped)}"
        raise InputError("config_path", str(path), f"no such file; {hint}")
    if path.name in LEROBOTS_FILES:
        hint = (
            "LeRobot wrote it; resume a run with RUN/config.yaml, and name a policy's folder by policy.path"
        )
        raise InputError("config_path", str(path), hint)
    try:
        tree = _load_yaml(path.read_text())
    except (yaml.YAMLError, ValueError) as error:
        raise InputError("config_path", str(path), f"not good YAML: {_where(error)}") from error
    if not isinstance(tree, dict | None):
        raise InputError("config_path", str(path), "a recipe is a mapping such as 'env: {type: metaworld}'")
    return tree or {}


def section_of(annotation: Any) -> type[Any] | None:
    """The config class behind a field's annotation, ``X`` or ``X | None``; None for a plain value."""
    options = set(typing.get_args(annotation)) if is_union(annotation) else {annotation}
    options -= {type(None)}
    section = options.pop() if len(options) == 1 else None
    return section if isinstance(section, type) and dataclasses.is_dataclass(section) else None


def sections_of(cls: type[Any]) -> dict[str, type[Any]]:
    """Field → config class, of the fields that are sections."""
    found = {name: section_of(annotation) for name, annotation in annotations_of(cls).items()}
    return {name: section for name, section in found.items() if section is not None}


def choices_of(section: type[Any]) -> dict[str, type[Any]]:
    """Registered name → config class, where `section` is the root of a choice; otherwise empty."""
    return dict(section.get_known_choices()) if draccus.ChoiceRegistry in section.__bases__ else {}


class _Loader(yaml.SafeLoader):
    """YAML without aliases, which let a small file stand for billions of values, and with unique keys."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise _problem("an alias; write the value itself", self.peek_event().start_mark)
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value:
            if key.value in seen:
                raise _problem(f"{key.value} is given twice", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def _problem(words: str, mark: Any) -> yaml.YAMLError:
    return yaml.constructor.ConstructorError(None, None, words, mark)


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
    """The line and the problem of an error of YAML's, or its words."""
    mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None)
    return str(error) if mark is None or problem is None else f"line {mark.line + 1}: {problem}"


def _value(text: str) -> Any:
    """A value as YAML reads it; text that is not YAML is text."""
    try:
        return _load_yaml(text) if text else text
    except yaml.YAMLError:
        return text


def _set(tree: dict[str, Any], dotted: str, value: Any) -> None:
    """Adds a value of the command line to a tree, once."""
    *sections, name = dotted.split(".")
    for section in sections:
        below = tree.setdefault(section, {})
        if not isinstance(below, dict):
            raise InputError(dotted, value, f"{section} is set to {below!r} already")
        tree = below
    if name in tree:
        raise InputError(dotted, value, f"it is set to {tree[name]!r} already; give it once")
    tree[name] = value


def _overridden(config_class: type[Any], tree: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    """`tree` with `given` laid over it.

    Where `given` picks another type than the file's, what the file says about fields that the new type does
    not have is dropped: ``--algorithm.type=ppo`` replaces GIPO together with its ``sigma``. Defaults of the
    former type that the new one does not take are dropped too: a run's config holds them, chosen or not.
    """
    merged = _merged(tree, given)
    defaults = defaults_of(config_class)
    for name, section in sections_of(config_class).items():
        over, under = given.get(name), tree.get(name)
        if not isinstance(over, dict) or not isinstance(under, dict):
            continue
        former = under.get(TYPE, getattr(defaults[name], TYPE, None))
        chosen = over.get(TYPE, former)
        choices = choices_of(section)
        kind = choices.get(str(chosen), section)
        if chosen != former and kind is not section:
            under = _taken(under, choices.get(str(former), section), kind)
        merged[name] = _overridden(kind, under, over)
    return merged


def _taken(tree: dict[str, Any], former: type[Any], kind: type[Any]) -> dict[str, Any]:
    """The fields of a section that a config of another type takes over."""
    usual, annotations, kept = encoded_defaults(former), annotations_of(kind), {}
    for name, value in tree.items():
        if name in annotations and (value != usual.get(name) or fits(annotations[name], value)):
            kept[name] = value
    return kept


def encoded_defaults(cls: type[Any]) -> dict[str, Any]:
    """Field → default, as a file has it."""
    return {name: draccus.encode(default) for name, default in defaults_of(cls).items()}


def register_types(cls: type[Any], tree: dict[str, Any], path: tuple[str, ...] = ()) -> None:
    """Imports the packages that register types of what is to be decoded, as LeRobot's parser does."""
    for field in dataclasses.fields(cls):
        if field.metadata.get(REGISTERS) and tree.get(field.name) is not None:
            field.metadata.get(PREPARES, bool)()
            discover(str(tree[field.name]), ".".join(path))
    for name, section in sections_of(cls).items():
        if isinstance(tree.get(name), dict):
            register_types(section, tree[name], (*path, name))


def _merged(tree: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    merged = tree | given
    for key in tree.keys() & given.keys():
        if isinstance(tree[key], dict) and isinstance(given[key], dict):
            merged[key] = _merged(tree[key], given[key])
    return merged


def _decoded(cls: type[Any], tree: dict[str, Any], path: tuple[str, ...], whole: type[Any]) -> Any:
    """A config section, once all keys in `tree` are known to exist and all values fit.

    `path` is where the section stands in the config `whole`.
    """
    annotations, sections, defaults = annotations_of(cls), sections_of(cls), defaults_of(cls)
    values = {}
    for key, value in tree.items():
        place = (*path, str(key))
        if key not in annotations:
            raise _unknown(str(key), value, path, list(annotations), whole)
        if key not in sections:
            values[key] = _leaf(annotations[key], value, ".".join(place))
        elif value is None and is_optional(annotations[key]):
            values[key] = None
        elif isinstance(value, dict | None):
            values[key] = _section(sections[key], value or {}, defaults[key], place, whole)
        else:
            raise InputError(".".join(place), value, f"a config section; use --{key}.field=value")
    try:
        return cls(**values)
    except InputError as error:
        # A section that stands in several places, such as a replay, has one name for itself.
        usual, actual = f"{getattr(cls, 'SECTION', '')}.", f"{'.'.join(path)}."
        if usual in (".", actual) or not error.field.startswith(usual):
            raise
        field_name = actual + error.field.removeprefix(usual)
        raise InputError(field_name, error.value, error.hint.replace(usual, actual)) from error
    except (TypeError, ValueError) as error:  # of a class that is not ours
        raise InputError(".".join(path) or "config", type(error).__name__, str(error)) from error


def _section(
    section: type[Any], value: dict[str, Any], default: Any, path: tuple[str, ...], whole: type[Any]
) -> Any:
    """A section of the type that `value` names, or of its default's; fields not given are its default's."""
    choices, value = choices_of(section), dict(value)
    if choices:
        kind = value.pop(TYPE, getattr(default, TYPE, None))
        if not isinstance(kind, str) or kind not in choices:
            raise _no_choice(kind, choices, path)
        section = choices[kind]
    if type(default) is section:
        value = _merged(_changed_defaults(default), value)
    return _decoded(section, value, path, whole)


def _changed_defaults(default: Any) -> dict[str, Any]:
    """Fields in which the default of a section differs from its class's own."""
    usual = defaults_of(type(default))
    changed = {name for name, value in usual.items() if getattr(default, name) != value}
    return {name: value for name, value in encode(default).items() if name in changed}


def _no_choice(kind: Any, choices: dict[str, type[Any]], path: tuple[str, ...]) -> InputError:
    near = difflib.get_close_matches(str(kind), choices, n=1)
    hint = f"did you mean {near[0]}? Otherwise " if near else ""
    hint += f"use one of {', '.join(sorted(choices))}"
    if path == ("env",):
        hint += f"; one of LeRobot's own is --env.type=lerobot --env.name={kind}"
    return InputError(".".join((*path, TYPE)), kind, hint)


def _leaf(annotation: Any, value: Any, field: str) -> Any:
    """A plain value, refused under the name `field` if it does not fit."""
    made = _converted(annotation, value)
    if not fits(annotation, made):
        raise InputError(field, value, f"use {wanted(annotation)}")
    return made


def _converted(kind: Any, value: Any) -> Any:
    """A value of YAML's as its annotation has it, or as it is if nothing but its type would have to change.

    ``a,b`` and a lone value are the list that a field holds.
    """
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Annotated:
        return _converted(arguments[0], value)
    if is_union(kind):
        made = [(one, _converted(one, value)) for one in arguments]
        return next((result for one, result in made if fits(one, result)), value)
    if origin in (list, tuple):
        if isinstance(value, str):
            parts = [part.strip() for part in value.split(",")]
            value = parts if arguments[0] is str else [_value(part) for part in parts]
        elif isinstance(value, (bool, int, float)):
            value = [value]
        return origin(_converted(arguments[0], v) for v in value) if isinstance(value, list) else value
    if origin is dict and isinstance(value, dict):
        return {str(key): _converted(arguments[1], entry) for key, entry in value.items()}
    if isinstance(value, bool) or value is None:
        return value
    if kind is str and isinstance(value, (int, float, datetime.date)):
        return str(value)
    if kind in (int, float) and isinstance(value, (str, int)) or isinstance(kind, type) and kind not in PLAIN:
        try:
            return draccus.decode(kind, value)
        except Exception:  # whatever draccus raises, the value does not fit
            return value
    return value


def dotted_fields(cls: type[Any]) -> Iterator[str]:
    """Every field as it is written on the command line, those of all choices included."""
    return (name for name, _ in _fields(cls))


def _fields(cls: type[Any], path: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted name and annotation of every field."""
    sections = sections_of(cls)
    for name, annotation in annotations_of(cls).items():
        if name not in sections:
            yield f"{path}{name}", annotation
            continue
        for kind in choices_of(sections[name]).values() or (sections[name],):
            yield from _fields(kind, f"{path}{name}.")


def _unknown(key: str, value: Any, path: tuple[str, ...], names: list[str], whole: type[Any]) -> InputError:
    """The error for a field that a config does not have: what it resembles, or where it belongs."""
    key = key[:LONGEST_KEY]
    name = full_name = ".".join((*path, key))
    leaf = value
    while isinstance(leaf, dict) and leaf:
        below, leaf = next(iter(leaf.items()))
        full_name += f".{below}"
    annotations = dict(_fields(whole))
    near = [".".join((*path, other)) for other in difflib.get_close_matches(key, names, n=3)]
    # Only what is no misspelling is of a section of LeRobot's.
    if full_name in FLAGS or name in FLAGS or not near:
        hint = hint_for(full_name, leaf, annotations.keys())
        if hint is not None:
            return InputError(full_name, leaf, f"the name is LeRobot's; {hint}")
    # The same name elsewhere, where the value would fit or no section was named.
    for other, annotation in annotations.items():
        same = other.rpartition(".")[2] == key and other != name
        if same and (not path or fits(annotation, _converted(annotation, value))):
            near.append(other)
    if near:
        return InputError(name, value, f"no such field; did you mean {' or '.join(dict.fromkeys(near[:4]))}?")
    where = f"{'.'.join(path)} has" if path else "there are"
    return InputError(name, value, f"no such field; {where} {', '.join(names)}")
