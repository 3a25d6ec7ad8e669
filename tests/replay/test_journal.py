# SPDX-License-Identifier: Apache-2.0
"""The journal of real episodes, on disk."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import IMAGINED, Segment, SegmentStart
from accerl_lerobot.replay.buffer import Replay, ReplayConfig
from accerl_lerobot.replay.journal import Journal, read_journal, whole_episodes
from tests.replay.segments import make_segment


def part(key: str, seed: int, decision: int, n: int = 2, **fields: Any) -> Segment:
    rng = np.random.default_rng(seed + decision)
    steps = np.array([3] * (n - 1) + [2], np.int64)
    return make_segment(
        key,
        n=n,
        version=list(range(n)),
        origin=SegmentStart("push-v3", seed, decision),
        actions=rng.standard_normal((n, 3, 2)).astype(np.float32),
        steps=steps,
        reward=rng.standard_normal(n).astype(np.float32),
        **fields,
    )


def test_what_is_written_is_read(tmp_path: Path):
    first, second = part("a", 5, 0), part("b", 5, 2, n=1, terminated=True, success=True)
    journal = Journal(tmp_path / "episodes.jsonl")
    journal.write(first)
    journal.write(second)
    found = list(read_journal(tmp_path / "episodes.jsonl"))
    assert [d.key for d in found] == ["a", "b"] and found[1].origin == SegmentStart("push-v3", 5, 2)
    assert found[0].steps == (3, 2) and found[0].versions == (0, 1) and not found[0].ended
    assert found[1].ended and found[1].success
    # Of the last chunk two of three actions were executed.
    expected = np.concatenate([first.actions[0], first.actions[1][:2]])
    np.testing.assert_array_equal(found[0].actions, expected)
    np.testing.assert_array_equal(np.float32(found[0].rewards), first.reward)


def test_only_what_replay_stores_is_written_and_a_cut_forgets(tmp_path: Path):
    path = tmp_path / "episodes.jsonl"
    config = ReplayConfig(capacity=40, min_decisions=4, max_unlearned_decisions=20)
    replay = Replay(config, Journal(path))
    broken = part("c", 3, 0)
    broken.reward[0] = np.nan
    for segment in (part("a", 1, 0), broken, part("d", 1, 0, source=IMAGINED)):
        replay.insert(segment)
    assert [d.key for d in read_journal(path)] == ["a"]
    state = replay.state()
    replay.insert(part("b", 2, 0))
    again = Replay(config, Journal(path))
    again.restore(state)
    again.insert(part("e", 4, 0))
    assert [d.key for d in read_journal(path)] == ["a", "e"]
    path.write_bytes(b"")  # lost, as after a pull without it
    late = Replay(config, Journal(path))
    late.restore(state)
    late.insert(part("f", 4, 0))
    assert [d.key for d in read_journal(path)] == ["f"]


def test_whole_episodes_are_found_among_others(tmp_path: Path):
    journal = Journal(tmp_path / "episodes.jsonl")
    for segment in (
        part("a1", 1, 0),
        part("b1", 2, 0),
        part("a2", 1, 2, terminated=True),
        part("c2", 3, 2, terminated=True),  # the first part of which never came
        part("g1", 4, 0),  # two of a group, which start alike
        part("g2", 4, 2, terminated=True),
        part("h1", 4, 0, n=1),
        part("h2", 4, 1, terminated=True),
        part("b2", 2, 2),  # still under way
    ):
        journal.write(segment)
    found = whole_episodes(read_journal(tmp_path / "episodes.jsonl"))
    assert [[d.key for d in episode] for episode in found] == [["a1", "a2"], ["g1", "g2"], ["h1", "h2"]]


def test_a_torn_last_line_is_left_out_and_a_broken_one_is_named(tmp_path: Path):
    path = tmp_path / "episodes.jsonl"
    journal = Journal(path)
    journal.write(part("a", 1, 0))
    journal.write(part("b", 1, 2))
    whole = path.read_bytes()
    path.write_bytes(whole[:-9])
    assert [d.key for d in read_journal(path)] == ["a"]
    line = json.loads(whole.splitlines()[0])
    for change in (
        {"actions": "####"}, {"action_dim": 0}, {"steps": [1]},  {"seed": None},
        {"rewards": 3}, {"seed": math.inf}, {"decision": math.nan},
    ):  # fmt: skip
        path.write_bytes(json.dumps(line | change).encode() + b"\n" + whole)
        with pytest.raises(InputError, match="line 1 is not as a run writes it"):
            list(read_journal(path))
    with pytest.raises(InputError, match=r"no episodes.jsonl there; name the folder of an accerl train run"):
        list(read_journal(tmp_path / "nowhere" / "episodes.jsonl"))
