# SPDX-License-Identifier: Apache-2.0
"""The contract of every policy type and sampler: what acts and what re-scores are one policy, LeRobot's."""

import copy
import pickle
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from torch import Tensor

from accerl_lerobot.experience import Request, stack_observations
from accerl_lerobot.policies.adapter import LeRobotAdapter, ValueHead
from accerl_lerobot.policies.config import POLICIES, GaussianSamplerConfig, PolicyConfig
from accerl_lerobot.policies.processing import Processing
from accerl_lerobot.testing import check_batches, check_gradient, check_saved, log_ratio, perturb, stored
from tests.policies.cases import CASES, VARIANTS, Case
from tests.policies.tiny import adapter_at, requests
from tests.policies.tiny_pi import hub
from tests.rounding import assert_close


class Policy(NamedTuple):
    """A case with one of its samplers, on disk and in memory; the adapter is one of its own."""

    case: Case
    path: Path
    adapter: LeRobotAdapter
    asked: list[Request]


def every_case(most: int) -> pytest.MarkDecorator:
    """Runs a test on each case with at most so many of its samplers."""
    parameters = [
        pytest.param((name, i), id=f"{name}-{i}")
        for name, case in (CASES | VARIANTS).items()
        for i in range(min(most, len(case.samplers)))
    ]
    return pytest.mark.parametrize("policy", parameters, indirect=True)


SAMPLERS, ONE_SAMPLER = every_case(9), every_case(1)


@pytest.fixture(scope="module")
def loaded(written):
    @cache
    def load(name: str, i: int) -> LeRobotAdapter:
        case = (CASES | VARIANTS)[name]
        adapter = adapter_at(written(name), case.samplers[i])
        case.prepare(adapter)
        return adapter

    return load


@pytest.fixture
def policy(request: pytest.FixtureRequest, written, loaded) -> Policy:
    name, i = request.param
    case = (CASES | VARIANTS)[name]
    return Policy(case, written(name), copy.deepcopy(loaded(name, i)), case.requests(40))


def test_every_type_has_a_case():
    assert set(CASES) == set(POLICIES)


@SAMPLERS
def test_decisions_and_ratio_one_depend_on_neither_batch_nor_global_generator(policy: Policy):
    adapter = policy.adapter
    for one in check_batches(adapter, policy.asked, few=8):
        assert one.chunk.shape == policy.case.chunk and one.chunk.dtype == np.float32 and one.version == 7
        assert one.log_prob.dtype == np.float32
    asked = policy.asked[:6]
    together = pickle.dumps(adapter.decide(asked, 7))
    torch.manual_seed(1)
    state = torch.get_rng_state()
    assert pickle.dumps(adapter.decide(asked, 7)) == together
    adapter.self_check(*stack_observations(asked))
    assert torch.equal(torch.get_rng_state(), state)


@ONE_SAMPLER
def test_all_that_is_observed_and_the_seed_matter(policy: Policy):
    adapter, first = policy.adapter, policy.asked[0]
    perturb(adapter, 0.1)
    one = adapter.decide([first], 0)[0]
    inputs = dict.fromkeys(adapter.policy.config.input_features)
    changes = {key: np.zeros_like(first.observation[key]) for key in inputs}
    if hasattr(adapter.policy.config, "tokenizer_max_length"):
        changes["task"] = "Stay"
    if first.observation["observation.state"].ndim == 2:  # each of the env steps that it looks back to
        for key in inputs:
            changes[f"{key} now"] = first.observation[key].copy()
            changes[f"{key} now"][-1] = 0
    for key, value in changes.items():
        changed = replace(first, observation=first.observation | {key.removesuffix(" now"): value})
        other = adapter.decide([changed], 0)[0]
        moved = np.abs(other.chunk - one.chunk).max() + np.abs(other.log_prob - one.log_prob).max()
        assert moved > 1e-4, key
        assert adapter.values(*stack_observations([first, changed])).std() > 1e-6, key
    seeds = adapter.decide([replace(first, noise_seed=seed) for seed in range(20)], 0)
    assert len({d.chunk.tobytes() for d in seeds}) > 10


@SAMPLERS
def test_ratio_one_after_save_and_load(policy: Policy, tmp_path: Path):
    adapter, asked = policy.adapter, policy.asked[:6]
    perturb(adapter, 0.1)
    config = PolicyConfig(path=str(policy.path), device="cpu", sampler=adapter.family.sampler)
    check_saved(adapter, asked, config, tmp_path / "saved")
    untouched = adapter_at(policy.path, adapter.family.sampler)
    assert log_ratio(untouched, asked, adapter.decide(asked, 0)).abs().max() > 1e-3


