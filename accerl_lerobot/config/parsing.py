# SPDX-License-Identifier: Apache-2.0
"""Command lines and recipes into configs, and every mistake in them into one line.

The conventions are LeRobot's: dotted flags, sections, and a ``type`` that chooses one config of several.
Reading and merging is done here and not by draccus's argument parser, for five reasons. A field of a choice
(``--algorithm.sigma``) needs no second ``--algorithm.type``. An unknown key is named together with what it
resembles. A key that stands twice in a file is refused. A recipe can name another one as its base. Every verb
can read the recipe of a whole run and take the sections it needs.
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
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import draccus
import yaml

from accerl_lerobot.checkpoint.layout import CONFIG
from accerl_lerobot.config.ranges import annotations_of, defaults_of, fits, is_optional, is_union
from accerl_lerobot.errors import InputError, expanded, in_one_line

DISCOVER = "discover_packages_path"
"""LeRobot's name for the field that names a package whose import registers new types."""
PLUGINS = ("lerobot_robot_", "lerobot_camera_", "lerobot_teleoperator_", "lerobot_policy_", "lerobot_env_")
"""Beginnings of the names of installed packages that LeRobot imports to have their types registered."""
LEROBOTS_FILES = ("config.json", "train_config.json")  # of a policy's folder, taken for recipes by mistake
RECIPES = "recipes"
TYPE = "type"  # the key that picks one config of several, as in ``env.type``
BASE = "base"  # the key that names the recipe on which another one is laid
PREPARES = "prepares"
"""In the metadata of a field `DISCOVER`: a function to call before the package is imported."""
CONSENT = {"trust_remote_code", "hub_path", DISCOVER, "extra_args", "address"}
"""Names of the fields that let somebody's code run with the user's rights: from the Hub, from a package, by
further arguments of ``lerobot-train``, or from a Ray cluster, which exchanges pickles with the run. Only the
command line can set them. A recipe may have come with the very code that it would allow."""
OF_LEROBOT = {
    "steps": "use trainer.updates, or sft.steps",
    "batch_size": "use trainer.batch_decisions, or sft.batch_size",
    "num_workers": "use rollout.workers",
    "save_freq": "use save_every_updates",
    "eval_freq": "use evaluation.every_updates",
    "env_eval_freq": "use evaluation.every_updates",
    "eval": "use evaluation.episodes and rollout.environments",
    "rename_map": "use policy.rename_map",
    "optimizer": "use trainer.lr, or sft.lr",
    "policy.type": "use policy.path, or sft.policy.type",
    "policy.pretrained_path": "use policy.path, or sft.init_path",
    "policy.use_amp": "use policy.precision=bf16",
    "policy.push_to_hub": "use accerl push afterwards",
    "policy.repo_id": "use accerl push afterwards",
    "peft": "use policy.tuning.mode=lora and policy.tuning.rank",
    "wandb.mode": "set WANDB_MODE in the environment",
    "wandb.entity": "set WANDB_ENTITY in the environment",
}
"""Flags and sections of ``lerobot-train`` that people type here, and what stands for each."""


def imported(path: str) -> Any:
    """The object that ``module:name`` names."""
    module, _, name = path.partition(":")
    collects = gc.isenabled()
    new = module not in sys.modules
    gc.disable()  # LeRobot's modules leave little garbage, and looking for it is a fifth of their import
    try:
        return getattr(importlib.import_module(module), name)
    finally:
        if new and os.environ.get("ACCERL_ONE_POLICY"):  # a process of our own, see `policies.deferred`
            gc.freeze()  # or the next collection would look at all of them
        if collects:
            gc.enable()


def discover(package: str | None, section: str = "") -> None:
    """Imports a package that registers types, if there is one. Errors name the field in `section`."""
    if package is None:
        return
    try:
        importlib.import_module(package)
    except (Exception, SystemExit) as error:  # it is somebody's code, which may do anything
        field = f"{section}.{DISCOVER}" if section else DISCOVER
        why = f"cannot be imported ({in_one_line(error)})"
        hint = "install it, or name the folder that it is in: PYTHONPATH=FOLDER accerl …"
        raise InputError(field, package, f"{why}; {hint}") from error


