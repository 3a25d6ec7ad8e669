# SPDX-License-Identifier: Apache-2.0
"""Record of real exploring episodes: ``RUN/episodes.jsonl`` has a line per segment that replay has stored.

Pictures are not in it; an environment that is given the same seed and actions shows the same again, at every
env step and in any size. That is what ``accerl export`` does.
"""

from __future__ import annotations

import base64
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Segment, SegmentStart
from accerl_lerobot.fault_points import fault_point
from accerl_lerobot.metrics import cut_back

EPISODES = "episodes.jsonl"  # name of the file in a run's folder


@dataclass(frozen=True, kw_only=True)
class JournalEntry:
    """A segment as the journal knows it."""

    key: str
    origin: SegmentStart
    actions: np.ndarray  # float32 (env steps, A), as they were executed, one after the other
    steps: list[int]  # env steps of each decision; `rewards` have its cost taken off
    versions: list[int]
    rewards: list[float]
    ended: bool  # True if the episode ended with it
    success: bool


class Journal:
    """Appends; when `write` returns, a segment reaches the disk whatever becomes of this process."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file = path.open("ab")

    def save(self) -> int:
        """Has the disk hold it; the bytes so far."""
        os.fsync(self._file.fileno())
        return self._path.stat().st_size

    def write(self, segment: Segment) -> None:
        chunks = zip(segment.actions, segment.steps, strict=True)
        actions = np.concatenate([chunk[:steps] for chunk, steps in chunks])
        encoded = base64.b64encode(actions.astype("<f4").tobytes())
        line = {
            "key": segment.key,
            **segment.origin._asdict(),  # task, seed, decision
            "steps": segment.steps.tolist(),
            "versions": segment.version.tolist(),
            "rewards": segment.reward.tolist(),
            "ended": segment.terminated,
            "success": segment.success,
            "action_dim": segment.actions.shape[-1],
            "actions": encoded.decode(),
        }
        fault_point("replay.journal")
        text = json.dumps(line) + "\n"
        self._file.write(text.encode())
        self._file.flush()

    def cut(self, position: int) -> None:
        """Forgets all that was written after `position`."""
        cut_back(self._path, position)


def read_journal(path: Path) -> Iterator[JournalEntry]:
    """Reads a journal, in order; a last line that is half written is left out."""
    if not path.is_file():
        hint = f"no {path.name} there; name the folder of an accerl train run"
        raise InputError("path", str(path.parent), hint)
    with path.open("rb") as file:
        for line in file:
            if line.endswith(b"\n"):
                yield _entry(json.loads(line))


def _entry(line: dict[str, Any]) -> JournalEntry:
    encoded = base64.b64decode(line.pop("actions"), validate=True)
    actions = np.frombuffer(encoded, "<f4").reshape(sum(line["steps"]), line.pop("action_dim"))
    origin = SegmentStart(line.pop("task"), line.pop("seed"), line.pop("decision"))
    return JournalEntry(origin=origin, actions=actions, **line)


def whole_episodes(segments: Iterator[JournalEntry]) -> Iterator[list[JournalEntry]]:
    """Episodes of which all segments are there, in the order of their ends."""
    under_way: dict[tuple[str, int], list[JournalEntry]] = {}
    for segment in segments:
        task, seed, decision = segment.origin
        under_way.setdefault((task, seed), []).append(segment)
        if segment.ended:
            episode = under_way.pop((task, seed))
            if sum(len(part.steps) for part in episode[:-1]) == decision:  # else some are missing
                yield episode
