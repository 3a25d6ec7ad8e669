# SPDX-License-Identifier: Apache-2.0
"""Audit of a run's own files: was anything that counted lost, or counted twice?

updates      each is in ``metrics.jsonl`` once, and none is missing before the newest
books        inserted = stored + removed, as replay counts its segments
segments     those that the journal has up to the last checkpoint are those that replay had counted by
             then, each once; and all that the checkpoint stores are among them
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import CHECKPOINTS, TRAINING_STATE, newest_whole
from accerl_lerobot.errors import InputError
from accerl_lerobot.replay.buffer import ReplayCounters
from accerl_lerobot.replay.journal import EPISODES, read_journal

STORED = ("stored", "removed")


def audit_updates(records: list[dict[str, Any]]) -> dict[str, Any]:
    """``updates`` made, ``lost`` and ``doubled`` among them, and whether replay's ``books`` add up."""
    counts = Counter(int(record["update"]) for record in records if record["kind"] == "train")
    newest = max(counts, default=0)
    rollout = [record for record in records if record["kind"] == "rollout"]
    books = None
    if rollout:
        held = sum(rollout[-1].get(f"replay_{name}_segments", 0) for name in STORED)
        books = bool(rollout[-1]["replay_inserted_segments"] == held)
    return {
        "updates": newest,
        "lost": newest - len(counts),
        "doubled": sum(counts.values()) - len(counts),
        "books": books,
    }


def audit_segments(run: Path) -> dict[str, Any]:
    """Audits the newest whole checkpoint: its name as ``saved``, and ``segments``, ``segments_lost`` and
    ``segments_doubled`` of the journal up to then; ``saved`` alone says why where there is none.
    """
    try:
        checkpoint, _ = newest_whole(run / CHECKPOINTS)
    except InputError as error:
        return {"saved": str(error)}
    saved = snapshot.load(checkpoint / TRAINING_STATE / "replay")["replay"]
    cut = run / f".{EPISODES}.cut"
    try:
        cut.write_bytes((run / EPISODES).read_bytes()[: saved["journal"]])
        keys = Counter(segment.key for segment in read_journal(cut))
    finally:
        cut.unlink(missing_ok=True)
    counters: ReplayCounters = saved["counters"]
    counted = counters.inserted_segments
    stored = {entry["segment"].key for entry in saved["entries"]}
    return {
        "saved": checkpoint.name,
        "segments": counted,
        "segments_lost": max(counted - len(keys), len(stored - keys.keys())),
        "segments_doubled": keys.total() - len(keys) + max(0, len(keys) - counted),
    }
