# SPDX-License-Identifier: Apache-2.0
"""The mismatch between acting and learning, with mismatches that were planted."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from accerl_lerobot.algorithms import GIPOConfig
from accerl_lerobot.algorithms.batch import collate
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.algorithms.probe import Probe
from accerl_lerobot.algorithms.ratio_update import RatioUpdate
from accerl_lerobot.experience import Segment
from tests.algorithms.linear import LinearAdapter, decided_by, make_segments

CONFIG = TrainerConfig(
    updates=100, lr=5e-2, value_lr=1e-2, warmup_updates=0, value_warmup_updates=0, probe_every=3
)
NAMES = ["logprob/mismatch_mean", "logprob/mismatch_max", "logprob/mismatch_clip"]
LENGTHS = (3, 5, 1, 4)


def make_update(config: TrainerConfig = CONFIG) -> RatioUpdate:
    return RatioUpdate(LinearAdapter(), GIPOConfig(), config)


def fresh(update: RatioUpdate, seed: int = 0) -> list[Segment]:
    """Decisions of the weights of now."""
    return decided_by(update.adapter, make_segments(LENGTHS, seed=seed), update.version)


def read(metrics: dict[str, float]) -> list[float] | None:
    """Mean, maximum and clipped share, if there is a reading."""
    found = [metrics[name] for name in NAMES if name in metrics]
    assert len(found) in (0, 3)
    return found or None


def readings(update: RatioUpdate, updates: int) -> list[int]:
    """Updates, counted from 1, at which fresh decisions gave a reading, all of them 0."""
    found = []
    for i in range(updates):
        metrics = update.step(fresh(update, i))
        if "logprob/mismatch_max" in metrics:
            assert metrics["logprob/mismatch_max"] <= 1e-4
            found.append(i + 1)
    return found


def shifted(segments: list[Segment], by: float) -> list[Segment]:
    """log μ of each decision off by `by`, half of it in each factor."""
    for segment in segments:
        segment.log_prob = segment.log_prob - np.float32(by / 2)
    return segments


@pytest.mark.parametrize(
    ("by", "clipped"), [(0.15, 0.0), (-0.15, 0.0), (0.19, 1.0), (-0.22, 0.0), (-0.23, 1.0), (3.0, 1.0)]
)
def test_a_planted_mismatch_is_found(by: float, clipped: float):
    """The whole decision's ratio, though the algorithm has one for each factor: exp(0.19) is outside 1 ± 0.2,
    exp(−0.22) is not."""
    update = make_update()
    found = read(update.step(shifted(fresh(update), by)))
    assert found == pytest.approx([abs(by), abs(by), clipped], abs=1e-4)


def test_mean_maximum_and_share_are_of_decisions():
    """5 decisions of 13 are off by 0.5 and 4 by −0.1, which do not cancel."""
    update = make_update()
    segments = fresh(update)
    shifted(segments[1:2], 0.5)
    shifted(segments[3:], -0.1)
    found = read(update.step(segments))
    assert found == pytest.approx([(5 * 0.5 + 4 * 0.1) / 13, 0.5, 5 / 13], abs=1e-4)


@pytest.mark.parametrize("micro_batch", [1, 4, 1000])
def test_only_decisions_of_the_probed_version_count(micro_batch: int):
    update = make_update(replace(CONFIG, micro_batch=micro_batch))
    segments = shifted(fresh(update), 0.1)
    segments[1].version[2:] = 1  # from the future, for this test
    segments[1].log_prob[2:] += 7.0
    segments[2].version[:] = 5
    segments[2].log_prob[:] = 100.0
    assert read(update.step(segments)) == pytest.approx([0.1, 0.1, 0.0], abs=1e-4)


def test_decisions_are_scored_under_the_weights_that_made_them():
    """They come four updates late, when the policy has left them far behind."""
    update = make_update()
    late = shifted(fresh(update, seed=9), 0.1)
    for i in range(4):
        assert read(update.step(decided_by(update.adapter, make_segments(LENGTHS, seed=i), -1))) is None
    metrics = update.step(late)
    assert read(metrics) == pytest.approx([0.1, 0.1, 0.0], abs=1e-4)
    assert metrics["ratio_max_dev"] > 0.3


def test_readings_come_every_so_many_updates():
    assert readings(make_update(), 10) == [1, 4, 7, 10]
    assert readings(make_update(replace(CONFIG, probe_every=1)), 4) == [1, 2, 3, 4]
    assert readings(make_update(replace(CONFIG, probe_every=0)), 4) == [], "it is off"


def test_a_version_that_never_acted_is_given_up_for_the_newest():
    update = make_update()
    later = [decided_by(update.adapter, make_segments((4, 4, 4), seed=i), 0) for i in range(2)]
    for segments in later:
        segments[0].version[:], segments[1].version[:], segments[2].version[:] = -3, -2, 1
    assert read(update.step(later[0])) is None
    later[1][1].version[:] = 1  # now most of the batch is newer than version 0
    assert read(update.step(later[1])) is None
    assert read(update.step(fresh(update))) == pytest.approx([0.0] * 3, abs=1e-4)


def test_factors_that_a_latent_does_not_have_are_left_out():
    update = make_update()
    segments = make_segments(LENGTHS)
    for segment in segments:
        segment.latent["count"] = np.ones(len(segment), np.int64)
    decided_by(update.adapter, segments, 0)
    for segment in segments:
        segment.log_prob[:, 0] -= 0.1
        segment.log_prob[:, 1] = math.nan
    assert read(update.step(segments)) == pytest.approx([0.1, 0.1, 0.0], abs=1e-4)


def test_measuring_changes_nothing_that_is_learnt():
    with_, without = make_update(replace(CONFIG, probe_every=1)), make_update(replace(CONFIG, probe_every=0))
    for i in range(5):
        metrics = with_.step(fresh(with_, i))
        expected = without.step(fresh(without, i))
        assert {k: v for k, v in metrics.items() if k not in NAMES} == expected
    assert all(torch.equal(p, without.adapter.copy()[k]) for k, p in with_.adapter.copy().items())


def test_the_live_weights_are_back_in_their_own_memory_whatever_happens(monkeypatch: pytest.MonkeyPatch):
    adapter, batch = LinearAdapter(), collate(make_segments(LENGTHS))
    probe = Probe(adapter, CONFIG)
    with torch.no_grad():
        adapter.weight.add_(0.3)
    before, place = adapter.copy(), adapter.weight.data_ptr()

    def evaluate(*_: Any) -> None:
        assert not torch.equal(adapter.weight, before["policy.weight"])
        raise MemoryError("too many rows")

    monkeypatch.setattr(adapter, "evaluate", evaluate)
    with pytest.raises(MemoryError):
        probe.read(batch)
    assert all(torch.equal(p, before[k]) for k, p in adapter.trainable().items())
    assert adapter.weight.data_ptr() == place and adapter.weight.grad is None