@SAMPLERS
def test_log_prob_s_gradient_against_finite_differences(policy: Policy):
    adapter, asked = policy.adapter, policy.asked[:8]
    decisions, case = adapter.decide(asked, 0), policy.case
    perturb(adapter, 0.02, seed=1)
    check_gradient(adapter, asked, decisions, case.parts, step=case.step, slack=case.slack)


@SAMPLERS
def test_not_exploring_is_lerobot_s_own_policy_and_is_not_scored(policy: Policy):
    adapter, asked = policy.adapter, policy.case.requests(6, explore=False)
    observations, tasks = stack_observations(asked)
    assert adapter.self_check(observations, tasks) < 1e-6
    decisions = adapter.decide(asked, 0)
    chunks = np.stack([d.chunk for d in decisions])
    assert not any(d.log_prob.any() for d in decisions)
    if policy.case.kind != "diffusion":  # it draws step noise, see `test_diffusion`
        batch, latent = adapter.processing.prepare(observations, tasks), stored(decisions)[0]
        stock = adapter.model.stock(batch, **({"noise": latent["path"][:, 0]} if "path" in latent else {}))
        rows = policy.case.chunk[0]
        assert np.array_equal(chunks, adapter.processing.unnormalise(stock)[:, :rows].numpy())
    exploring = np.stack([d.chunk for d in adapter.decide(policy.asked[:6], 0)])
    assert np.abs(exploring - chunks).max() > 1e-2


@ONE_SAMPLER
def test_values_are_those_of_evaluate_and_carry_no_gradient(policy: Policy):
    adapter, asked = policy.adapter, policy.asked[:6]
    perturb(adapter, 0.1)
    observations, tasks = stack_observations(asked)
    latent, _ = stored(adapter.decide(asked, 0))
    values, evaluation = adapter.values(observations, tasks), adapter.evaluate(observations, tasks, latent)
    assert not values.requires_grad and evaluation.value.requires_grad and evaluation.log_prob.requires_grad
    assert torch.equal(values, evaluation.value.detach()) and values.shape == evaluation.entropy.shape == (6,)
    assert values.std() > 0


@ONE_SAMPLER
def test_published_weights_make_the_same_policy(policy: Policy):
    trainer, reader, asked = policy.adapter, copy.deepcopy(policy.adapter), policy.asked[:4]
    perturb(trainer, 0.1)
    exported = trainer.export_trainable()
    assert all(a.dtype == np.float32 for a in exported.values())
    before = pickle.dumps(reader.decide(asked, 0))
    for array in exported.values():
        array.setflags(write=False)  # as out of Ray's object store
    reader.load_trainable(exported)
    assert pickle.dumps(reader.decide(asked, 0)) == pickle.dumps(trainer.decide(asked, 0)) != before
    perturb(trainer, 0.1)
    assert np.array_equal(exported["value_head.out.bias"], reader.export_trainable()["value_head.out.bias"])


@ONE_SAMPLER
def test_training_moves_neither_normalisation_nor_buffers_nor_frozen_weights(policy: Policy, tmp_path: Path):
    adapter, asked = policy.adapter, policy.asked[:4]
    state = {k: v.clone() for k, v in adapter.policy.state_dict().items()}
    trainable = adapter.trainable()
    latent, _ = stored(adapter.decide(asked, 0))
    optimizer = torch.optim.AdamW(trainable.values(), lr=1e-2)
    evaluation = adapter.evaluate(*stack_observations(asked), latent)
    (evaluation.log_prob.sum() + evaluation.value.sum()).backward()
    optimizer.step()
    adapter.save(tmp_path / "trained")
    files = list(policy.path.glob("policy_*processor*.safetensors"))
    assert files and all((tmp_path / "trained" / f.name).read_bytes() == f.read_bytes() for f in files)
    now = adapter.policy.state_dict()
    moved = {now[k].data_ptr() for k, v in state.items() if not torch.equal(now[k], v)}
    assert moved == {p.data_ptr() for k, p in trainable.items() if k.startswith("policy.")}


@pytest.mark.parametrize("name", ["smolvla", "pi0", "pi05", "pi0_fast", "smolvla_bins"])
def test_the_network_runs_in_bfloat16_and_log_probs_and_weights_are_float32(written: Any, name: str):
    full, half = adapter_at(written(name)), adapter_at(written(name), precision="bf16")
    asked = CASES[name].requests(6)
    perturb(full, 0.1)
    half.load_trainable(full.export_trainable())
    latent, old = stored(half.decide(asked, 0))
    evaluation = half.evaluate(*stack_observations(asked), latent)
    assert old.dtype == evaluation.log_prob.dtype == evaluation.value.dtype == torch.float32
    if name == "pi0_fast":  # two passes, two roundings
        assert (evaluation.log_prob - old).abs().max() < 0.5
    else:
        assert torch.equal(evaluation.log_prob, old), "the same batch, the same numbers"
    assert not torch.equal(old, old.bfloat16().float()), "not rounded"
    gap = (full.evaluate(*stack_observations(asked), latent).log_prob - old).abs().max()
    assert 1e-5 < gap < 1, "the network runs in bfloat16"
    evaluation.log_prob.sum().backward()
    assert all(p.dtype == torch.float32 for p in half.trainable().values())
    assert any(p.grad is not None and p.grad.abs().max() > 0 for p in half.trainable().values())


