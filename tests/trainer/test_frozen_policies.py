# SPDX-License-Identifier: Apache-2.0
"""Frozen copies of weights: swapped in and out to the bit, renewed when due, and what they are for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.algorithms import (
    AlgorithmConfig,
    DecoupledConfig,
    GIPOConfig,
    ImportanceConfig,
    LossInputs,
    LossOutput,
    PPOConfig,
    RatioConfig,
)
from accerl_lerobot.policies.adapter import Evaluation
from accerl_lerobot.trainer.batch import Part, collate
from accerl_lerobot.trainer.config import TrainerConfig
from accerl_lerobot.trainer.frozen_policies import FrozenPolicies
from accerl_lerobot.trainer.update import Update
from tests.rounding import assert_close
from tests.trainer.linear import LinearAdapter, decided_by, make_segments

PLAIN = TrainerConfig(
    updates=100,
    lr=1e-2,
    value_lr=1e-2,
    warmup_updates=0,
    value_warmup_updates=0,
    grad_clip=1e9,
    probe_every=0,
)
LENGTHS = (3, 5, 1, 4)


def whole(segments: Sequence[Any]) -> Part:
    batch = collate(segments)
    return batch.part(np.arange(len(batch)))


def moved(adapter: LinearAdapter, by: float) -> None:
    with torch.no_grad():
        for parameter in adapter.trainable().values():
            parameter.add_(by)


# ---- swapping


def test_log_probs_are_those_of_the_copied_weights_whatever_happens_to_the_live_ones():
    adapter, part = LinearAdapter(), whole(make_segments(LENGTHS))
    frozen = FrozenPolicies(adapter)
    frozen.take("reference", 0)
    then = adapter.evaluate(*part).log_prob.detach()
    moved(adapter, 0.3)
    assert torch.equal(frozen.log_prob("reference", *part), then)
    assert not torch.equal(adapter.evaluate(*part).log_prob, then)
    moved(adapter, 0.3)
    assert torch.equal(frozen.log_prob("reference", *part), then)


def test_the_live_weights_are_back_afterwards_in_their_own_memory():
    adapter, part = LinearAdapter(), whole(make_segments(LENGTHS))
    frozen = FrozenPolicies(adapter)
    frozen.take("reference", 0)
    moved(adapter, 0.3)
    before, places = adapter.copy(), {k: p.data_ptr() for k, p in adapter.trainable().items()}
    assert not frozen.log_prob("reference", *part).requires_grad
    for name, parameter in adapter.trainable().items():
        assert torch.equal(parameter, before[name]) and parameter.data_ptr() == places[name]
        assert parameter.requires_grad and parameter.grad is None


@pytest.mark.parametrize("broken", ["evaluate", "copy"])
def test_the_live_weights_are_back_even_after_an_error(broken: str, monkeypatch: pytest.MonkeyPatch):
    adapter, part = LinearAdapter(), whole(make_segments(LENGTHS))
    adapter.second = torch.nn.Parameter(torch.ones(3))
    monkeypatch.setattr(adapter, "trainable", lambda: {"a": adapter.weight, "b": adapter.second})
    frozen = FrozenPolicies(adapter)
    frozen.take("reference", 0)
    moved(adapter, 0.3)
    before = adapter.copy()
    seen: list[bool] = []

    def evaluate(*_: Any) -> Evaluation:
        seen.append(torch.equal(adapter.weight, before["a"]))
        raise MemoryError("too many rows")

    if broken == "evaluate":
        monkeypatch.setattr(adapter, "evaluate", evaluate)
    else:
        frozen._copies["reference"][1].pop()  # the first parameter is swapped, then it fails
    with pytest.raises((MemoryError, ValueError)):
        frozen.log_prob("reference", *part)
    assert seen == ([False] if broken == "evaluate" else [])
    assert all(torch.equal(p, before[k]) for k, p in adapter.trainable().items())


def test_the_critic_is_neither_copied_nor_swapped(monkeypatch: pytest.MonkeyPatch):
    adapter, part = LinearAdapter(), whole(make_segments(LENGTHS))
    frozen = FrozenPolicies(adapter)
    frozen.take("reference", 0)
    (version, tensors), *_ = frozen._copies.values()
    assert version == 0 and [t.shape for t in tensors] == [adapter.weight.shape]
    moved(adapter, 0.3)
    live, evaluate, values = adapter.evaluate(*part).value.detach(), adapter.evaluate, []

    def watched(*arguments: Any) -> Evaluation:
        found = evaluate(*arguments)
        values.append(found.value)
        return found

    monkeypatch.setattr(adapter, "evaluate", watched)
    frozen.log_prob("reference", *part)
    assert torch.equal(values[0], live)


def test_copies_of_one_version_share_their_memory_and_others_do_not():
    adapter = LinearAdapter()
    frozen = FrozenPolicies(adapter)
    frozen.take("reference", 0)
    frozen.take("probe", 0)
    reference, probe = (frozen._copies[name][1] for name in ("reference", "probe"))
    assert reference[0].data_ptr() == probe[0].data_ptr() != adapter.weight.data_ptr()
    first = reference[0].clone()
    moved(adapter, 0.3)
    frozen.take("probe", 1)
    assert torch.equal(reference[0], first) and not torch.equal(frozen._copies["probe"][1][0], first)
    frozen.drop("probe")
    assert "probe" not in frozen and "reference" in frozen


# ---- what the trainer keeps


class Recorder:
    """Arguments of the loss, update by update, and the moments of copies."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.inputs: list[LossInputs] = []
        self.taken: list[tuple[str, int]] = []
        take = FrozenPolicies.take
        losses = {kind: kind.loss for kind in (GIPOConfig, DecoupledConfig)}

        def recorded(config: RatioConfig, inputs: LossInputs) -> LossOutput:
            self.inputs.append(inputs)
            return losses[type(config)](config, inputs)

        def counted(frozen: FrozenPolicies, name: str, version: int) -> None:
            self.taken.append((name, version))
            take(frozen, name, version)

        for kind in losses:
            monkeypatch.setattr(kind, "loss", recorded)
        monkeypatch.setattr(FrozenPolicies, "take", counted)