def import_plugins(*prefixes: str) -> dict[str, str]:
    """Imports the installed packages whose names begin with a prefix; returns package → reason of a failure.

    LeRobot's `register_third_party_plugins` logs the traceback of each that is broken, wanted or not.
    """
    broken: dict[str, str] = {}
    for distribution in importlib.metadata.distributions():
        package = re.sub(r"[-.]", "_", distribution.metadata["Name"] or "").lower()
        if package.startswith(prefixes):
            try:
                importlib.import_module(package)
            except (Exception, SystemExit) as error:  # it is somebody's code, which may do anything
                why = in_one_line(error)
                broken[package] = f"{package} is installed and cannot be imported ({why})"
    return broken


def parse(config_class: type[Any], arguments: list[str], *, recipe_class: type[Any] | None = None) -> Any:
    """Parses ``--config_path=…`` and overrides into a config.

    Args:
        config_class: what to build.
        arguments: ``--section.field=value`` or ``--section.field value``; a bare one is the recipe, or bare
            ones are the entries of the field that `config_class` names in ``BARE``.
        recipe_class: top-level keys of a *file* that this class has and `config_class` has not are ignored,
            and ``output_dir`` is, so that one recipe serves several verbs.
    """
    path, given = read_arguments(arguments, getattr(config_class, "BARE", None))
    register_types(config_class, given)
    tree = {} if path is None else _recipe_on_base(path, recipe_class or config_class)
    if recipe_class is not None:
        tree = _for_verb(tree, config_class, recipe_class)
    merged = _overridden(config_class, tree, given)
    from_file = consents(merged, given)
    for name, value in from_file.items():
        hint = "a file cannot allow this, only the command line can: if you trust it, add"
        raise InputError(name, value, f"{hint} {consent_flags(from_file)}")
    return decode(config_class, merged)


def _recipe_on_base(path: Path, config_class: type[Any], above: tuple[Path, ...] = ()) -> dict[str, Any]:
    """A recipe with what it does not say taken from the recipe that its key `BASE` names, if it has one.

    A base is looked for beside the recipe first. `above` are the recipes that are laid on this one.
    """
    over = read_recipe(path)
    if BASE not in over:
        return over
    base = str(over.pop(BASE))
    below = path.parent / base
    if not below.is_file():
        below = expanded(base, BASE)
    if below.resolve() in [recipe.resolve() for recipe in (path, *above)]:
        raise InputError(BASE, base, "this recipe is laid on itself; leave the line out")
    try:
        tree = _recipe_on_base(below, config_class, (*above, path))
    except InputError as error:
        if error.field != "config_path":
            raise
        raise InputError(BASE, base, error.hint) from error
    return _overridden(config_class, tree, over)


def _for_verb(tree: dict[str, Any], config_class: type[Any], recipe_class: type[Any]) -> dict[str, Any]:
    """The part of a run's recipe that is for the config of another verb."""
    known = annotations_of(recipe_class)
    taken = annotations_of(config_class)
    left = {}
    for key, value in tree.items():
        if key in known:
            if key not in taken or key == "output_dir":
                continue  # a run's own config is a recipe too, and its folder is taken
            typed = isinstance(value, dict) and TYPE in value
            if typed and section_of(known[key]) is not section_of(taken[key]):
                continue  # a section that has types in a run and none here is another one of the same name
        left[key] = value
    return left


def consents(tree: Any, given: Any = None) -> dict[str, Any]:
    """Dotted field → value, of the fields in `CONSENT` that a tree, read from a file, sets at any depth.

    Fields that the command line sets as well, in `given`, are left out.
    """
    allowed = dict(leaves(given, lists=True))
    found = {}
    for name, value in leaves(tree, lists=True):
        key = name.rpartition(".")[2]
        if key in CONSENT and value and name not in allowed:
            found[name] = value
    return found


def consent_flags(consented: dict[str, Any]) -> str:
    """Arguments of the command line that give these `consents`."""
    flags = [f"--{name}={as_text(value)}" for name, value in consented.items()]
    return shlex.join(flags)


