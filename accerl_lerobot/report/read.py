# SPDX-License-Identifier: Apache-2.0
"""A run's folder as plain data. Reads only; what is torn or missing is said and not guessed.

A run that is going on or has died has no ``summary.json`` (or ``validation.json``), and the last line of its
``metrics.jsonl`` may be half a line. Both are common and no error. A line before the last that is none is.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from accerl_lerobot.checkpoint.layout import CHECKPOINTS, CONFIG, LAST, PRETRAINED, SUMMARY
from accerl_lerobot.checkpoint.safety import Origin, check_folder
from accerl_lerobot.config.parsing import check_recipe_size, load_yaml
from accerl_lerobot.errors import InputError
from accerl_lerobot.metrics import METRICS
from accerl_lerobot.world_model.config import VIDEOS

Record = dict[str, Any]

TRIAL = "validation.json"


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _is_interval(value: Any) -> bool:
    return isinstance(value, list) and len(value) == 2 and all(map(_is_number, value))


def _is_list(value: Any) -> bool:
    return isinstance(value, list) and all(
        isinstance(row, dict) and _is_number(row.get("depth")) for row in value
    )


def _is_gates(value: Any) -> bool:
    return isinstance(value, dict) and all(
        isinstance(gate, dict) and {"value", "wanted", "holds"} <= gate.keys() for gate in value.values()
    )


def _is_trial(value: Any) -> bool:
    return isinstance(value, dict) and "name" in value and not _lacking(value, TRIAL_NEEDS)


Needs = dict[str, Callable[[Any], bool]]
"""Fields that a page cannot do without, and their types."""

SUMMARY_NEEDS: Needs = {
    "success_after": _is_number,
    "ci95_after": _is_interval,
    "n_after": _is_number,
    "success_before": lambda value: value is None or _is_number(value),
    "ci95_before": lambda value: value is None or _is_interval(value),
    "env_steps": _is_number,
    "wall_s": _is_number,
    "seed": _is_number,
}
TRIAL_NEEDS: Needs = {
    "passed": lambda value: isinstance(value, bool),
    "windows": _is_number,
    "checks": _is_gates,
    "depths": _is_list,
    "datasets": lambda value: (
        value is None or (isinstance(value, dict) and all(map(_is_trial, value.values())))
    ),
}
EVALUATION_NEEDS: Needs = {
    "success": _is_number,
    "ci95": _is_interval,
    "n": _is_number,
    "env_steps": _is_number,
    "steps_mean": _is_number,
}
GROWING = ("wall_s", "env_steps", "decisions", "episodes")
"""Counters of workers: a run that was taken up again may count them from 0."""


@dataclass(frozen=True, kw_only=True)
class Run:
    """Contents of a run's folder."""

    path: Path
    verb: str
    """Verb that wrote it: train, world-model or world-model-eval."""
    config: Record
    config_text: str
    """The file itself."""
    records: dict[str, list[Record]]
    """Lines of metrics.jsonl by their kind, in order."""
    result: Record | None
    """summary.json of train, validation.json of the others; None: not finished."""
    torn: bool
    """True if the last line of metrics.jsonl is incomplete."""
    sessions: int
    """How often it was started: 1 if it was never taken up again."""
    written: float
    """When something was last written, in seconds since 1970."""
    videos: tuple[Path, ...]
    dreams: tuple[Path, ...]
    """Pictures of held-out episodes beside their dreams, in the order of the trials that they were made
    after."""
    checkpoint: Path | None
    """The newest policy, a LeRobot checkpoint."""

    @property
    def name(self) -> str:
        """Name of its folder."""
        return self.path.resolve().name

    def room(self, name: str) -> Record:
        """Section of its config; one that another version did not have is empty."""
        room = self.config.get(name)
        return room if isinstance(room, dict) else {}


def read_run(path: Path) -> Run:
    """Reads a folder.

    Raises:
        InputError: not a folder, no run in it, or a file of it is damaged.
    """
    if not path.is_dir():
        remedy = "no such folder" if not path.exists() else "a file; name the folder of a run"
        raise InputError("runs", str(path), remedy)
    config_path = path / CONFIG
    if not config_path.is_file():
        raise InputError(
            "runs", str(path), f"no run in it: there is no {CONFIG}, which every run writes first"
        )
    check_folder(path, Origin("runs", str(path)))
    check_recipe_size(config_path, "runs")
    text = _text(config_path)
    config = _mapping(config_path, text)
    verb = _verb(config)
    if verb is None:
        remedy = "no run in it: its config.yaml is not one of accerl train, world-model or world-model-eval"
        raise InputError("runs", str(path), remedy)
    lines, torn = _lines(path / METRICS)
    records, sessions = _continuous(lines)
    newest = path / CHECKPOINTS / LAST / PRETRAINED
    return Run(
        path=path,
        verb=verb,
        config=config,
        config_text=text,
        records=records,
        result=_result(path / SUMMARY, SUMMARY_NEEDS)
        if verb == "train"
        else _result(path / TRIAL, TRIAL_NEEDS),
        torn=torn,
        sessions=sessions,
        written=max(file.stat().st_mtime for file in path.iterdir() if file.suffix != ".html"),
        videos=tuple(sorted(path.glob("*.mp4"))),
        dreams=tuple(sorted(path.glob(f"{VIDEOS}/[0-9]*.mp4"))),
        checkpoint=newest if newest.is_dir() else None,
    )


