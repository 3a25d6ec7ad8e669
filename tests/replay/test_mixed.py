# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

from typing import Any

import numpy as np

from accerl_lerobot.experience import IMAGINED, REAL
from accerl_lerobot.replay.buffer import MixedReplay
from accerl_lerobot.replay.pacing import ReplayConfig
from tests.replay.segments import make_segment


def mixed(share: float = 0.5, patient: bool = False, **imagined: Any) -> MixedReplay:
    real = ReplayConfig(capacity=100, min_decisions=8, samples_per_insert=2.0, ahead=16, max_lag=5)
    config = {"capacity": 100, "min_decisions": 1, "samples_per_insert": 1.0, "ahead": 16, "max_lag": 5}
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