def leaves(tree: Any, path: str = "", lists: bool = False) -> Iterator[tuple[str, Any]]:
    """Dotted name and value of everything in nested mappings, and in lists if so asked.

    An empty mapping or list is a value, and so is everything below a field in `CONSENT`.
    """
    nested = isinstance(tree, Mapping) or (lists and isinstance(tree, list))
    if not nested or not tree or path.rpartition(".")[2] in CONSENT:
        yield path, tree
        return
    entries = tree.items() if isinstance(tree, Mapping) else enumerate(tree)
    for key, value in entries:
        yield from leaves(value, f"{path}.{key}".removeprefix("."), lists)


def as_text(value: Any) -> str:
    """A value as it can be typed on a command line; control characters are escaped."""
    if isinstance(value, str) and value.isprintable():
        return value
    return json.dumps(value, default=str)


def read_arguments(arguments: list[str], bare: str | None = None) -> tuple[Path | None, dict[str, Any]]:
    """Splits a command line into the recipe's path and a tree of overrides.

    Bare arguments are entries of the list that `bare` names; without it, the one there may be is the recipe.
    """
    entries: list[str] = []
    given: dict[str, Any] = {}
    rest = list(arguments)
    while rest:
        argument = rest.pop(0)
        if not argument.startswith("--"):
            entries.append(argument)
            continue
        key, equals, value = argument[2:].partition("=")
        if not equals:
            if not rest or rest[0].startswith("--"):
                raise InputError(key, "", f"give it a value: --{key}=…")
            value = rest.pop(0)
        _set(given, key, _value(value))
    if entries and bare is not None:
        _set(given, bare, entries)
    elif entries:
        _set(given, "config_path", " ".join(entries))
    recipe = given.pop("config_path", None)
    if recipe is None:
        return None, given
    path = expanded(str(recipe), "config_path")
    return _recipe_path(path), given


def _set(tree: dict[str, Any], dotted: str, value: Any) -> None:
    """Add a value of the command line to a tree; a second value of a field is refused."""
    *sections, name = dotted.split(".")
    for section in sections:
        tree = tree.setdefault(section, {})
        if not isinstance(tree, dict):
            raise InputError(dotted, value, f"{section} is set to {tree!r} already")
    if name in tree:
        raise InputError(dotted, value, f"it is set to {tree[name]!r} already; give it once")
    tree[name] = value


def _recipe_path(path: Path) -> Path:
    """The recipe that a path names: a file, or the config of a run, a checkpoint or a policy in a run."""
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
        in_repository = str(path.parent) == RECIPES
        name = path.stem if in_repository else str(path)
        path = shipped.get(name, path)
    if not path.is_file():
        what = f"a folder without {CONFIG}" if path.is_dir() else "no such file"
        raise InputError("config_path", str(path), f"{what}; this package has {', '.join(shipped)}")
    if path.name in LEROBOTS_FILES:
        hint = "resume a run with RUN/config.yaml, and name a policy's folder by policy.path"
        raise InputError("config_path", str(path), f"LeRobot wrote it; {hint}")
    try:
        tree = yaml.load(path.read_text(), _Loader)
    except Exception as error:  # of YAML, of a number such as 0x_, or of too many levels
        raise InputError("config_path", str(path), f"not good YAML: {error}") from error
    if not isinstance(tree, dict | None):
        raise InputError("config_path", str(path), "a recipe is a mapping such as 'env: {type: metaworld}'")
    return tree or {}


class Whole(dict[str, Any]):
    """A mapping that the command line gives as one value, in place of all that a file has there."""


class _Loader(yaml.SafeLoader):
    """YAML with unique keys."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value:
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"{key.value} is given twice", key.start_mark
                )
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def _value(text: str) -> Any:
    """A value as YAML reads it; text stays as it is, unless it is quoted."""
    try:
        value = yaml.load(text, _Loader) if text else text
    except Exception:  # see `read_recipe`
        return text
    if isinstance(value, dict):
        return Whole(value)
    unquoted = isinstance(value, str) and not text.startswith(("'", '"'))
    odd = isinstance(value, int) and not isinstance(value, bool) and str(value) != text
    if unquoted or odd:  # YAML would cut off what follows a #, and reads 012345 as an octal number
        return text
    return value


def section_of(annotation: Any) -> type[Any] | None:
    """The config class behind a field's annotation, ``X`` or ``X | None``; None for a plain value."""
    kinds = typing.get_args(annotation) if is_union(annotation) else (annotation,)
    for kind in kinds:
        if isinstance(kind, type) and dataclasses.is_dataclass(kind):
            return kind
    return None


