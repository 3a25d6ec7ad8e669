# SPDX-License-Identifier: Apache-2.0
"""Extent of one ratio, and factors that do not exist."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from accerl_lerobot.algorithms import (
    AlgorithmConfig,
    GIPOConfig,
    LossInputs,
    check_level,
)
from accerl_lerobot.algorithms.objective import mean_over_ratios
from accerl_lerobot.algorithms.ratio import at_level, present
from accerl_lerobot.errors import InputError
from tests.algorithms.inputs import gradient, make_inputs
from tests.runs import ALGORITHMS

X = torch.tensor([[1.0, 2.0, 4.0, 8.0, 16.0, 32.0]])
FACTORS = torch.tensor([[True, True, True, True, False, False]])
each_level = pytest.mark.parametrize("level", ["token", "action", "chunk"])
each_algorithm = pytest.mark.parametrize(
    "config", [AlgorithmConfig.get_choice_class(name)(reference_coef=0.1) for name in ALGORITHMS], ids=str
)


def inputs_of(**replaced: Any) -> LossInputs:
    return make_inputs(n=1, factors=6, **replaced)


@pytest.mark.parametrize(
    ("level", "actions", "expected"),
    [
        ("token", None, [1.0, 2.0, 4.0, 8.0, 16.0, 32.0]),
        ("action", 6, [1.0, 2.0, 4.0, 8.0, 16.0, 32.0]),
        ("action", 3, [3.0, 12.0, 48.0]),
        ("action", 2, [7.0, 56.0]),
        ("chunk", None, [63.0]),
    ],
)
def test_sums_by_hand(level: Any, actions: int | None, expected: list[float]) -> None:
    assert at_level(X, inputs_of(actions=actions), level).tolist() == [expected]


@pytest.mark.parametrize(
    ("level", "expected", "there"),
    [
        ("token", [1.0, 2.0, 4.0, 8.0, 0.0, 0.0], [True, True, True, True, False, False]),
        ("action", [3.0, 12.0, 0.0], [True, True, False]),
        ("chunk", [15.0], [True]),
    ],
)
def test_factors_that_do_not_exist_by_hand(level: Any, expected: list[float], there: list[bool]) -> None:
    inputs = replace(inputs_of(actions=3), factors=FACTORS)
    holes = X.masked_fill(~FACTORS, torch.nan)
    assert at_level(holes, inputs, level).tolist() == [expected]
    assert present(FACTORS, level, 3).tolist() == [there]


def test_an_action_with_one_token_left_still_counts() -> None:
    partly = torch.tensor([[True, False, False, False, True, True]])
    assert present(partly, "action", 3).tolist() == [[True, False, True]]


def test_means_weigh_existing_factors_alike() -> None:
    """One decision has four, the other one: (1 + 2 + 4 + 8 + 10) / 5."""
    factors = torch.cat([FACTORS, torch.tensor([[True, False, False, False, False, False]])])
    x = torch.cat([X, torch.tensor([[10.0, 99.0, 99.0, 99.0, 99.0, 99.0]])])
    inputs = replace(make_inputs(n=2, factors=6), factors=factors)
    assert mean_over_ratios(x, inputs, "token").item() == 5.0


@each_algorithm
@each_level
def test_what_does_not_exist_is_never_looked_at(config: AlgorithmConfig, level: Any) -> None:
    """NaN there changes neither loss nor metrics nor gradient."""
    config = replace(config, level=level)
    factors = torch.arange(4) < torch.tensor([4, 2, 3, 1, 4, 2, 3])[:, None]
    clean = replace(make_inputs(n=7, factors=4, actions=2), factors=factors)
    names = ("log_prob_new", "log_prob_old", "log_prob_reference", "log_prob_proximal")
    holes = {n: getattr(clean, n).detach().masked_fill(~factors, torch.nan) for n in names}
    holes["log_prob_new"].requires_grad_()
    dirty = replace(clean, **holes)
    expected, got = config.loss(clean), config.loss(dirty)
    torch.testing.assert_close(got.loss, expected.loss)
    for name, metric in expected.metrics.items():
        torch.testing.assert_close(got.metrics[name], metric, msg=name)
    slope = gradient(dirty, got.loss)
    torch.testing.assert_close(slope, gradient(clean, expected.loss))
    assert (slope[~factors] == 0).all() and (slope[factors] != 0).any()


@each_algorithm
@each_level
def test_micro_batches_add_up(config: AlgorithmConfig, level: Any) -> None:
    """Parts of 2 and 5 decisions, with different numbers of factors, against all 7."""
    config = replace(config, level=level)
    factors = torch.arange(4) < torch.tensor([4, 4, 1, 2, 1, 3, 1])[:, None]
    whole = replace(make_inputs(n=7, factors=4, actions=2), factors=factors)
    expected = gradient(whole, config.loss(whole).loss)
    each = present(factors, level, 2).sum().item() / 7
    total = torch.zeros_like(expected)
    for rows in (slice(0, 2), slice(2, 7)):
        fields = {k: v[rows] for k, v in vars(whole).items() if isinstance(v, torch.Tensor)}
        part = replace(whole, **fields, ratios_per_decision=each)
        share = len(part.value) / 7
        total += gradient(whole, config.loss(part).loss * share)
    torch.testing.assert_close(total, expected)


def test_a_ratio_per_action_needs_actions() -> None:
    for level in ("token", "chunk"):
        check_level(level, None)
        assert GIPOConfig(level=level).loss(make_inputs(actions=None)).loss.isfinite()
    check_level("action", 3)
    with pytest.raises(InputError, match="algorithm.level='action': use token or chunk") as caught:
        check_level("action", None)
    assert caught.value.field == "algorithm.level"
    with pytest.raises(InputError, match="algorithm.level"):
        GIPOConfig().loss(make_inputs(actions=None))