@ONE_SAMPLER
def test_stock_lerobot_runs_what_is_saved(policy: Policy, tmp_path: Path):
    adapter, saved = policy.adapter, tmp_path / "saved"
    perturb(adapter, 0.1)
    adapter.save(saved)
    with hub(tmp_path / "hub"), adapter.model.loading():
        stock = get_policy_class(policy.case.kind).from_pretrained(saved)
        pre, post = make_pre_post_processors(stock.config, pretrained_path=str(saved))
    ours, theirs = adapter.policy.state_dict(), stock.state_dict()
    assert ours.keys() == theirs.keys() and all(torch.equal(ours[k], theirs[k]) for k in ours)
    observations = stack_observations(policy.asked[:3])
    processing = Processing(pre, post, adapter.device, {})
    batch, expected = (p.prepare(*observations) for p in (processing, adapter.processing))
    assert all(torch.equal(batch[k], v) for k, v in expected.items() if isinstance(v, Tensor))
    if stock.config.n_obs_steps > 1:  # LeRobot keeps the history itself
        batch = {k: v[:, -1] if k in stock.config.input_features else v for k, v in batch.items()}
    action = stock.select_action(batch)
    assert torch.isfinite(action).all()
    assert torch.equal(post(action), adapter.processing.unnormalise(action))


def test_images_are_scaled_and_states_normalised(tiny_checkpoint: Path):
    raw, tasks = stack_observations(requests(3))
    batch = adapter_at(tiny_checkpoint).processing.prepare(raw, tasks)
    image = batch["observation.images.front"]
    assert image.shape == (3, 3, 32, 32) and image.dtype == torch.float32
    assert image[1, 2, 5, 7].item() == np.float32(raw["observation.images.front"][1, 5, 7, 2]) / 255
    assert np.allclose(batch["observation.state"], raw["observation.state"] / 0.5, rtol=1e-6)


def test_act_s_std_starts_where_it_is_configured_and_stays_within_bounds(written: Any):
    # The checkpoint's action std is 0.5, so that is the factor from normalised to executed.
    adapter = adapter_at(written("act"), GaussianSamplerConfig(std=0.24))
    asked, still = (requests(200, image=16, explore=explore) for explore in (True, False))

    def added() -> np.ndarray:
        noisy, stock = (np.stack([d.chunk for d in adapter.decide(some, 0)]) for some in (asked, still))
        return (noisy - stock) / 0.5

    assert abs(added().mean()) < 0.03 and added().std() == pytest.approx(0.24, rel=0.05)
    with torch.no_grad():
        adapter.family.std.out.bias.copy_(torch.tensor([50.0, -50.0]))
    assert added().std((0, 1)) == pytest.approx([0.6, 0.06], rel=0.06)


FEATURES = torch.randn(2, 4, 6, generator=torch.Generator().manual_seed(1))
MASK = torch.tensor([[True, True, True, False], [True, True, False, False]])


def test_a_new_critic_says_0_and_its_weights_depend_on_the_seed_alone():
    heads = []
    for seed, draws in ((3, 0), (3, 1000), (4, 0)):
        torch.manual_seed(seed)
        torch.randn(draws)
        heads.append(ValueHead(6))
    assert torch.equal(heads[0](FEATURES, MASK), torch.zeros(2))
    assert torch.equal(heads[0].hidden.weight, heads[1].hidden.weight)
    assert not torch.equal(heads[0].hidden.weight, heads[2].hidden.weight)


def test_a_critic_by_hand_whose_gradient_stops_at_the_features():
    torch.manual_seed(0)
    critic, features = ValueHead(6), FEATURES.clone().requires_grad_()
    with torch.no_grad():
        for parameter in critic.parameters():
            parameter.normal_()
    values = critic(features, MASK)
    seen = features[1, :2].detach()
    pooled = (torch.softmax(seen @ critic.query / 6**0.5, 0)[:, None] * seen).sum(0)
    assert_close(values[1], critic.out(torch.relu(critic.hidden(critic.norm(pooled))))[0])
    values.sum().backward()
    assert all(p.grad is not None and p.grad.abs().max() > 0 for p in critic.parameters())
    assert features.grad is None
