# SPDX-License-Identifier: Apache-2.0
"""A run's folder as plain data.

A run that is still going or has crashed has no result file, and the last line of its ``metrics.jsonl`` may be
incomplete. Both are common and no error; any other damage is an error that names the file.

A run's recipe: its differences from the defaults and from other runs, and commands to type next.
"""

from __future__ import annotations

import dataclasses
import json
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np

from accerl_lerobot.checkpoint.layout import CHECKPOINTS, CONFIG, LAST, PRETRAINED, SUMMARY
from accerl_lerobot.checkpoint.safety import Origin, brief, check_folder
from accerl_lerobot.config.parsing import (
    TYPE,
    choices_of,
    decode,
    encode,
    read_recipe,
    section_of,
)
from accerl_lerobot.console import ABSENT
from accerl_lerobot.engine.preflight import lag_limits
from accerl_lerobot.engine.stopping import resume_command
from accerl_lerobot.envs.base import lerobot_eval_arguments
from accerl_lerobot.errors import InputError
from accerl_lerobot.metrics import METRICS

Record = dict[str, Any]

VALIDATION = "validation.json"
COUNTERS = ("env_steps", "decisions", "episodes")
"""Counters of workers, which may restart at 0 when a run is resumed."""

VERBS = {
    "train": {"algorithm", "trainer"},
    "world-model": {"world_model"},
    "world-model-eval": {"path", "validation"},
}
"""Verbs that write runs, and sections by which their config is recognised."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """Contents of a run's folder."""

    path: Path
    verb: str
    """Verb that wrote it, one of `VERBS`."""
    config: Record
    config_text: str
    records: dict[str, list[Record]]
    """Lines of metrics.jsonl by their kind, in order."""
    result: Record | None
    """summary.json or validation.json; None: not finished."""
    truncated: bool
    """True if the last line of metrics.jsonl is incomplete."""
    sessions: int
    """1 + the number of times that it was resumed."""
    written: float
    """When something was last written, in seconds since 1970."""
    videos: tuple[Path, ...]
    checkpoint: Path | None
    """The newest policy, a LeRobot checkpoint."""

    @property
    def name(self) -> str:
        """Name of its folder."""
        return self.path.resolve().name

    @property
    def train(self) -> list[Record]:
        """Records of the trainer, one per update."""
        return self.records.get("train", [])

    @property
    def rollout(self) -> list[Record]:
        """Records of all other workers."""
        return self.records.get("rollout", [])

    @property
    def evaluations(self) -> list[Record]:
        """In the order of the policy's experience."""
        return sorted(self.records.get("evaluation", []), key=lambda e: e["env_steps"])

    @property
    def outcomes(self) -> list[Record]:
        """``group``, ``success``, ``ci95`` and ``n`` before and after training; or the newest."""
        result = self.result
        if result is None:
            return self.evaluations[-1:]
        return [
            {"group": when, **{key: result.get(f"{key}_{when}") for key in ("success", "ci95", "n")}}
            for when in ("before", "after")
            if result.get(f"success_{when}") is not None and result.get(f"ci95_{when}") is not None
        ]

    @property
    def wall_s(self) -> float | None:
        """Seconds that it took, or has taken so far."""
        walls = [newest(records, "wall_s") for records in self.records.values()]
        return (self.result or {}).get("wall_s", max((w for w in walls if w is not None), default=None))

    def section(self, name: str) -> Record:
        """Section of its config; empty if another version wrote it without."""
        section = self.config.get(name)
        return section if isinstance(section, dict) else {}


def read_run(path: Path) -> Run:
    """Reads a folder."""
    if not path.is_dir():
        remedy = "no such folder" if not path.exists() else "a file; name the folder of a run"
        raise InputError("runs", str(path), remedy)
    config_path = path / CONFIG
    if not config_path.is_file():
        remedy = f"no run in it: there is no {CONFIG}, which every run writes first"
        raise InputError("runs", str(path), remedy)
    check_folder(path, Origin("runs", str(path)))
    config = read_recipe(config_path)
    verb = next((verb for verb, keys in VERBS.items() if keys <= config.keys()), None)
    if verb is None:
        remedy = "no run in it: its config.yaml is not one of accerl train, world-model or world-model-eval"
        raise InputError("runs", str(path), remedy)
    lines, truncated = _lines(path / METRICS)
    records, sessions = _continuous(lines)
    result = path / (SUMMARY if verb == "train" else VALIDATION)
    checkpoint = path / CHECKPOINTS / LAST / PRETRAINED
    return Run(
        path=path,
        verb=verb,
        config=config,
        config_text=config_path.read_text(),
        records=records,
        result=_mapping(result) if result.is_file() else None,
        truncated=truncated,
        sessions=sessions,
        written=max(file.stat().st_mtime for file in path.iterdir() if file.suffix != ".html"),
        videos=tuple(sorted(path.glob("*.mp4"))),
        checkpoint=checkpoint if checkpoint.is_dir() else None,
    )


