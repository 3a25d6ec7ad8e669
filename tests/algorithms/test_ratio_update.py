# SPDX-License-Identifier: Apache-2.0
"""One update, on a policy small enough to compute by hand; the mismatch between acting and learning."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from accerl_lerobot.algorithms import GIPOConfig, PPOConfig
from accerl_lerobot.algorithms.batch import collate
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.algorithms.ratio_update import RatioUpdate
from accerl_lerobot.errors import MAX_NONFINITE, NonFiniteError
from accerl_lerobot.experience import Segment
from tests.algorithms.linear import STATE, LinearAdapter, decided_by, make_segments
from tests.algorithms.test_advantages import slow_gae
from tests.rounding import assert_close

PLAIN = TrainerConfig(
    updates=100, lr=1e-2, value_lr=1e-2, warmup_updates=0, value_warmup_updates=0, grad_clip=1e9
)
LENGTHS = (3, 5, 1, 4)


def make_update(config: TrainerConfig = PLAIN, kind: Any = GIPOConfig, **algorithm: Any) -> RatioUpdate:
    return RatioUpdate(LinearAdapter(), kind(**algorithm), config)


def test_collate_lays_segments_end_to_end():
    """Each decision beside the observation it was made on; the extra one is the bootstrap's."""
    segments = make_segments((2, 3), version=4)
    batch = collate(segments)
    one, two = (segment.observations[STATE] for segment in segments)
    np.testing.assert_array_equal(batch.observations[STATE], np.concatenate([one[:2], two[:3]]))
    np.testing.assert_array_equal(batch.last_observations[STATE], np.stack([one[2], two[3]]))
    assert batch.tasks == ["task 0.0"] * 2 + ["task 0.1"] * 3
    assert batch.segment_tasks == ["task 0.0", "task 0.1"]


@pytest.mark.parametrize("micro_batch", [1, 4, 5, 12, 13, 1000])
def test_micro_batches_give_the_gradient_of_the_whole_batch(micro_batch: int):
    whole, parts = make_update(), make_update(replace(PLAIN, micro_batch=micro_batch))
    segments = make_segments(LENGTHS)
    expected, found = whole.step(segments), parts.step(segments)
    for name, parameter in whole.adapter.trainable().items():
        other = parts.adapter.trainable()[name].grad
        assert parameter.grad is not None and parameter.grad.abs().max() > 1e-3
        assert_close(other, parameter.grad)
    for name in expected:
        assert found[name] == pytest.approx(expected[name], rel=1e-4, abs=1e-5), name
    assert found["decisions"] == sum(LENGTHS)


@pytest.mark.parametrize("kind", [GIPOConfig, PPOConfig])
@pytest.mark.parametrize("level", ["token", "chunk"])
def test_micro_batches_add_up_when_decisions_have_different_numbers_of_factors(kind: Any, level: str):
    segments = make_segments(LENGTHS)
    for segment in segments[:-1]:
        segment.latent["count"] = 1 + np.arange(len(segment)) % 2
    segments[-1].latent["count"] = np.full(len(segments[-1]), 2)
    whole, parts, blind = (
        make_update(replace(PLAIN, micro_batch=size), kind, level=level) for size in (1000, 5, 1000)
    )
    whole.step(segments)
    parts.step(segments)
    assert_close(parts.adapter.weight.grad, whole.adapter.weight.grad)
    blind.step(make_segments(LENGTHS))
    assert not torch.allclose(blind.adapter.weight.grad, whole.adapter.weight.grad, rtol=1e-2)


@pytest.mark.parametrize("micro_batch", [1000, 4])
def test_values_are_recomputed_bootstraps_included(micro_batch: int):
    update = make_update(replace(PLAIN, micro_batch=micro_batch), gamma=0.9, lam=0.8)
    segments = make_segments(LENGTHS)
    segments[1].terminated = True
    now = [update.adapter.values(s.observations, [s.task] * (len(s) + 1)).numpy() for s in segments]
    values, rewards = np.concatenate([v[:-1] for v in now]), np.concatenate([s.reward for s in segments])
    ended = [s.terminated for s in segments]
    returns = slow_gae(rewards, values, [v[-1] for v in now], ended, LENGTHS, 0.9, 0.8)[1]
    found = update.step(segments)
    assert found["return_mean"] == pytest.approx(np.mean(returns), abs=1e-4)
    assert found["value_loss"] == pytest.approx(np.square(values - returns).mean(), rel=1e-4)


