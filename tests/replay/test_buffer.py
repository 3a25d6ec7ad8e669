# SPDX-License-Identifier: Apache-2.0
"""The store: order, bounds, age, and books that balance; the journal of real episodes on disk."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import IMAGINED, Segment, SegmentStart
from accerl_lerobot.replay.buffer import Replay, ReplayConfig
from accerl_lerobot.replay.journal import Journal, read_journal, whole_episodes
from tests.replay.segments import assert_books_balance, make_segment


def make_replay(**settings: Any) -> Replay:
    defaults = {"capacity": 40, "min_decisions": 4, "max_unlearned_decisions": 20, "max_lag": 5}
    return Replay(ReplayConfig(**defaults | settings))


def draw(replay: Replay, decisions: int, version: int = 0) -> list[str]:
    return sorted(s.key for s in replay.sample(decisions, version, np.random.default_rng(version)))


def test_the_oldest_leave_first_and_by_decisions():
    replay = make_replay(capacity=10, max_unlearned_decisions=10)
    for i, n in enumerate([4, 4, 3]):
        assert replay.insert(make_segment(f"k{i}", n))
    assert replay.counters.removed_decisions == 4 and replay.counters.evicted_unused == 1
    assert draw(replay, 7) == ["k1", "k2"]
    assert_books_balance(replay)


def test_the_least_used_are_drawn_first():
    replay = make_replay(samples_per_insert=3.0)
    replay.insert(make_segment("old"))
    assert draw(replay, 4) == ["old"]
    replay.insert(make_segment("new"))
    assert draw(replay, 4) == ["new"]
    assert draw(replay, 8) == ["new", "old"]
    assert replay.counters.trained_decisions == 16 and replay.counters.unique_decisions == 8


@pytest.mark.parametrize(("per_insert", "expected"), [(1.0, [1] * 8), (2.0, [2] * 8), (1.5, [1, 2] * 4)])
def test_each_segment_is_drawn_as_often_as_its_share(per_insert: float, expected: list[int]):
    replay = make_replay(samples_per_insert=per_insert)
    for i in range(8):
        replay.insert(make_segment(f"k{i}"))
    drawn: Counter[str] = Counter()
    while batch := draw(replay, 4):
        drawn.update(batch)
    assert [drawn[f"k{i}"] for i in range(8)] == expected
    assert replay.available_decisions == 0 and replay.stored_decisions == 32
    assert replay.counters.trained_decisions == per_insert * 32


def test_nothing_older_than_max_lag_is_drawn():
    replay = make_replay(max_lag=5, samples_per_insert=2.0)
    replay.insert(make_segment("mixed", version=[4, 9, 9, 9]))
    replay.insert(make_segment("edge", version=5))
    assert draw(replay, 4, version=10) == ["edge"]  # lag 5 is allowed, one decision with lag 6 is not
    assert replay.counters.removed_segments == 1 and replay.counters.retired_unused == 1
    assert draw(replay, 4, version=11) == []
    assert replay.counters.removed_segments == 2 and replay.counters.retired_unused == 1
    assert_books_balance(replay)


@pytest.mark.parametrize("seed", range(6))
def test_what_is_saved_goes_on_as_if_batches_not_learnt_from_had_not_been_drawn(seed: int, tmp_path: Path):
    """Beside a store that was never asked for them."""
    rng = np.random.default_rng(seed)
    replay, other = (make_replay(capacity=24, samples_per_insert=1.7) for _ in range(2))
    left_at = int(rng.integers(2, 12))
    for version in range(left_at + 4):
        for number in range(rng.integers(1, 4)):
            for store in (replay, other):
                store.insert(make_segment(f"{version}.{number}", n=4, version=version))
        draw(replay, 8, version)
        if version < left_at:
            draw(other, 8, version)
        other.retire(version)
    before = replay.metrics()
    snapshot.save(tmp_path / "replay", replay.state(left_at))
    assert replay.metrics() == before, "asking changes nothing"
    resumed = Replay(replay.config)
    resumed.restore(snapshot.load(tmp_path / "replay"))
    for version in range(left_at + 4, left_at + 8):
        assert resumed.metrics() == other.metrics()
        for store in (resumed, other):
            store.insert(make_segment(str(version), n=4, version=version))
        assert draw(resumed, 4, version) == draw(other, 4, version)
    assert_books_balance(resumed)


def test_the_last_of_few_episodes_are_a_batch_although_a_smaller_one():
    replay = make_replay(samples_per_insert=2.0)
    for i in range(3):
        replay.insert(make_segment(str(i)))
    assert not draw(replay, 16) and not replay.exhausted(16), "more may come"
    replay.ended = True
    for _ in range(2):
        assert replay.may_sample(16)
        assert len(draw(replay, 16)) == 3
    assert replay.exhausted(16)
    least = make_replay()
    least.insert(make_segment("a"))
    least.ended = True
    assert not least.may_sample(16) and least.exhausted(16), "a quarter is none"


def part(key: str, seed: int, decision: int, n: int = 2, **fields: Any) -> Segment:
    rng = np.random.default_rng(seed + decision)
    fields |= {
        "actions": rng.standard_normal((n, 3, 2)).astype(np.float32),
        "steps": np.array([3] * (n - 1) + [2], np.int64),
        "reward": rng.standard_normal(n).astype(np.float32),
    }
    return make_segment(key, n, list(range(n)), origin=SegmentStart("push-v3", seed, decision), **fields)


def write(folder: Path, *segments: Segment) -> None:
    journal = Journal(folder / "episodes.jsonl")
    for segment in segments:
        journal.write(segment)


def test_what_is_written_is_read(tmp_path: Path):
    first, second = part("a", 5, 0), part("b", 5, 2, n=1, terminated=True, success=True)
    write(tmp_path, first, second)
    found = list(read_journal(tmp_path / "episodes.jsonl"))
    assert [d.key for d in found] == ["a", "b"] and found[1].origin == SegmentStart("push-v3", 5, 2)
    assert found[0].steps == [3, 2] and found[0].versions == [0, 1] and not found[0].ended
    assert found[1].ended and found[1].success
    # Of the last chunk two of three actions were executed.
    expected = np.concatenate([first.actions[0], first.actions[1][:2]])
    np.testing.assert_array_equal(found[0].actions, expected)
    np.testing.assert_array_equal(np.float32(found[0].rewards), first.reward)


def test_only_what_replay_stores_is_written_and_a_cut_forgets(tmp_path: Path):
    path = tmp_path / "episodes.jsonl"
    config = make_replay().config
    replay = Replay(config, Journal(path))
    broken, other = part("c", 3, 0), part("c", 4, 0)
    broken.log_prob[0], other.latent["x"][0] = np.nan, -np.inf
    stored = [replay.insert(s) for s in (part("a", 1, 0), broken, other, part("d", 1, 0, source=IMAGINED))]
    assert stored == [True, False, False, True] and replay.counters.dropped_nonfinite == 2
    assert [d.key for d in read_journal(path)] == ["a"]
    state = replay.state()
    replay.insert(part("b", 2, 0))
    again = Replay(config, Journal(path))
    again.restore(state)
    again.insert(part("e", 4, 0))
    assert [d.key for d in read_journal(path)] == ["a", "e"]
    path.write_bytes(b"")  # lost, as after a pull without it
    Replay(config, Journal(path)).restore(state)
    write(tmp_path, part("f", 4, 0))
    assert [d.key for d in read_journal(path)] == ["f"]


def test_whole_episodes_are_found_among_others(tmp_path: Path):
    write(
        tmp_path,
        part("a1", 1, 0),
        part("b1", 2, 0),
        part("a2", 1, 2, terminated=True),
        part("c2", 3, 2, terminated=True),  # the first part of which never came
        part("g1", 4, 0),  # two of a group, which start alike
        part("g2", 4, 2, terminated=True),
        part("h1", 4, 0, n=1),
        part("h2", 4, 1, terminated=True),
        part("b2", 2, 2),  # still under way
    )
    found = whole_episodes(read_journal(tmp_path / "episodes.jsonl"))
    assert [[d.key for d in episode] for episode in found] == [["a1", "a2"], ["g1", "g2"], ["h1", "h2"]]


def test_a_torn_last_line_is_left_out_and_a_broken_one_is_an_error(tmp_path: Path):
    path = tmp_path / "episodes.jsonl"
    write(tmp_path, part("a", 1, 0), part("b", 1, 2))
    whole = path.read_bytes()
    path.write_bytes(whole[:-9])
    assert [d.key for d in read_journal(path)] == ["a"]
    line = json.loads(whole.splitlines()[0])
    for change in ({"actions": "####"}, {"action_dim": 0}, {"steps": [1]}):
        path.write_bytes(json.dumps(line | change).encode() + b"\n" + whole)
        with pytest.raises(ValueError):
            list(read_journal(path))
    with pytest.raises(InputError, match=r"no episodes.jsonl there; name the folder of an accerl train run"):
        list(read_journal(tmp_path / "nowhere" / "episodes.jsonl"))
