# SPDX-License-Identifier: Apache-2.0
"""A run's recipe: its differences from the defaults and from other runs, and commands to type next."""

from __future__ import annotations

import dataclasses
import shlex
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from accerl_lerobot.checkpoint.layout import CONFIG
from accerl_lerobot.config.parsing import TYPE, choices_of, decode, encode, section_of
from accerl_lerobot.engine.preflight import lag_limits
from accerl_lerobot.engine.stopping import resume_command
from accerl_lerobot.errors import InputError
from accerl_lerobot.report.read import Run

Flat = dict[str, Any]
"""Dotted field → value."""

ABSENT = "–"
"""Stands where a recipe has no such field."""
PLACES = ("output_dir", "job_name")
"""Fields that say where results go, which are never shown as differences."""
PLUGIN = "accerl_lerobot.envs.lerobot_plugin"


def flat(tree: Mapping[str, Any], prefix: str = "") -> Flat:
    """A tree of sections as dotted fields; an empty mapping is a value."""
    fields: Flat = {}
    for key, value in tree.items():
        name = f"{prefix}{key}"
        fields |= flat(value, f"{name}.") if isinstance(value, dict) and value else {name: value}
    return fields


def differences(config_class: type[Any], tree: dict[str, Any]) -> list[tuple[str, Any, Any]]:
    """Field, value and default, where the two differ.

    Defaults are those of the types that were chosen: GIPO's for a run of GIPO. That it was chosen is a
    difference too, and so is a section that is off unless it is given.
    """
    values = {key: value for key, value in flat(tree).items() if key not in PLACES}
    defaults, untouched = (flat(_defaults(None, config_class, chosen)) for chosen in (tree, {}))
    given = [k for k in untouched if k not in values and any(other.startswith(f"{k}.") for other in values)]
    for key in untouched:
        if key.rpartition(".")[2] == TYPE:
            defaults[key] = untouched[key]
    changed = [
        (k, v, defaults.get(k, ABSENT)) for k, v in values.items() if k not in defaults or defaults[k] != v
    ]
    return [(k, values.get(f"{k}.{TYPE}", "given"), untouched[k]) for k in given] + changed


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
    """Why this version does not understand a recipe that another version wrote; empty if it does."""
    try:
        decode(config_class, tree)
    except InputError as error:
        return str(error)
    return ""


def _defaults(instance: Any, config_class: type[Any], tree: dict[str, Any]) -> dict[str, Any]:
    """Default of every field where `tree` chooses types; unchecked, as some sections have no default.

    Args:
        instance: whose fields are the defaults; None: those of the class.
        config_class: of the section.
        tree: what was chosen in it.
    """
    defaults: dict[str, Any] = {}
    hints = typing.get_type_hints(config_class)
    for field in dataclasses.fields(config_class):
        name, value = field.name, _default(field) if instance is None else getattr(instance, field.name)
        section, given = section_of(hints[name]), tree.get(name)
        if section is None or not isinstance(given, dict):
            chosen = getattr(value, TYPE, None) if dataclasses.is_dataclass(value) else None
            defaults[name] = encode(value) if chosen is None else encode(value) | {TYPE: chosen}
            continue
        kind = choices_of(section).get(str(given.get(TYPE)), section)
        same = value if type(value) is kind else None
        defaults[name] = _defaults(same, kind, given) | ({TYPE: given[TYPE]} if TYPE in given else {})
    return defaults


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return ABSENT if field.default is dataclasses.MISSING else field.default


def commands(run: Run) -> list[tuple[str, str]]:
    """Purpose and line of each command to type next; those that need a checkpoint only where there is one."""
    recipe = _quoted(run.path / CONFIG)
    again = f"accerl {run.verb} --config_path={recipe} --output_dir={_quoted(Path(f'{run.path}-again'))}"
    lines = [("Run it again; choose a folder that does not exist yet", again)]
    if run.verb == "train" and run.result is None:
        lines.insert(0, ("Resume it, if it has stopped", resume_command(run.path)))
    if run.checkpoint is None:
        return lines
    policy = f"--policy.path={_quoted(run.checkpoint)}"
    episodes = run.section("evaluation").get("episodes", 100)
    evaluate = f"accerl eval --config_path={recipe} {policy} --evaluation.episodes={_quoted(episodes)}"
    lines.append(("Evaluate its policy on the seeds of this page", evaluate))
    if env := _lerobot_env(run.section("env")):
        stock = f"lerobot-eval {policy} {env} --eval.n_episodes=50 --eval.batch_size=5"
        lines.append(("Evaluate it with LeRobot itself", stock))
    share = f"accerl push --path={_quoted(run.checkpoint)} --repo_id=USER/NAME"
    return [*lines, ("Share it on the Hub", share)]


def _lerobot_env(env: Mapping[str, Any]) -> str:
    """Arguments of lerobot-eval that name this environment; empty if LeRobot does not have it."""
    if env.get("type") == "metaworld":
        names = ("task", "camera", "image_size", "max_steps")
        fields: dict[str, Any] = {"discover_packages_path": PLUGIN, "type": "accerl_metaworld"}
        fields |= {name: env[name] for name in names if name in env}
    elif env.get("type") == "lerobot":
        fields = {"type": env.get("name"), **env.get("kwargs", {})}
    else:
        return ""
    return shlex.join(f"--env.{name}={value}" for name, value in fields.items())


def _quoted(value: Any) -> str:
    """A value from a run as one word of a shell command, whatever is in it."""
    return shlex.quote(str(value))