def column(records: Sequence[Record], name: str) -> np.ndarray:
    """One number of each record, float64; NaN where it is missing or not a number."""
    values = (record.get(name) for record in records)
    return np.array([v if isinstance(v, (int, float)) else np.nan for v in values], dtype=np.float64)


def newest(records: Sequence[Record], name: str) -> float | None:
    """The last finite value of this number."""
    values = column(records, name)
    finite = values[np.isfinite(values)]
    return float(finite[-1]) if len(finite) else None


def _mapping(path: Path) -> Record:
    """The content of a JSON file."""
    try:
        return dict(json.loads(path.read_text()))
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError("runs", str(path), f"damaged ({brief(error)}); restore it, or remove it") from error


def _lines(path: Path) -> tuple[list[Record], bool]:
    """All records, and whether the last line is incomplete."""
    if not path.is_file():
        return [], False
    records: list[Record] = []
    lines = path.read_bytes().splitlines()
    for number, line in enumerate(lines, 1):
        if (record := _record(line)) is not None:
            records.append(record)
        elif number < len(lines):
            remedy = f"{line[:60].decode(errors='replace')!r} is not a whole record; mend or remove this line"
            raise InputError("runs", f"{path}:{number}", remedy)
    return records, len(records) < len(lines)


def _record(line: bytes) -> Record | None:
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) and isinstance(record.get("kind"), str) else None


def _continuous(lines: list[Record]) -> tuple[dict[str, list[Record]], int]:
    """Records by kind as if the run had never stopped, and the number of its sessions.

    A resumed run counts seconds from 0 and updates from its checkpoint. Updates that an earlier session made
    after that checkpoint were made again, so they are dropped; counters that fall are continued.
    """
    records: dict[str, list[Record]] = {}
    newest_values: dict[str, float] = {}
    offsets = dict.fromkeys(("wall_s", *COUNTERS), 0.0)
    sessions, last_wall = 1, 0.0
    for record in lines:
        wall = _number(record, "wall_s", last_wall)
        if wall < last_wall:
            sessions += 1
            offsets["wall_s"] += last_wall
            # The first record of a session has the checkpoint's version, or is the first update after it.
            checkpoint = _number(record, "update", 0) - (record["kind"] == "train")
            for kind, earlier in records.items():
                records[kind] = [r for r in earlier if _number(r, "update", 0) <= checkpoint]
        last_wall = wall
        if record["kind"] == "rollout":
            for name in COUNTERS:
                value = _number(record, name, 0.0)
                if value < newest_values.get(name, 0.0):
                    offsets[name] += newest_values[name]
                newest_values[name] = value
        moved = {name: _number(record, name, 0) + by for name, by in offsets.items() if by and name in record}
        records.setdefault(record["kind"], []).append({**record, **moved})
    return records, sessions


def _number(record: Record, name: str, default: float) -> float:
    value = record.get(name)
    return value if isinstance(value, (int, float)) else default


PLACES = ("output_dir", "job_name")
"""Fields that say where results go, which are never shown as differences."""


def flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """A tree of sections as dotted fields; an empty mapping is a value."""
    fields: dict[str, Any] = {}
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

    The fields of an `instance` are the defaults, if there is one.
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
    recipe = quote(str(run.path / CONFIG))
    again = f"accerl {run.verb} --config_path={recipe} --output_dir={quote(f'{run.path}-again')}"
    lines = [("Run it again; choose a folder that does not exist yet", again)]
    if run.verb == "train" and run.result is None:
        lines.insert(0, ("Resume it, if it has stopped", resume_command(run.path)))
    if run.checkpoint is None:
        return lines
    policy = f"--policy.path={quote(str(run.checkpoint))}"
    episodes = run.section("evaluation").get("episodes", 100)
    evaluate = f"accerl eval --config_path={recipe} {policy} --evaluation.episodes={quote(str(episodes))}"
    lines.append(("Evaluate its policy on the seeds of this page", evaluate))
    if env := lerobot_eval_arguments(run.section("env")):
        stock = f"lerobot-eval {policy} {' '.join(env)} --eval.n_episodes=50 --eval.batch_size=5"
        lines.append(("Evaluate it with LeRobot itself", stock))
    share = f"accerl push --path={quote(str(run.checkpoint))} --repo_id=USER/NAME"
    return [*lines, ("Share it on the Hub", share)]
