# SPDX-License-Identifier: Apache-2.0
"""The folder of a run of ``accerl train`` or ``accerl offline`` as plain data.

A run that is still going or has crashed has no result file, and the last line of its ``metrics.jsonl`` may be
incomplete, and is left out. Both are common and no error.

Also the differences of a run's recipe from the defaults and from other runs.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from accerl_lerobot.checkpoint.layout import CHECKPOINTS, CONFIG, SUMMARY
from accerl_lerobot.checkpoint.safety import FileSource, check_folder, read_json
from accerl_lerobot.config.parsing import encode, leaves, read_recipe
from accerl_lerobot.console import ABSENT
from accerl_lerobot.engines.config import RunConfig
from accerl_lerobot.errors import ERROR_LOG, InputError, in_one_line
from accerl_lerobot.metrics import METRICS

Record = dict[str, Any]
PLACES = ("output_dir", "job_name")  # fields that say where results go, which are never shown as differences


@dataclass(frozen=True, kw_only=True)
class Run:
    """Contents of a run's folder; one of ``accerl offline`` has neither rollouts nor evaluations."""

    path: Path
    config: Record
    config_text: str
    train: list[Record]  # records of the trainer
    rollout: list[Record]  # records of all other workers
    evaluations: list[Record]  # in the order of the policy's experience
    result: Record  # summary.json; empty: not finished
    written: float
    error: str  # last line of its error.log, if nothing was written since; empty: it has not failed
    videos: tuple[Path, ...]

    @property
    def name(self) -> str:
        return self.path.resolve().name

    @property
    def offline(self) -> bool:
        """True if it learned from recorded episodes alone."""
        return "env" not in self.config

    @property
    def before(self) -> Record:
        """The evaluation before training; empty if there is none."""
        return next((e for e in self.evaluations if e.get("group") == "before"), {})

    @property
    def newest(self) -> Record:
        """The newest evaluation, unless it is the one before training; empty if there is none."""
        return next((e for e in self.evaluations[-1:] if e.get("group") != "before"), {})

    def section(self, name: str) -> Record:
        """Section of its config; empty if another version wrote it without."""
        section = self.config.get(name)
        if not isinstance(section, dict):
            return {}
        return section


def read_run(path: Path) -> Run:
    source = FileSource("runs", str(path))
    check_folder(path, source)
    config_path = path / CONFIG
    summary = path / SUMMARY
    log = path / ERROR_LOG
    config = read_recipe(config_path) if config_path.is_file() else {}
    if not {"algorithm", "trainer"} <= config.keys():
        raise InputError("runs", str(path), f"no run in it: there is no {CONFIG} of accerl train")
    records = _records(path / METRICS, source)
    result = read_json(summary, source) if summary.is_file() else {}
    parts = (path / name for name in (CONFIG, METRICS, SUMMARY, CHECKPOINTS))  # what the run itself writes
    written = max(part.stat().st_mtime for part in parts if part.exists())
    error = ""
    if log.is_file() and log.stat().st_mtime >= written:
        error = log.read_text(errors="replace").strip().rpartition("\n")[2]
    return Run(
        path=path,
        config=config,
        config_text=config_path.read_text(),
        train=records.get("train", []),
        rollout=records.get("rollout", []),
        evaluations=sorted(records.get("evaluation", []), key=lambda e: float(e["env_steps"])),
        result=result,
        written=written,
        error=error,
        videos=tuple(sorted(path.glob("*.mp4"))),
    )


def _records(path: Path, source: FileSource) -> dict[str, list[Record]]:
    """Records by their kind, those of complete lines."""
    records: dict[str, list[Record]] = {}
    if not path.is_file():
        return records
    lines = path.read_bytes().split(b"\n")[:-1]
    for number, text in enumerate(lines, start=1):
        try:
            record = json.loads(text)
            records.setdefault(record["kind"], []).append(record)
        except (ValueError, KeyError, TypeError) as error:
            why = f"line {number} is no record ({in_one_line(error)}); remove it"
            raise source.refuse(path.name, why) from error
    return records


def column(records: Sequence[Record], name: str) -> np.ndarray:
    """One number of each record, float64; NaN where it is missing."""
    return np.array([record.get(name) for record in records], dtype=np.float64)


def finite(records: Sequence[Record], name: str) -> np.ndarray:
    """The finite values of this number."""
    values = column(records, name)
    return values[np.isfinite(values)]


def newest(records: Sequence[Record], name: str) -> float | None:
    """The last finite value of this number."""
    values = finite(records, name)
    if not len(values):
        return None
    return float(values[-1])


def differences(trees: Sequence[Mapping[str, Any]]) -> list[tuple[str, list[Any]]]:
    """Fields in which configs differ, with the value of each; a dash where one does not have it."""
    flats = [dict(leaves(tree)) for tree in trees]
    rows = []
    for name in dict.fromkeys(itertools.chain(*flats)):
        values = [fields.get(name, ABSENT) for fields in flats]
        if name not in PLACES and any(value != values[0] for value in values):
            rows.append((name, values))
    return rows


def changed_fields(tree: Mapping[str, Any]) -> list[tuple[str, list[Any]]]:
    """Fields of a config that differ from the defaults, with value and default."""
    fields = dict(leaves(tree))
    return [row for row in differences([tree, encode(RunConfig())]) if row[0] in fields]
