# SPDX-License-Identifier: Apache-2.0
"""Flow policies on SmolVLA, beside the contract: what is scored and stored, and steering by the noise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.adapter import LeRobotAdapter, stack_observations
from accerl_lerobot.policies.config import (
    FlowSamplerConfig,
    NoiseSpaceSamplerConfig,
    PolicyConfig,
    TuningConfig,
)
from accerl_lerobot.policies.saving import save_pretrained
from tests.policies.cases import CASES
from tests.policies.tiny import adapter_at, perturb, requests, stored
from tests.rounding import assert_close


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return CASES["smolvla"].write(tmp_path_factory.mktemp("smolvla") / "pretrained_model")


def test_the_executed_noise_has_the_configured_size(path: Path):
    # Under ``last`` and euler the executed action is the stock one plus N(0, 0.2²) in normalised units;
    # the checkpoint's action std is 0.5.
    adapter = adapter_at(path, FlowSamplerConfig(noise_level=0.2))
    noisy = np.stack([d.chunk for d in adapter.decide(requests(200), 0)])
    stock = np.stack([d.chunk for d in adapter.decide(requests(200, explore=False), 0)])
    added = (noisy - stock) / 0.5
    assert abs(added.mean()) < 0.02 and added.std() == pytest.approx(0.2, rel=0.06)


@pytest.mark.parametrize(("stochastic", "points", "factors"), [("last", 2, 3), ("all", 4, 5)])
def test_the_latent_is_as_small_as_re_scoring_allows(path: Path, stochastic: str, points: int, factors: int):
    adapter = adapter_at(path, FlowSamplerConfig(stochastic=stochastic))
    decision = adapter.decide(requests(1), 0)[0]
    assert decision.latent["path"].shape == (points, 5, 4)
    assert decision.log_prob.shape == (adapter.actions,) == (factors,), "each is one row"
    assert adapter.factors(stored([decision])[0]) is None, "all of them exist"


def test_published_weights_that_do_not_fit_change_nothing(path: Path):
    adapter = adapter_at(path)
    good = adapter.export_trainable()
    moved = {k: v + 1 for k, v in good.items()}
    first, *_, last = moved
    with pytest.raises(ValueError, match=f"published weights differ by name: .*{first}"):
        adapter.load_trainable({k: v for k, v in moved.items() if k != first})
    with pytest.raises(ValueError, match=rf"published {last} has shape \(7,\), not"):
        adapter.load_trainable(moved | {last: np.zeros(7, np.float32)})
    assert all(np.array_equal(a, good[k]) for k, a in adapter.export_trainable().items())


# ---- noise space


@pytest.fixture(params=[False, True], ids=["one-row", "per-row"])
def steered(request: pytest.FixtureRequest, path: Path) -> LeRobotAdapter:
    sampler = NoiseSpaceSamplerConfig(per_row=request.param, deterministic_eval=False)
    return adapter_at(path, sampler)


def test_a_new_head_is_standard_normal(steered: LeRobotAdapter):
    decision = steered.decide(requests(1), 0)[0]
    z = decision.latent["z"].astype(np.float64)
    assert z.shape == (5 if steered.family.sampler.per_row else 1, 4)
    assert_close(decision.log_prob, (-0.5 * z**2 - 0.5 * np.log(2 * np.pi)).sum(1))


def test_a_deterministic_evaluation_starts_from_the_bounded_mean(path: Path):
    adapter = adapter_at(path, NoiseSpaceSamplerConfig())
    with torch.no_grad():
        adapter.family.mean.bias.fill_(100.0)
    decision = adapter.decide(requests(1, explore=False), 0)[0]
    assert np.allclose(decision.latent["z"], 2.0)
    assert (adapter.decide(requests(1), 0)[0].latent["z"] != 2.0).all()


def test_steering_moves_the_action_and_the_frozen_policy_stays(steered: LeRobotAdapter):
    asked = requests(16)
    assert {name.split(".")[0] for name in steered.trainable()} == {"family", "value_head"}
    before = {k: v.clone() for k, v in steered.policy.state_dict().items()}
    optimizer = torch.optim.Adam(steered.trainable().values(), lr=0.02)
    first = np.stack([d.chunk for d in steered.decide(asked, 0)])[:, :, 0].mean()
    for seed in range(1, 31):
        asked_now = requests(16, seed=seed)
        decisions = steered.decide(asked_now, 0)
        reward = np.stack([d.chunk for d in decisions])[:, :, 0].mean(1)
        latent, _ = stored(decisions)
        evaluation = steered.evaluate(*stack_observations(asked_now), latent)
        advantage = torch.from_numpy((reward - reward.mean()) / (reward.std() + 1e-6))
        optimizer.zero_grad()
        (-(advantage * evaluation.log_prob.sum(1)).mean()).backward()
        optimizer.step()
    last = np.stack([d.chunk for d in steered.decide(asked, 0)])[:, :, 0].mean()
    assert last > first + 0.1
    assert all(torch.equal(v, before[k]) for k, v in steered.policy.state_dict().items())


def test_stock_lerobot_loads_the_frozen_policy(steered: LeRobotAdapter, path: Path, tmp_path: Path):
    from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy

    perturb(steered, 0.5)
    config = PolicyConfig(path=str(path), device="cpu", sampler=steered.family.sampler)
    save_pretrained(steered, tmp_path / "saved", config)
    stock, original = SmolVLAPolicy.from_pretrained(tmp_path / "saved"), SmolVLAPolicy.from_pretrained(path)
    assert all(torch.equal(v, original.state_dict()[k]) for k, v in stock.state_dict().items())


def test_entropy_of_the_noise_is_minus_its_expected_log_density(steered: LeRobotAdapter):
    perturb(steered, 0.5)
    many = [replace(requests(1)[0], noise_seed=i) for i in range(4000)]
    decisions = steered.decide(many, 0)
    latent, _ = stored(decisions[:2])
    entropy = steered.evaluate(*stack_observations(many[:2]), latent).entropy[0].detach()
    sampled = -np.stack([d.log_prob for d in decisions]).sum(1)
    assert abs(sampled.mean() - float(entropy)) < 4 * sampled.std() / np.sqrt(len(many))


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"std": 0.0}, "std"),
        ({"std_min": 1.0}, "std_min"),
        ({"std_max": 1.0}, "std_max"),
        ({"bound": 0.0}, "bound"),
        ({"hidden": 0}, "hidden"),
    ],
)
def test_bad_options_name_their_field(values: dict[str, float], field: str):
    with pytest.raises(InputError, match=rf"^policy\.sampler\.{field}="):
        NoiseSpaceSamplerConfig(**values)


@pytest.mark.parametrize("mode", ["expert", "lora"])
def test_tuning_a_frozen_policy_is_refused(path: Path, mode: str):
    with pytest.raises(InputError, match=rf"^policy\.tuning\.mode='{mode}': this sampler leaves the whole"):
        adapter_at(path, NoiseSpaceSamplerConfig(), tuning=TuningConfig(mode=mode))