def column(records: Sequence[Record], name: str) -> np.ndarray:
    """One number of each record, float64; NaN where it is missing or not a number."""
    values = (record.get(name) for record in records)
    return np.array([v if isinstance(v, (int, float)) else np.nan for v in values], dtype=np.float64)


def has(records: Sequence[Record], name: str) -> bool:
    """True if any record has this number."""
    return any(isinstance(record.get(name), (int, float)) for record in records)


def newest(records: Sequence[Record], name: str) -> float | None:
    """The last of these numbers that there is."""
    values = column(records, name)
    found = values[np.isfinite(values)]
    return float(found[-1]) if len(found) else None


def _verb(config: Record) -> str | None:
    for verb, keys in (
        ("train", {"algorithm", "trainer"}),
        ("world-model", {"world_model"}),
        ("world-model-eval", {"path", "validation"}),
    ):
        if keys <= config.keys():
            return verb
    return None


def _text(path: Path) -> str:
    try:
        return path.read_text()
    except UnicodeDecodeError as error:
        raise InputError("runs", str(path), f"not text, at byte {error.start}; restore the file") from error


def _mapping(path: Path, text: str) -> Record:
    """YAML and JSON alike, as JSON is YAML; but large JSON is read faster as such."""
    try:
        tree = json.loads(text) if path.suffix == ".json" else load_yaml(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        remedy = f"damaged ({str(error).splitlines()[0]}); restore it, or remove it"
        raise InputError("runs", str(path), remedy) from error
    if not isinstance(tree, dict):
        raise InputError("runs", str(path), "damaged: not a mapping; restore it, or remove it")
    return tree


def _result(path: Path, needs: Needs) -> Record | None:
    if not path.is_file():
        return None
    result = _mapping(path, _text(path))
    if lacking := _lacking(result, needs):
        remedy = f"it has no good {lacking}: it is damaged, or of another version; restore or remove it"
        raise InputError("runs", str(path), remedy)
    return result


def _lacking(record: Record, needs: Needs) -> str:
    """The first field that is missing or of the wrong kind; empty if all is well."""
    return next((key for key, good in needs.items() if not good(record.get(key))), "")


def _lines(path: Path) -> tuple[list[Record], bool]:
    """All records, and whether the last line is torn; a run that has not come to it has no file."""
    if not path.is_file():
        return [], False
    found: list[Record] = []
    lines = path.read_bytes().splitlines()
    for number, line in enumerate(lines, 1):
        if (record := _record(line)) is not None:
            found.append(record)
        elif number < len(lines):
            shown = line[:60].decode(errors="replace")
            raise InputError(
                "runs", f"{path}:{number}", f"{shown!r} is not a whole record; mend or remove this line"
            )
    return found, len(found) < len(lines)


def _record(line: bytes) -> Record | None:
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(record, dict) or not isinstance(record.get("kind"), str):
        return None
    return None if record["kind"] == "evaluation" and _lacking(record, EVALUATION_NEEDS) else record


def _continuous(lines: list[Record]) -> tuple[dict[str, list[Record]], int]:
    """Records by kind, as if the run had never stopped; and how many times it was started.

    Each start counts seconds anew, and updates from its checkpoint: what an earlier one did beyond that was
    done again, so it is left out. Counters that fall go on where they were.
    """
    records: dict[str, list[Record]] = {}
    ends: dict[str, float] = {}
    """Newest value of each counter since this start."""
    carried = dict.fromkeys(GROWING, 0.0)
    sessions, last = 1, 0.0
    for record in lines:
        wall = _number(record, "wall_s", last)
        if wall < last:
            sessions += 1
            carried["wall_s"] += last
            update = _number(record, "update", 0)
            # The first record of a start has the checkpoint's version, or the first update after it.
            again = update - (record["kind"] == "train")
            for kind, earlier in records.items():
                records[kind] = [r for r in earlier if _number(r, "update", 0) <= again]
        last = wall
        if record["kind"] == "rollout":
            for name in GROWING[1:]:
                value = _number(record, name, 0.0)
                if value < ends.get(name, 0.0):
                    carried[name] += ends[name]
                ends[name] = value
        moved = {name: _number(record, name, 0) + by for name, by in carried.items() if by and name in record}
        records.setdefault(record["kind"], []).append({**record, **moved})
    return records, sessions


def _number(record: Record, name: str, otherwise: float) -> float:
    value = record.get(name)
    return value if isinstance(value, (int, float)) else otherwise