def sections_of(cls: type[Any]) -> dict[str, type[Any]]:
    """Field → config class, of the fields that are sections."""
    sections = {}
    for name, annotation in annotations_of(cls).items():
        section = section_of(annotation)
        if section is not None:
            sections[name] = section
    return sections


def choices_of(section: type[Any]) -> dict[str, type[Any]]:
    """Registered name → config class, where `section` is the root of a choice; otherwise empty."""
    if draccus.ChoiceRegistry in section.__bases__:
        return dict(section.get_known_choices())
    return {}


def register_types(cls: type[Any], tree: dict[str, Any], path: tuple[str, ...] = ()) -> None:
    """Imports the packages that register types of what is to be decoded, as LeRobot's parser does."""
    for field in dataclasses.fields(cls):
        if field.name == DISCOVER and tree.get(DISCOVER) is not None:
            prepare = field.metadata.get(PREPARES)
            if prepare is not None:
                prepare()
            discover(str(tree[DISCOVER]), ".".join(path))
    for name, section in sections_of(cls).items():
        if isinstance(tree.get(name), dict):
            register_types(section, tree[name], (*path, name))


def _overridden(config_class: type[Any], tree: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    """`tree` with `given` laid over it.

    Where `given` picks another type than the file's, the new type takes over the fields that it has and whose
    values fit: ``--algorithm.type=ppo`` replaces GIPO together with its ``sigma``. Another ``env.type`` takes
    over nothing. Of a policy type of LeRobot's the fields are not known here, so another ``sft.policy.type``
    replaces all of them.
    """
    merged = tree | given
    sections = sections_of(config_class)
    defaults = defaults_of(config_class)
    for name in tree.keys() & given.keys():
        under = tree[name]
        over = given[name]
        if not isinstance(under, dict) or not isinstance(over, dict):
            continue
        former = under.get(TYPE, getattr(defaults.get(name), TYPE, None))
        chosen = over.get(TYPE, former)
        if name not in sections:  # fields of LeRobot's or of a simulator's, such as `sft.policy`
            whole = isinstance(over, Whole) or chosen != former
            merged[name] = over if whole else under | over
            continue
        for place in ("path", "repo_id"):
            if over.get(place, under.get(place)) != under.get(place):  # these are of another repository
                under = {key: value for key, value in under.items() if key not in ("revision", "root")}
        section = sections[name]
        kind = choices_of(section).get(str(chosen), section)
        if chosen != former:  # another environment has other tasks, limits and images
            under = {} if name == "env" else _fitting(kind, under)
        merged[name] = _overridden(kind, under, over)
    return merged


def _fitting(section: type[Any], tree: dict[str, Any]) -> dict[str, Any]:
    """The part of `tree` that a section of this type has fields for, and whose values fit them."""
    fitting = {}
    for name, annotation in annotations_of(section).items():
        if name in tree and fits(annotation, _converted(annotation, tree[name])):
            fitting[name] = tree[name]
    return fitting


def decode(config_class: type[Any], tree: dict[str, Any]) -> Any:
    """Builds a config from plain values; imports nothing that they name."""
    return _decoded(config_class, tree, None, (), config_class)


def encode(config: Any) -> dict[str, Any]:
    """Plain JSON types, for files and loggers; `decode` makes the same config of them."""
    encoded: dict[str, Any] = draccus.encode(config)
    return encoded


def encoded_defaults(cls: type[Any]) -> dict[str, Any]:
    """Field → default, as a file has it."""
    return {name: draccus.encode(default) for name, default in defaults_of(cls).items()}


def _decoded(cls: type[Any], tree: Any, default: Any, path: tuple[str, ...], whole: type[Any]) -> Any:
    """A config section of the type that `tree` names, or of the type of its default.

    Fields that `tree` does not give are those of `default`, if it is of this type. `path` is where the
    section stands in the config `whole`.
    """
    dotted = ".".join(path)
    if not isinstance(tree, dict | None):
        raise InputError(dotted, tree, f"a config section; use --{path[-1]}.field=value")
    given = dict(tree or {})
    choices = choices_of(cls)
    if choices:
        kind = given.pop(TYPE, getattr(default, TYPE, None))
        if str(kind) not in choices:
            raise InputError(f"{dotted}.{TYPE}", kind, f"use one of {', '.join(sorted(choices))}")
        cls = choices[str(kind)]
    annotations = annotations_of(cls)
    sections = sections_of(cls)
    base = default if type(default) is cls else None
    values: dict[str, Any] = {}
    for key, value in given.items():
        place = (*path, str(key))
        if key not in annotations:
            raise _unknown(place, value, list(annotations), whole)
        annotation = annotations[key]
        if key not in sections or (value is None and is_optional(annotation)):
            values[key] = _converted(annotation, value)
        else:
            usual = defaults_of(cls)[key] if base is None else getattr(base, key)
            values[key] = _decoded(sections[key], value, usual, place, whole)
    try:
        return cls(**values) if base is None else dataclasses.replace(base, **values)
    except InputError as error:
        own = f"{getattr(cls, 'SECTION', '')}."
        actual = f"{dotted}."
        if actual in (".", own) or not error.field.startswith(own):
            raise
        # A section that stands in several places, such as a dataset, has one name for itself.
        field = error.field.replace(own, actual, 1)
        raise InputError(field, error.value, error.hint.replace(own, actual)) from error


def _converted(kind: Any, value: Any) -> Any:
    """A value from YAML, converted to the type of its annotation where that is possible.

    Text such as ``a,b``, and a single value, become a list where the field is a list.
    """
    origin = typing.get_origin(kind)
    arguments = typing.get_args(kind)
    if origin is Annotated:
        return _converted(arguments[0], value)
    if is_union(kind):
        for one in arguments:
            made = _converted(one, value)
            if fits(one, made):
                return made
        return value
    if origin in (list, tuple) and not isinstance(value, dict | None):
        if isinstance(value, str):
            value = [part.strip() for part in value.split(",")]
        entries = value if isinstance(value, (list, tuple)) else [value]
        return origin(_converted(arguments[0], entry) for entry in entries)
    if origin is dict and isinstance(value, dict):
        converted = {}
        for key, entry in value.items():
            converted[str(key)] = _converted(arguments[1], entry)
        return converted
    if kind is Any:
        return _numbers(value)
    if isinstance(value, bool):
        return value
    if kind is str and isinstance(value, (int, float, datetime.date)):
        return str(value)
    if kind in (int, float) and isinstance(value, (str, int)):
        try:
            return kind(value)  # YAML takes 1e-5 for text
        except (OverflowError, ValueError):
            return value
    return value


def _numbers(value: Any) -> Any:
    """The same, with numbers such as 1e-5, which YAML takes for text."""
    if isinstance(value, dict):
        return {key: _numbers(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_numbers(entry) for entry in value]
    if isinstance(value, str) and re.fullmatch(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+", value):
        return float(value)
    return value


def dotted_fields(cls: type[Any], path: str = "") -> Iterator[str]:
    """Every field as it is written on the command line, those of all choices included."""
    sections = sections_of(cls)
    for name in annotations_of(cls):
        if name not in sections:
            yield f"{path}{name}"
            continue
        section = sections[name]
        for kind in choices_of(section).values() or (section,):
            yield from dotted_fields(kind, f"{path}{name}.")


def _unknown(place: tuple[str, ...], value: Any, names: list[str], whole: type[Any]) -> InputError:
    """The error for a field that a config does not have. It names similar fields, or all of the section."""
    *path, key = place
    name = ".".join(place)
    if name in OF_LEROBOT:
        return InputError(name, value, f"the name is LeRobot's; {OF_LEROBOT[name]}")
    near = [".".join((*path, other)) for other in difflib.get_close_matches(key, names, n=3)]
    for other in dotted_fields(whole):
        if other.rpartition(".")[2] == key and other not in (name, *near):
            near.append(other)
    if near:
        return InputError(name, value, f"no such field; did you mean {' or '.join(near)}?")
    where = f"{'.'.join(path)} has" if path else "there are"
    return InputError(name, value, f"no such field; {where} {', '.join(names)}")
