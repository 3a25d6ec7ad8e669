# SPDX-License-Identifier: Apache-2.0
"""The folder of a run of ``accerl train`` or ``accerl offline`` as plain data.

A run that is still going or has crashed has no result file, and the last line of its ``metrics.jsonl`` may be
incomplete. Both are common and no error; any other damage is an error that names the file.

Also the differences of a run's recipe from the defaults and from other runs.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from accerl_lerobot.checkpoint.layout import CONFIG, SUMMARY
from accerl_lerobot.checkpoint.safety import FileSource, check_folder, read_json
from accerl_lerobot.config.parsing import encode, read_recipe
from accerl_lerobot.console import ABSENT
from accerl_lerobot.engine.config import RunConfig
from accerl_lerobot.errors import ERROR_LOG, InputError, reading
from accerl_lerobot.metrics import METRICS

Record = dict[str, Any]


@dataclass(frozen=True, kw_only=True)
class Run:
    """Contents of a run's folder; one of ``accerl offline`` has neither rollouts nor evaluations."""

    path: Path
    config: Record
    config_text: str
    records: dict[str, list[Record]]  # lines of metrics.jsonl by their kind, in order
    result: Record | None  # summary.json; None: not finished
    truncated: bool
    written: float
    error: str  # last line of its error.log, if nothing was written since; empty: it has not failed
    videos: tuple[Path, ...]

    @property
    def name(self) -> str:
        return self.path.resolve().name

    @property
    def offline(self) -> bool:
        """True if it learned from recorded episodes alone."""
        return "rollout" not in self.config and "env" not in self.config

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
        """Evaluations before and after training; of a run that is not finished, the newest."""
        ends = [e for e in self.evaluations if e.get("group") in ("before", "after")]
        return self.evaluations[-1:] if self.result is None else ends

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
    origin = FileSource("runs", str(path))
    check_folder(path, origin)
    config_path = path / CONFIG
    if not config_path.is_file():
        hint = f"no run in it: there is no {CONFIG}, which every run writes first"
        raise InputError("runs", str(path), hint)
    config = read_recipe(config_path)
    if not {"algorithm", "trainer"} <= config.keys():
        raise InputError("runs", str(path), f"no run in it: its {CONFIG} is not one of accerl train")
    lines, truncated = _lines(path / METRICS)
    records: dict[str, list[Record]] = {}
    for number, line in enumerate(lines, 1):
        with reading("runs", str(path), f"line {number} of {METRICS}"):
            _check_numbers(line)
            if line["kind"] == "evaluation":
                _check_evaluation(line)
        records.setdefault(line["kind"], []).append(line)
    written = max(_modified(file) for file in path.iterdir() if file.suffix != ".html")
    summary, log = path / SUMMARY, path / ERROR_LOG
    result = read_json(summary, origin) if summary.is_file() else None
    with reading("runs", str(path), SUMMARY):
        _check_numbers(result or {})
        if result is not None and {*map(type, result.get("tasks", ()))} - {str}:
            raise TypeError("tasks")
    failed = log.is_file() and _modified(log) >= written
    return Run(
        path=path,
        config=config,
        config_text=config_path.read_text(),
        records=records,
        result=result,
        truncated=truncated,
        written=written,
        error=(log.read_text(errors="replace").splitlines() or ["?"])[-1] if failed else "",
        videos=tuple(sorted(path.glob("*.mp4"))),
    )


COUNTS = ("wall_s", "env_steps", "episodes", "updates", "rl_s", "warm_start_s", "success", "n", "steps_mean")
"""Numbers of records and summaries that are computed with."""


def _check_numbers(record: Record) -> None:
    for name, value in record.items():
        if isinstance(value, int):
            float(value)  # or it is too large
        if name in COUNTS and not isinstance(value, int | float | None):
            raise TypeError(f"{name} is {type(value).__name__}")


def _check_evaluation(record: Record) -> None:
    numbers = [record["env_steps"], record["steps_mean"]]
    for measured in (record, *(record.get("tasks") or {}).values()):
        low, high = measured["ci95"]
        numbers += [measured["success"], measured["n"], low, high]
    if {*map(type, record.get("notes", ()))} - {str}:
        raise TypeError("notes")
    if not np.isfinite(np.array(numbers, dtype=np.float64)).all():
        raise ValueError("a number is missing")


def _modified(path: Path) -> float:
    return path.stat().st_mtime


def column(records: Sequence[Record], name: str) -> np.ndarray:
    """One number of each record, float64; NaN where it is missing or not a number."""
    values = (record.get(name) for record in records)
    return np.array([v if isinstance(v, (int, float)) else np.nan for v in values], dtype=np.float64)


def newest(records: Sequence[Record], name: str) -> float | None:
    """The last finite value of this number."""
    values = column(records, name)
    finite = values[np.isfinite(values)]
    return float(finite[-1]) if len(finite) else None


def _lines(path: Path) -> tuple[list[Record], bool]:
    """All records, and whether the last line is incomplete."""
    if not path.is_file():
        return [], False
    records: list[Record] = []
    lines = path.read_bytes().splitlines()
    for number, line in enumerate(lines, 1):
        record = None
        with contextlib.suppress(ValueError, RecursionError):
            record = json.loads(line)
        if isinstance(record, dict) and isinstance(record.get("kind"), str):
            records.append(record)
        elif number < len(lines):
            hint = f"{line[:60].decode(errors='replace')!r} is not a whole record; mend or remove this line"
            raise InputError("runs", f"{path}:{number}", hint)
    return records, len(records) < len(lines)


PLACES = ("output_dir", "job_name")  # fields that say where results go, which are never shown as differences


def flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """A tree of sections as dotted fields; an empty mapping is a value."""
    fields: dict[str, Any] = {}
    for key, value in tree.items():
        name = f"{prefix}{key}"
        fields |= flat(value, f"{name}.") if isinstance(value, dict) and value else {name: value}
    return fields


def differences(tree: dict[str, Any]) -> list[tuple[str, Any, Any]]:
    """Dotted field, value and default, where the two differ; a dash for a field of another type.

    Fields of stages that the run skips are left out.
    """
    usual, fields = flat(encode(RunConfig())), flat(tree)
    skipped: tuple[str, ...] = ()
    if fields.get("dataset.repo_id"):
        skipped = ("demos.",)
    if not fields.get("sft.steps"):
        skipped = ("demos.", "sft.")
    rows = ((name, value, usual.get(name, ABSENT)) for name, value in fields.items())
    shown = (row for row in rows if row[0] not in PLACES and not row[0].startswith(skipped))
    return [row for row in shown if row[1] != row[2]]


def apart(trees: list[dict[str, Any]]) -> list[tuple[str, list[Any]]]:
    """Fields in which runs differ, with each run's value; a dash where one does not have it."""
    flats = [flat(tree) for tree in trees]
    rows = {key: [one.get(key, ABSENT) for one in flats] for one in flats for key in one}
    return [(key, row) for key, row in rows.items() if key not in PLACES and any(v != row[0] for v in row)]
