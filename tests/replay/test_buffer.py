# SPDX-License-Identifier: Apache-2.0
"""The store: order, bounds, age, and books that balance; the journal of real episodes on disk."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import IMAGINED, REAL, Segment, SegmentStart
from accerl_lerobot.replay.buffer import Replay, ReplayConfig
from accerl_lerobot.replay.journal import Journal, read_journal, whole_episodes
from tests.replay.segments import assert_books_balance, make_segment


def make_replay(**settings: Any) -> Replay:
    return Replay(
        ReplayConfig(
            **{"capacity": 40, "min_decisions": 4, "max_unlearned_decisions": 20, "max_lag": 5, **settings}
        )
    )


def keys(segments: list[Any]) -> list[str]:
    return [s.key for s in segments]


def test_the_oldest_leave_first_and_by_decisions() -> None:
    replay = make_replay(capacity=10, max_unlearned_decisions=10)
    for i, n in enumerate([4, 4, 3]):
        assert replay.insert(make_segment(f"k{i}", n))
    assert replay.stored_decisions == 7 and replay.counters.removed_decisions == 4
    assert sorted(keys(replay.sample(7, 0, np.random.default_rng(0)))) == ["k1", "k2"]
    assert replay.counters.evicted_unused == 1
    assert_books_balance(replay)


@pytest.mark.parametrize(("field", "bad"), [("log_prob", np.nan), ("latent", -np.inf)])
def test_nonfinite_segments_are_dropped_and_counted(field: str, bad: float) -> None:
    replay = make_replay()
    segment = make_segment("a")
    target = getattr(segment, field)
    array = next(iter(target.values())) if isinstance(target, dict) else target
    array.flat[1] = bad
    assert not replay.insert(segment)
    assert replay.counters.dropped_nonfinite == 1 and replay.counters.inserted_segments == 0


def test_the_least_used_are_drawn_first() -> None:
    replay = make_replay(samples_per_insert=3.0)
    rng = np.random.default_rng(0)
    replay.insert(make_segment("old"))
    assert keys(replay.sample(4, 0, rng)) == ["old"]
    replay.insert(make_segment("new"))
    assert keys(replay.sample(4, 0, rng)) == ["new"]
    assert sorted(keys(replay.sample(8, 0, rng))) == ["new", "old"]
    assert [e.uses for e in replay._entries] == [2, 2]
    assert replay.counters.trained_decisions == 16 and replay.counters.unique_decisions == 8


def test_whole_segments_until_there_are_enough() -> None:
    replay = make_replay()
    for i in range(5):
        replay.insert(make_segment(f"k{i}", 3))
    drawn = replay.sample(7, 0, np.random.default_rng(0))
    assert len(drawn) == 3 and len(set(keys(drawn))) == 3
    assert replay.sample(7, 0, np.random.default_rng(0)) == []  # 6 are left
    assert replay.counters.trained_decisions == 9
    assert len(replay.sample(6, 0, np.random.default_rng(0))) == 2


@pytest.mark.parametrize(("per_insert", "expected"), [(1.0, [1] * 8), (2.0, [2] * 8), (1.5, [1, 2] * 4)])
def test_each_segment_is_drawn_as_often_as_its_share(per_insert: float, expected: list[int]) -> None:
    replay = make_replay(samples_per_insert=per_insert)
    for i in range(8):
        replay.insert(make_segment(f"k{i}"))
    rng = np.random.default_rng(0)
    while replay.sample(4, 0, rng):
        pass
    assert [e.uses for e in replay._entries] == expected
    assert replay.available_decisions == 0 and replay.stored_decisions == 32
    assert replay.counters.trained_decisions == per_insert * 32


def test_nothing_older_than_max_lag_is_drawn() -> None:
    replay = make_replay(max_lag=5, samples_per_insert=2.0)
    replay.insert(make_segment("mixed", version=[4, 9, 9, 9]))
    replay.insert(make_segment("edge", version=5))
    rng = np.random.default_rng(0)
    assert keys(replay.sample(4, 10, rng)) == ["edge"]  # lag 5 is allowed, one decision with lag 6 is not
    assert replay.counters.removed_segments == 1 and replay.counters.retired_unused == 1
    assert replay.sample(4, 11, rng) == []
    assert replay.counters.removed_segments == 2 and replay.counters.retired_unused == 1
    assert_books_balance(replay)


def carried(replay: Replay, version: int | None, folder: Path) -> Replay:
    """A new store that goes on from what this one saves."""
    snapshot.save(folder / "replay", replay.state(version))
    resumed = Replay(replay.config)
    resumed.restore(snapshot.load(folder / "replay"))
    return resumed


def test_what_is_saved_goes_on_as_if_it_had_never_been(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    replay = make_replay(capacity=16, max_unlearned_decisions=16, samples_per_insert=1.5)
    for i in range(6):
        replay.insert(make_segment(f"k{i}"))
    replay.sample(8, 0, rng)
    before = replay.metrics()
    resumed = carried(replay, None, tmp_path)
    assert replay.metrics() == before == resumed.metrics(), "asking changes nothing"
    for store in (replay, resumed):
        store.insert(make_segment("k9"))
    drawn = [keys(store.sample(12, 1, np.random.default_rng(1))) for store in (replay, resumed)]
    assert drawn[0] == drawn[1] and replay.metrics() == resumed.metrics()
    assert_books_balance(resumed)


@pytest.mark.parametrize("seed", range(6))
def test_batches_that_were_drawn_and_not_learnt_from_do_not_count(seed: int, tmp_path: Path) -> None:
    """Beside a store that was never asked for them."""
    rng = np.random.default_rng(seed)
    replay, other = (make_replay(capacity=24, samples_per_insert=1.7) for _ in range(2))
    left_at = int(rng.integers(2, 12))
    for version in range(left_at + 4):
        for number in range(rng.integers(1, 4)):
            for store in (replay, other):
                store.insert(make_segment(f"{version}.{number}", n=4, version=version))
        replay.sample(8, version, np.random.default_rng(version))
        if version < left_at:
            other.sample(8, version, np.random.default_rng(version))
        other.retire(version)
    resumed = carried(replay, left_at, tmp_path)
    assert resumed.metrics() == other.metrics()
    assert [e.uses for e in resumed._entries] == [e.uses for e in other._entries]
    assert [e.segment.key for e in resumed._entries] == [e.segment.key for e in other._entries]
    assert_books_balance(resumed)


def fill(replay: Replay, source: str, count: int) -> None:
    for i in range(count):
        assert replay.insert(make_segment(f"{source}{i}", 4, source=source))


def test_real_and_imagined_decisions_are_counted_apart() -> None:
    replay = make_replay(samples_per_insert=2.0)
    fill(replay, REAL, 2)
    fill(replay, IMAGINED, 1)
    assert (replay.counters.inserted_decisions, replay.counters.inserted_imagined) == (12, 4)
    replay.sample(12, 0, np.random.default_rng(0))
    replay.sample(12, 1, np.random.default_rng(0))
    assert (replay.counters.trained_decisions, replay.counters.trained_imagined) == (24, 8)
    taken_back = replay.state(1)["counters"]
    assert (taken_back.trained_decisions, taken_back.trained_imagined) == (12, 4)


def test_the_last_of_few_episodes_are_a_batch_although_a_smaller_one() -> None:
    replay = make_replay(samples_per_insert=2.0)
    fill(replay, REAL, 3)
    assert not replay.sample(16, 0, np.random.default_rng(0)) and not replay.exhausted(16), "more may come"
    replay.ended = True
    for _ in range(2):
        assert replay.may_sample(16)
        assert sum(map(len, replay.sample(16, 0, np.random.default_rng(0)))) == 12
    assert replay.exhausted(16)
    least = make_replay()
    fill(least, REAL, 1)
    least.ended = True
    assert not least.may_sample(16) and least.exhausted(16), "a quarter is none"


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
    assert found[0].steps == [3, 2] and found[0].versions == [0, 1] and not found[0].ended
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
    broken.log_prob[0] = np.nan
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


def test_a_torn_last_line_is_left_out_and_a_broken_one_is_an_error(tmp_path: Path):
    path = tmp_path / "episodes.jsonl"
    journal = Journal(path)
    journal.write(part("a", 1, 0))
    journal.write(part("b", 1, 2))
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