def test_advantages_are_normalised_over_the_batch():
    """Neither the size of rewards nor a constant in all of them changes what the policy learns."""
    gradients = []
    for scale, shift in ((1.0, 0.0), (20.0, 7.0)):
        update = make_update(gamma=0.0)
        torch.nn.init.zeros_(update.adapter.value_head.weight)
        segments = make_segments(LENGTHS)
        for segment in segments:
            segment.reward = segment.reward * np.float32(scale) + np.float32(shift)
        update.step(segments)
        gradients.append(update.adapter.weight.grad)
    assert gradients[0].abs().max() > 1e-3
    assert_close(*gradients)


def test_learning_rates_fall_like_a_cosine():
    config = replace(PLAIN, updates=110, warmup_updates=10, final_lr_share=0.2)
    assert config.lr_share(9) == config.lr_share(10) == 1.0
    assert config.lr_share(35) == pytest.approx(0.2 + 0.8 * 0.5 * (1 + math.cos(math.pi / 4)))
    assert config.lr_share(110) == config.lr_share(500) == pytest.approx(0.2)


def test_the_optimiser_warms_up_to_its_rates():
    update = make_update(replace(PLAIN, lr=0.1, value_lr=0.01, warmup_updates=4, value_warmup_updates=2))
    rates = [update.step(make_segments(LENGTHS)) for _ in range(7)]
    assert [m["lr"] for m in rates] == pytest.approx([0.0, 0.0, 0.025, 0.05, 0.075, 0.1, 0.1])
    assert [m["value_lr"] for m in rates] == pytest.approx([0.0025, 0.005, 0.0075, 0.01, 0.01, 0.01, 0.01])
    assert [g["lr"] for g in update.optimizer.param_groups] == [0.1, 0.01]


def test_a_run_that_is_extended_keeps_the_schedule_that_it_began_with():
    config = replace(PLAIN, lr=0.1, updates=10, warmup_updates=2, final_lr_share=0.2)
    update = make_update(config)
    for _ in range(10):
        update.step(make_segments(LENGTHS))
    longer = make_update(replace(config, updates=1000))
    longer.restore(update.state())
    assert [longer.step(make_segments(LENGTHS))["lr"] for _ in range(3)] == pytest.approx([0.02] * 3)


def test_gradients_of_policy_and_critic_are_each_clipped_to_their_norm():
    update = make_update(replace(PLAIN, grad_clip=0.01))
    metrics = update.step(make_segments(LENGTHS))
    assert metrics["grad_norm"] > 0.1 and metrics["value_grad_norm"] > 0.1
    critic = [parameter.grad.norm() for parameter in update.adapter.value_head.parameters()]
    for norm in (update.adapter.weight.grad.norm(), torch.stack(critic).norm()):
        assert norm == pytest.approx(0.01, rel=1e-3)


def nonfinite() -> list[Segment]:
    segments = make_segments(LENGTHS)
    segments[1].reward[2] = np.nan
    return segments


@pytest.mark.parametrize("of", ["loss", "gradient"])
def test_a_step_that_is_not_finite_is_skipped_and_counted(of: str):
    update = make_update()
    before = update.adapter.copy_weights()
    hook = update.adapter.weight.register_hook(lambda g: g * math.inf if of == "gradient" else g)
    metrics = update.step(nonfinite() if of == "loss" else make_segments(LENGTHS))
    assert metrics["skipped"] == update.version == 1
    assert math.isfinite(metrics["loss"]) is (of == "gradient")
    assert all(torch.equal(p, before[k]) for k, p in update.adapter.copy_weights().items())
    hook.remove()
    metrics = update.step(make_segments(LENGTHS))
    assert metrics["skipped"] == metrics["lag_mean"] == metrics["lag_max"] == 1
    assert update.adapter.weight.isfinite().all()
    assert not torch.equal(update.adapter.weight, before["policy.weight"])


def test_so_many_in_a_row_are_an_error_and_a_finite_one_between_starts_the_count_again():
    update = make_update()
    several = [nonfinite() for _ in range(MAX_NONFINITE - 1)]
    for segments in (*several, make_segments(LENGTHS), *several):
        update.step(segments)
    with pytest.raises(NonFiniteError, match="5 steps in a row"):
        update.step(nonfinite())
    assert update.skipped == 2 * (MAX_NONFINITE - 1)


