# SPDX-License-Identifier: Apache-2.0
"""DSRL: the noise a frozen flow policy starts from is the action."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.base import stack_observations
from accerl_lerobot.policies.config import PolicyConfig, TuningConfig
from accerl_lerobot.policies.loading import save_pretrained
from accerl_lerobot.policies.samplers import NoiseSpaceSamplerConfig
from tests.conftest import write_smolvla
from tests.policies.tiny import adapter_at, check_ratio_one, perturb, requests, stored
from tests.rounding import assert_close

SAMPLERS = [NoiseSpaceSamplerConfig(per_row=rows, at_rest="sample") for rows in (False, True)]


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("smolvla") / "pretrained_model"
    return write_smolvla(directory, chunk=5, executed=3, padded_dim=4, action_dim=2, num_steps=3)


@pytest.fixture(scope="module")
def loaded(path: Path) -> dict[bool, LeRobotAdapter]:
    return {config.per_row: adapter_at(path, config) for config in SAMPLERS}


@pytest.fixture(params=[False, True], ids=["one-row", "per-row"])
def adapter(loaded: dict[bool, LeRobotAdapter], request: pytest.FixtureRequest) -> LeRobotAdapter:
    return copy.deepcopy(loaded[request.param])


def test_only_the_head_is_trained(adapter: LeRobotAdapter):
    parts = {name.split(".")[0] for name in adapter.trainable()}
    assert parts == {"family", "value_head"}


def test_equal_weights_give_ratio_one(adapter: LeRobotAdapter):
    perturb(adapter, 0.5)
    asked = requests(24)
    together = adapter.decide(asked, 0)
    alone = [adapter.decide([request], 0)[0] for request in asked[:6]]
    for decisions in (together, alone + together[6:]):
        check_ratio_one(adapter, asked, decisions)
    assert together[0].log_prob.shape == (adapter.family.rows,)
    assert together[0].latent["z"].shape == (adapter.family.rows, 4)


def test_a_new_head_with_a_noise_per_row_is_lerobot_s_own_policy(loaded: dict[bool, LeRobotAdapter]):
    adapter, asked = loaded[True], requests(6, explore=False)
    decisions = adapter.decide(asked, 0)
    noise = torch.from_numpy(np.stack([d.latent["z"] for d in decisions]))
    batch = adapter.processing.prepare(*stack_observations(asked))
    stock = adapter.policy.predict_action_chunk(batch, noise=noise)[:, :3]
    adapter.policy.reset()
    chunks = np.stack([d.chunk for d in decisions])
    assert np.array_equal(chunks, adapter.processing.unnormalise(stock).numpy())
    expected = np.stack(
        [np.random.default_rng(r.noise_seed).standard_normal((5, 4), dtype=np.float32) for r in asked]
    )
    assert_close(noise, expected)


def test_log_prob_by_hand(adapter: LeRobotAdapter):
    decision = adapter.decide(requests(1), 0)[0]
    z = decision.latent["z"].astype(np.float64)  # a new head is N(0, 1)
    assert_close(decision.log_prob, (-0.5 * z**2 - 0.5 * np.log(2 * np.pi)).sum(1))


def test_at_rest_it_starts_from_the_mean(path: Path):
    adapter = adapter_at(path, NoiseSpaceSamplerConfig())
    with torch.no_grad():
        adapter.family.mean.bias.fill_(100.0)
    decision = adapter.decide(requests(1, explore=False), 0)[0]
    assert np.allclose(decision.latent["z"], 2.0), "bounded"
    assert (adapter.decide(requests(1), 0)[0].latent["z"] != 2.0).all()


def test_steering_moves_the_action_and_the_frozen_policy_stays(adapter: LeRobotAdapter):
    asked = requests(16)
    before = {k: v.clone() for k, v in adapter.policy.state_dict().items()}
    optimizer = torch.optim.Adam(adapter.trainable().values(), lr=0.02)
    first = np.stack([d.chunk for d in adapter.decide(asked, 0)])[:, :, 0].mean()
    for round_ in range(30):
        asked_now = requests(16, seed=round_ + 1)
        decisions = adapter.decide(asked_now, 0)
        reward = np.stack([d.chunk for d in decisions])[:, :, 0].mean(1)
        latent, _ = stored(decisions)
        evaluation = adapter.evaluate(*stack_observations(asked_now), latent)
        advantage = torch.from_numpy((reward - reward.mean()) / (reward.std() + 1e-6))
        optimizer.zero_grad()
        (-(advantage * evaluation.log_prob.sum(1)).mean()).backward()
        optimizer.step()
    last = np.stack([d.chunk for d in adapter.decide(asked, 0)])[:, :, 0].mean()
    assert last > first + 0.1
    assert all(torch.equal(v, before[k]) for k, v in adapter.policy.state_dict().items())


def test_what_was_learnt_is_saved_and_stock_lerobot_loads_the_frozen_policy(
    adapter: LeRobotAdapter, path: Path, tmp_path: Path
):
    from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy

    perturb(adapter, 0.5)
    config = PolicyConfig(path=str(path), device="cpu", sampler=adapter.family.sampler)
    save_pretrained(adapter, tmp_path / "saved", config)
    again, asked = adapter_at(tmp_path / "saved", adapter.family.sampler), requests(4)
    for one, other in zip(again.decide(asked, 0), adapter.decide(asked, 0), strict=True):
        assert np.array_equal(one.chunk, other.chunk) and np.array_equal(one.log_prob, other.log_prob)
    stock, original = SmolVLAPolicy.from_pretrained(tmp_path / "saved"), SmolVLAPolicy.from_pretrained(path)
    assert all(torch.equal(v, original.state_dict()[k]) for k, v in stock.state_dict().items())


def test_entropy_is_minus_the_expected_log_density(adapter: LeRobotAdapter):
    perturb(adapter, 0.5)
    many = [replace(requests(1)[0], noise_seed=i) for i in range(4000)]
    decisions = adapter.decide(many, 0)
    latent, old = stored(decisions[:2])
    entropy = adapter.evaluate(*stack_observations(many[:2]), latent).entropy[0].detach()
    sampled = -np.stack([d.log_prob for d in decisions]).sum(1)
    assert abs(sampled.mean() - float(entropy)) < 4 * sampled.std() / np.sqrt(len(many))


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"std": 0.0}, "std"), ({"std_min": 1.0}, "std_min"), ({"std_max": 1.0}, "std_max"),
        ({"bound": 0.0}, "bound"), ({"hidden": 0}, "hidden"), ({"at_rest": "max"}, "at_rest"),
    ],
)  # fmt: skip
def test_bad_options_name_their_field(values: dict[str, object], field: str):
    with pytest.raises(InputError, match=rf"^policy\.sampler\.{field}="):
        NoiseSpaceSamplerConfig(**values)


@pytest.mark.parametrize("mode", ["expert", "lora"])
def test_tuning_a_frozen_policy_is_refused(path: Path, mode: str):
    with pytest.raises(InputError, match=rf"^policy\.tuning\.mode='{mode}': this sampler leaves the whole"):
        adapter_at(path, NoiseSpaceSamplerConfig(), tuning=TuningConfig(mode=mode))
