# SPDX-License-Identifier: Apache-2.0
"""The store: order, bounds, age, and books that balance."""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.experience import IMAGINED, REAL
from accerl_lerobot.replay.buffer import DRAWS, MixedReplay, Replay
from accerl_lerobot.replay.pacing import ReplayConfig
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
    assert replay.stored_decisions == 7 and replay.counters.evicted_decisions == 4
    assert sorted(keys(replay.sample(7, 0, np.random.default_rng(0)))) == ["k1", "k2"]
    assert replay.counters.evicted_unused == 1
    assert_books_balance(replay)


def test_one_large_segment_may_push_out_all_others() -> None:
    replay = make_replay(capacity=10, max_unlearned_decisions=10)
    for i in range(3):
        replay.insert(make_segment(f"k{i}", 3))
    replay.insert(make_segment("long", 10))
    assert len(replay.segments) == 1 and replay.counters.evicted_segments == 3
    assert_books_balance(replay)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("field", ["log_prob", "reward", "latent", "observations"])
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


def test_ties_are_broken_at_random_and_reproducibly() -> None:
    def first(seed: int) -> str:
        replay = make_replay()
        for key in "abcd":
            replay.insert(make_segment(key))
        return keys(replay.sample(1, 0, np.random.default_rng(seed)))[0]

    counts = Counter(first(seed) for seed in range(400))
    assert set(counts) == set("abcd") and min(counts.values()) > 60
    assert [first(s) for s in range(5)] == [first(s) for s in range(5)]


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
    assert replay.counters.retired_segments == 1 and replay.counters.retired_unused == 1
    assert replay.sample(4, 11, rng) == []
    assert replay.counters.retired_segments == 2 and replay.counters.retired_unused == 1
    assert_books_balance(replay)


def test_a_trainer_that_resumed_behind_its_samples_retires_nothing() -> None:
    replay = make_replay()
    replay.insert(make_segment("a", version=30))
    assert keys(replay.sample(4, 10, np.random.default_rng(0))) == ["a"]


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


@pytest.mark.parametrize("seed", range(20))
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
    assert keys(resumed.segments) == keys(other.segments)
    assert_books_balance(resumed)


def test_what_is_too_long_ago_cannot_be_taken_back() -> None:
    replay = make_replay(samples_per_insert=10_000.0)
    replay.insert(make_segment("a"))
    for version in range(DRAWS + 5):
        replay.sample(4, 3 if version else 0, np.random.default_rng(0))
    assert replay.state(4)["entries"][0]["uses"] == DRAWS + 5
    with pytest.raises(RuntimeError, match=f"more than {DRAWS} batches since update 3"):
        replay.state(3)


def mixed(share: float = 0.5, patient: bool = False, **imagined: Any) -> MixedReplay:
    real = ReplayConfig(
        capacity=100, min_decisions=8, samples_per_insert=2.0, max_unlearned_decisions=16, max_lag=5
    )
    config = {
        "capacity": 100,
        "min_decisions": 1,
        "samples_per_insert": 1.0,
        "max_unlearned_decisions": 16,
        "max_lag": 5,
    }
    return MixedReplay(real, ReplayConfig(**(config | imagined)), share, patient)


def fill(replay: MixedReplay, source: str, count: int, version: int = 0) -> None:
    for i in range(count):
        assert replay.insert(make_segment(f"{source}{i}", 4, version, source=source))


def drawn(replay: MixedReplay, count: int, version: int = 0) -> dict[str, int]:
    segments = replay.sample(count, version, np.random.default_rng(0))
    return {s: sum(len(x) for x in segments if x.source == s) for s in (REAL, IMAGINED)}


def test_a_batch_is_of_both_and_waits_for_both():
    replay = mixed()
    fill(replay, REAL, 4)
    assert not replay.may_sample(16) and drawn(replay, 16) == {REAL: 0, IMAGINED: 0}
    assert replay.real.counters.trained_decisions == 0, "nothing is used up by waiting"
    fill(replay, IMAGINED, 1)
    assert not replay.may_sample(16)
    replay.insert(make_segment("more", 4, source=IMAGINED))
    assert replay.may_sample(16) and drawn(replay, 16) == {REAL: 8, IMAGINED: 8}


def test_either_door_has_its_own_pace():
    replay = mixed()
    fill(replay, REAL, 4)
    assert not replay.may_insert(REAL) and replay.may_insert(IMAGINED)
    fill(replay, IMAGINED, 4)
    assert not replay.may_insert(IMAGINED)
    assert replay.metrics()["imagined_stored_decisions"] == replay.metrics()["stored_decisions"] == 16


