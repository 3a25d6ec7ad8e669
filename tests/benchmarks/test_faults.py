# SPDX-License-Identifier: Apache-2.0
"""Faults: orders are carried out once, and the books of a run that was hit."""

import json
import os
import re
from pathlib import Path

import pytest

import accerl_lerobot
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import CHECKPOINTS, TRAINING_STATE, save_checkpoint
from accerl_lerobot.replay.buffer import Replay, ReplayConfig
from accerl_lerobot.replay.journal import EPISODES, Journal
from benchmarks import fault_injection
from benchmarks.audit import audit_segments, audit_updates
from benchmarks.fault_injection import CRASHES, POINTS, FaultError, handle, inject, proof
from benchmarks.faults import BenchFaultsConfig, bench_faults
from benchmarks.hits import ANYWHERE, FAULTS, places
from benchmarks.victims import CLASSES
from tests.replay.segments import make_segment


@pytest.mark.parametrize(
    ("updates", "inserted", "found"),
    [
        ([1, 2, 3, 4], 9, {"updates": 4, "lost": 0, "doubled": 0, "books": True}),
        ([1, 2, 2, 5, 5, 5], 8, {"updates": 5, "lost": 2, "doubled": 3, "books": False}),
    ],
)
def test_what_is_lost_or_doubled_is_found(updates: list[int], inserted: int, found: dict):
    books = {"replay_inserted_segments": inserted, "replay_stored_segments": 3, "replay_removed_segments": 6}
    records = [{"kind": "train", "update": number} for number in updates]
    assert audit_updates([*records, {"kind": "rollout", **books}]) == found


def test_segments_that_counted_are_in_the_journal_once(tmp_path: Path):
    """Four segments are in a checkpoint's replay, and one came later."""
    sizes = ReplayConfig(capacity=12, min_decisions=4, max_unlearned_decisions=4)
    replay = Replay(sizes, Journal(tmp_path / EPISODES))
    for key in "abcd":  # the first has left when the last comes
        replay.insert(make_segment(key))

    def write(folder: Path) -> int:
        snapshot.save(folder / TRAINING_STATE / "replay", {"replay": replay.state()})
        snapshot.save(folder / TRAINING_STATE / "run", {})
        (folder / "pretrained_model").mkdir()
        return 3

    save_checkpoint(tmp_path / CHECKPOINTS, write)
    replay.insert(make_segment("e"))
    found = audit_segments(tmp_path)
    assert found == {"saved": "000003", "segments": 4, "segments_lost": 0, "segments_doubled": 0}


def test_every_point_is_somewhere_that_a_target_can_be_hit():
    targets = [*CLASSES, "driver", "everything"]
    found = {place for target in targets for fault in FAULTS for place in places(target, fault)}
    assert found == {ANYWHERE, *POINTS}


@pytest.mark.slow
def test_a_run_of_time_survives_what_is_done_to_it(tmp_path: Path):
    """Everything real: a run, Ray, a rollout worker that raises where it was told to, and its successor."""
    root = tmp_path / "faults"
    config = BenchFaultsConfig(output_dir=str(root), targets=("rollout",), faults=("exception",), repeats=1)
    result = bench_faults(config)
    (one,), (run,) = result["hits"], result["runs"]
    assert one["fired"] and one["outcome"] == "survived" and one["books"] and one["seconds"] > 0, one
    assert (run["exit"], run["left_behind"], run["skipped_updates"]) == (143, 0, 0)
    assert run["lost"] == run["doubled"] == run["segments_lost"] == run["segments_doubled"] == 0
    assert run["books"] and run["segments"] > 0
    assert json.loads((root / "faults.json").read_text())["hits"] == result["hits"]


def test_it_happens_at_the_visit_that_was_ordered_and_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(fault_injection, "_orders", fault_injection._Orders(tmp_path))
    taken = inject(tmp_path, "1", "replay.insert", "exception", at=3)
    assert not handle("replay.insert") and not handle("replay.insert") and proof(taken) is None
    with pytest.raises(FaultError, match=r"replay\.insert"):
        handle("replay.insert")
    said = proof(taken)
    assert said is not None and said["pid"] == os.getpid() and said["point"] == "replay.insert"
    handle("replay.insert")
    inject(tmp_path, "2", "replay.insert", "exception")
    with pytest.raises(FaultError):  # visits are counted from the order on
        handle("replay.insert")
    inject(tmp_path, "3", "trainer.loss", "nan", at=2, times=3)
    assert [handle("trainer.loss") for _ in range(6)] == [False, True, True, True, False, False]


def test_every_point_is_in_the_code_once_and_no_other_is():
    texts = [path.read_text() for path in Path(accerl_lerobot.__file__).parent.rglob("*.py")]
    found = [point for text in texts for point in re.findall(r'\bfault_point\("([a-z.]+)"', text)]
    # Every worker's timeline is written by the same line.
    assert sorted(found) == sorted(point for point in POINTS if not point.endswith(".timeline"))
    assert all(set(faults) <= {*CRASHES, "nan", "full", "torn"} for faults in POINTS.values())