def train(update: Update, updates: int) -> list[dict[str, Tensor]]:
    """Weights before each update and after the last."""
    weights = [update.adapter.copy()]
    for i in range(updates):
        update.step(decided_by(update.adapter, make_segments(LENGTHS, seed=i), i))
        weights.append(update.adapter.copy())
    return weights


def under(weights: dict[str, Tensor], seed: int) -> Tensor:
    other = LinearAdapter()
    with torch.no_grad():
        other.weight.copy_(weights["policy.weight"])
        return other.evaluate(*whole(make_segments(LENGTHS, seed=seed))).log_prob


@pytest.mark.parametrize("algorithm", [GIPOConfig(), PPOConfig(), DecoupledConfig(proximal_every=1)])
def test_a_run_that_needs_no_copy_holds_none(algorithm: AlgorithmConfig, monkeypatch: pytest.MonkeyPatch):
    recorder = Recorder(monkeypatch)
    update = Update(LinearAdapter(), algorithm, PLAIN)
    train(update, 3)
    assert recorder.taken == [] and all(name not in update.frozen for name in ("reference", "proximal"))
    assert all(i.log_prob_reference is None for i in recorder.inputs)


def test_the_reference_is_version_0_for_ever(monkeypatch: pytest.MonkeyPatch):
    recorder = Recorder(monkeypatch)
    update = Update(LinearAdapter(), GIPOConfig(reference_coef=0.1), PLAIN)
    weights = train(update, 5)
    assert recorder.taken == [("reference", 0)]
    for i, inputs in enumerate(recorder.inputs):
        assert torch.equal(inputs.log_prob_reference, under(weights[0], i))
        assert torch.equal(inputs.log_prob_new, under(weights[i], i))


def test_kl_to_the_reference_starts_at_0_and_holds_the_policy_back():
    ends = []
    for coef in (1e-6, 100.0):
        update = Update(LinearAdapter(), GIPOConfig(reference_coef=coef), PLAIN)
        start = update.adapter.copy()["policy.weight"]
        kls = [update.step(decided_by(update.adapter, make_segments(LENGTHS, seed=i), i)) for i in range(30)]
        assert kls[0]["kl_reference"] == 0.0 and kls[-1]["kl_reference"] > 0.0
        ends.append(float((update.adapter.copy()["policy.weight"] - start).norm()))
    assert ends[1] < 0.5 * ends[0]


@pytest.mark.parametrize("micro_batch", [1000, 5])
def test_proximal_weights_are_renewed_every_so_many_updates(
    micro_batch: int, monkeypatch: pytest.MonkeyPatch
):
    recorder = Recorder(monkeypatch)
    config = replace(PLAIN, micro_batch=micro_batch)
    weights = train(Update(LinearAdapter(), DecoupledConfig(proximal_every=3), config), 8)
    assert recorder.taken == [("proximal", 0), ("proximal", 3), ("proximal", 6)]
    parts = 1 if micro_batch == 1000 else 3
    for i in range(8):
        found = torch.cat([x.log_prob_proximal for x in recorder.inputs[parts * i : parts * (i + 1)]])
        assert_close(found, under(weights[i // 3 * 3], i))
        assert ((found - under(weights[i], i)).abs().max() < 1e-3) == (i % 3 == 0)


def test_decoupled_ppo_with_proximal_weights_of_its_own_is_the_weighted_policy_gradient(
    monkeypatch: pytest.MonkeyPatch,
):
    """−E[w Â ∇log π] with w = π/μ masked above 2, by hand from what the loss was given."""
    recorder = Recorder(monkeypatch)
    update = Update(LinearAdapter(), DecoupledConfig(proximal_every=1, value_coef=0.0), PLAIN)
    update.step(make_segments(LENGTHS))  # of a policy a little off
    (inputs,) = recorder.inputs
    part = whole(make_segments(LENGTHS))
    again = LinearAdapter()
    log_prob = again.evaluate(*part).log_prob
    w = (log_prob - inputs.log_prob_old).detach().exp()
    assert ((w > 2).float().mean() > 0.1) and ((w < 2).float().mean() > 0.1)
    w = w.masked_fill(w > 2.0, 0.0)
    (-(w * log_prob * inputs.advantage[:, None]).mean()).backward()
    assert_close(update.adapter.weight.grad, again.weight.grad)


def test_between_renewals_decoupled_ppo_clips_what_has_moved_since(monkeypatch: pytest.MonkeyPatch):
    update = Update(LinearAdapter(), DecoupledConfig(proximal_every=2), replace(PLAIN, lr=0.3))
    other = Update(LinearAdapter(), ImportanceConfig(), replace(PLAIN, lr=0.3))
    fractions = [
        [u.step(decided_by(u.adapter, make_segments(LENGTHS, seed=i), i))["low_weight"] for i in range(4)]
        for u in (update, other)
    ]
    assert fractions[0][0] == fractions[0][2] == 0.0 and fractions[0][1] > 0.0 and fractions[0][3] > 0.0
    assert fractions[1] == [0.0] * 4