def test_the_memory_of_advantages_by_hand():
    """The critic says its bias, 0.3."""
    update = make_update(replace(PLAIN, lr=0.0, value_lr=0.0, advantage_memory=0.5), gamma=0.0, lam=0.0)
    torch.nn.init.zeros_(update.adapter.value_head.weight)
    batches = [make_segments((3,), seed=s) for s in (1, 2)]
    for batch in batches:
        update.step(batch)
    one, two = (np.asarray(b[0].reward, np.float64) - 0.3 for b in batches)
    expected = [0.5 * one.sum() + two.sum(), 0.5 * (one**2).sum() + (two**2).sum(), 0.5 * 3 + 3]
    assert_close(update._moments, expected)


PROBED = replace(PLAIN, lr=5e-2, probe_every=3)
NAMES = ["logprob/mismatch_mean", "logprob/mismatch_max"]


def fresh(update: RatioUpdate, seed: int = 0) -> list[Segment]:
    """Decisions of the weights of now."""
    return decided_by(update.adapter, make_segments(LENGTHS, seed=seed), update.version)


def read(metrics: dict[str, float]) -> list[float] | None:
    """Mean and maximum, if there is a reading."""
    return [metrics[name] for name in NAMES if name in metrics] or None


def shifted(segments: list[Segment], by: float) -> list[Segment]:
    """log μ of each decision off by `by`, half of it in each factor."""
    for segment in segments:
        segment.log_prob = segment.log_prob - np.float32(by / 2)
    return segments


@pytest.mark.parametrize("micro_batch", [1, 4, 1000])
def test_a_planted_mismatch_of_the_probed_version_is_found(micro_batch: int):
    """5 decisions of 8 are off by 0.5 and 3 by −0.1, which do not cancel; of other versions all may be."""
    update = make_update(replace(PROBED, micro_batch=micro_batch))
    segments = fresh(update)
    shifted(segments[0:1], -0.1)
    shifted(segments[1:2], 0.5)
    segments[2].version[:], segments[3].version[:] = 1, 5  # from the future, for this test
    shifted(segments[2:], 100.0)
    found = read(update.step(segments))
    assert found == pytest.approx([(5 * 0.5 + 3 * 0.1) / 8, 0.5], abs=1e-4)


def test_decisions_are_scored_under_the_weights_that_made_them():
    """They come four updates late, when the policy has left them far behind."""
    update = make_update(PROBED)
    late = shifted(fresh(update, seed=9), 0.1)
    for i in range(4):
        assert read(update.step(decided_by(update.adapter, make_segments(LENGTHS, seed=i), -1))) is None
    metrics = update.step(late)
    assert read(metrics) == pytest.approx([0.1, 0.1], abs=1e-4)
    assert metrics["ratio_max_dev"] > 0.3


@pytest.mark.parametrize(("every", "at"), [(3, [0, 3, 6, 9]), (1, list(range(10))), (0, [])])
def test_readings_come_every_so_many_updates(every: int, at: list[int]):
    update = make_update(replace(PROBED, probe_every=every))
    found = [read(update.step(fresh(update, i))) for i in range(10)]
    assert [i for i, reading in enumerate(found) if reading] == at
    assert all(found[i] == pytest.approx([0.0, 0.0], abs=1e-4) for i in at)


def test_factors_that_a_latent_does_not_have_are_left_out():
    update = make_update(PROBED)
    segments = make_segments(LENGTHS)
    for segment in segments:
        segment.latent["count"] = np.ones(len(segment), np.int64)
    decided_by(update.adapter, segments, 0)
    for segment in segments:
        segment.log_prob[:, 0] -= 0.1
        segment.log_prob[:, 1] = math.nan
    assert read(update.step(segments)) == pytest.approx([0.1, 0.1], abs=1e-4)


def test_measuring_changes_nothing_that_is_learnt():
    with_, without = make_update(replace(PROBED, probe_every=1)), make_update(replace(PROBED, probe_every=0))
    for i in range(5):
        metrics = with_.step(fresh(with_, i))
        expected = without.step(fresh(without, i))
        assert {k: v for k, v in metrics.items() if k not in NAMES} == expected
    assert torch.equal(with_.adapter.weight, without.adapter.weight)


def test_a_version_that_never_acted_is_given_up_for_the_newest():
    update = make_update(PROBED)
    later = [decided_by(update.adapter, make_segments((4, 4, 4), seed=i), 0) for i in range(2)]
    for segments in later:
        segments[0].version[:], segments[1].version[:], segments[2].version[:] = -3, -2, 1
    assert read(update.step(later[0])) is None
    later[1][1].version[:] = 1  # now most of the batch is newer than version 0
    assert read(update.step(later[1])) is None
    assert read(update.step(fresh(update))) == pytest.approx([0.0] * 2, abs=1e-4)