def test_once_all_real_episodes_are_in_they_are_used_up_and_dreams_go_on():
    replay = mixed()
    fill(replay, REAL, 1)
    fill(replay, IMAGINED, 4)
    assert not replay.may_sample(8), "fewer than the warm start asks for"
    replay.real_ended = True
    assert drawn(replay, 8) == {REAL: 4, IMAGINED: 4}
    assert drawn(replay, 8) == {REAL: 4, IMAGINED: 4}, "twice, as samples_per_insert says"
    assert drawn(replay, 8) == {REAL: 0, IMAGINED: 8}
    assert not replay.may_sample(8) and not replay.exhausted(8), "imagined rollouts will come"


def test_where_real_episodes_are_counted_they_are_kept_for_when_there_are_dreams():
    for patient in (False, True):
        replay = mixed(patient=patient)
        fill(replay, REAL, 4)
        replay.share, replay.awaited = 0.0, True
        assert replay.may_sample(16) is not patient and not replay.exhausted(16)
        assert replay.may_insert(REAL) is patient, "more are let in meanwhile"
        fill(replay, IMAGINED, 2)
        replay.share, replay.awaited = 0.5, True
        assert drawn(replay, 16) == {REAL: 8, IMAGINED: 8}
        replay.share, replay.awaited = 0.0, False
        assert drawn(replay, 16) == {REAL: 16, IMAGINED: 0}, "none will come"


def test_patience_ends_when_there_is_no_room_for_more():
    replay = mixed(patient=True)
    replay.share, replay.awaited = 0.0, True
    inserted = 0
    while not replay.may_sample(16):
        assert replay.may_insert(REAL) and inserted < 40
        replay.insert(make_segment(f"{inserted}", 4))
        inserted += 1
    assert inserted == 23 and replay.real.counters.evicted_segments == 0
    assert drawn(replay, 16) == {REAL: 16, IMAGINED: 0} and not replay.may_insert(REAL)


def test_it_is_exhausted_when_nothing_will_come():
    replay = mixed(share=0.0)
    fill(replay, REAL, 3)
    assert not replay.exhausted(12)
    replay.real_ended = True
    for _ in range(2):
        assert not replay.exhausted(12) and drawn(replay, 12) == {REAL: 12, IMAGINED: 0}
    assert replay.exhausted(12) and drawn(replay, 12) == {REAL: 0, IMAGINED: 0}
    imagining = mixed()
    imagining.real_ended = True
    assert not imagining.exhausted(8)
    imagining.share, imagining.awaited = 0.0, True  # the world model is being learnt
    assert not imagining.exhausted(8)
    imagining.share, imagining.awaited = 0.0, False  # the kill switch
    assert imagining.exhausted(8)
    imagining.share, imagining.awaited = 0.5, True
    assert not imagining.exhausted(8)


def test_what_is_too_old_for_one_part_costs_the_other_nothing():
    replay = mixed()
    fill(replay, REAL, 4, version=10)
    fill(replay, IMAGINED, 4, version=0)
    assert replay.may_sample(16) and drawn(replay, 16, version=10) == {REAL: 0, IMAGINED: 0}
    assert replay.real.counters.trained_decisions == 0 and replay.imagined.counters.retired_segments == 4


def test_real_episodes_that_are_counted_wait_for_what_has_to_learn_from_those_before():
    for patient in (False, True):
        replay = mixed(patient=patient)
        fill(replay, REAL, 1)
        assert replay.may_insert(REAL)
        replay.held = True
        assert replay.may_insert(REAL) is not patient and replay.may_insert(IMAGINED)
        replay.held = False
        assert replay.may_insert(REAL)


def test_the_last_of_few_real_episodes_are_a_batch_although_a_smaller_one():
    replay = mixed(share=0.0)
    fill(replay, REAL, 3)
    assert not replay.may_sample(16), "more may come"
    replay.real_ended = True
    assert replay.may_sample(16) and drawn(replay, 16) == {REAL: 12, IMAGINED: 0}
    assert drawn(replay, 16) == {REAL: 12, IMAGINED: 0}, "twice, as samples_per_insert says"
    assert replay.exhausted(16)
    least = mixed(share=0.0)
    fill(least, REAL, 1)
    least.real_ended = True
    assert not least.may_sample(16) and least.exhausted(16), "a quarter is none"
