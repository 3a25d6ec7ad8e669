# SPDX-License-Identifier: Apache-2.0
"""SmolVLA, in numbers: what acts and what re-scores are one policy; not exploring, it is LeRobot's own."""

from __future__ import annotations

import copy
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Request
from accerl_lerobot.policies import flow
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.base import stack_observations
from accerl_lerobot.policies.config import PolicyConfig, ValueHeadConfig
from accerl_lerobot.policies.loading import save_pretrained
from accerl_lerobot.policies.samplers import FlowSamplerConfig
from tests.conftest import write_smolvla
from tests.policies.flow_contract import exploring, name, samplers, slow_log_prob
from tests.policies.tiny import (
    adapter_at,
    check_batches,
    check_gradient,
    check_journey,
    check_ratio_one,
    log_ratio,
    perturb,
    requests,
    stored,
)

SAMPLERS = samplers(0.2)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Padded dims, and rows that are not executed: what the traps are about."""
    directory = tmp_path_factory.mktemp("smolvla") / "pretrained_model"
    return write_smolvla(directory, chunk=5, executed=3, padded_dim=4, action_dim=2, num_steps=3)


@pytest.fixture(scope="module")
def loaded(path: Path) -> LeRobotAdapter:
    return adapter_at(path)


@pytest.fixture
def adapter(loaded: LeRobotAdapter) -> LeRobotAdapter:
    """One of its own for each test."""
    return copy.deepcopy(loaded)


@pytest.mark.parametrize("config", SAMPLERS, ids=name)
def test_decisions_and_ratio_one_do_not_depend_on_the_batch(
    adapter: LeRobotAdapter, config: FlowSamplerConfig
):
    for one in check_batches(exploring(adapter, config), requests(64), few=16):
        assert one.chunk.shape == (3, 2) and one.chunk.dtype == np.float32 and one.version == 7
        assert one.log_prob.dtype == np.float32


@pytest.mark.parametrize("config", SAMPLERS, ids=name)
def test_other_weights_give_the_oracle_s_ratio(adapter: LeRobotAdapter, config: FlowSamplerConfig):
    adapter, asked = exploring(adapter, config), requests(4)
    decisions = adapter.decide(asked, 0)
    latent, old = stored(decisions)
    perturb(adapter, 0.3)
    expected = slow_log_prob(adapter, asked, latent)
    change = log_ratio(adapter, asked, decisions).numpy()
    assert np.allclose(change, (expected - old.numpy()).sum(1), atol=2e-4)
    assert np.abs(change).max() > 0.05, "the weights must have moved the policy"


def test_the_same_batch_gives_the_same_decisions_to_the_bit(adapter: LeRobotAdapter):
    asked = requests(5)
    one, other = adapter.decide(asked, 0), adapter.decide(asked, 0)
    assert pickle.dumps(one) == pickle.dumps(other)
    torch.manual_seed(1)
    assert pickle.dumps(adapter.decide(asked, 0)) == pickle.dumps(one), "no global generator is read"


def test_seed_observation_and_instruction_all_matter(adapter: LeRobotAdapter):
    first = requests(1)[0]
    observation = first.observation
    others = [
        Request(observation=observation, noise_seed=99),
        *(
            Request(observation=observation | {key: value}, noise_seed=first.noise_seed)
            for key, value in {
                "observation.state": np.ones(4, np.float32),
                "observation.images.front": np.zeros((32, 32, 3), np.uint8),
                "task": "Stay",
            }.items()
        ),
    ]
    chunk = adapter.decide([first], 0)[0].chunk
    for other in others:
        assert np.abs(adapter.decide([other], 0)[0].chunk - chunk).max() > 1e-3


@pytest.mark.parametrize("config", SAMPLERS, ids=name)
def test_ratio_one_after_save_and_load_and_a_segment_s_journey(
    adapter: LeRobotAdapter, path: Path, tmp_path: Path, config: FlowSamplerConfig
):
    adapter, asked = exploring(adapter, config), requests(9)
    perturb(adapter, 0.1)
    check_journey(adapter, asked, path, tmp_path / "saved")


@pytest.mark.parametrize("config", SAMPLERS, ids=name)
def test_not_exploring_is_lerobot_s_own_sampler(adapter: LeRobotAdapter, config: FlowSamplerConfig):
    adapter, asked = exploring(adapter, config), requests(6, explore=False)
    observations, tasks = stack_observations(asked)
    assert adapter.self_check(observations, tasks) == 0.0
    noise, _, _ = adapter.family._noise(asked, adapter.device)
    batch = adapter.processing.prepare(observations, tasks)
    stock = adapter.processing.unnormalise(adapter.policy.predict_action_chunk(batch, noise=noise))
    adapter.policy.reset()
    chunks = np.stack([d.chunk for d in adapter.decide(asked, 0)])
    assert np.array_equal(chunks, stock[:, :3].numpy())
    noisy = np.stack([d.chunk for d in adapter.decide(requests(6), 0)])
    assert np.abs(noisy - chunks).max() > 1e-2


def test_the_executed_noise_has_the_configured_size(adapter: LeRobotAdapter):
    # Under ``last`` and euler the executed action is the stock one plus N(0, 0.2²) in normalised units;
    # the checkpoint's action std is 0.5.
    adapter = exploring(adapter, FlowSamplerConfig(stochastic="last", noise="euler", noise_level=0.2))
    noisy = np.stack([d.chunk for d in adapter.decide(requests(200), 0)])
    stock = np.stack([d.chunk for d in adapter.decide(requests(200, explore=False), 0)])
    added = (noisy - stock) / 0.5
    assert abs(added.mean()) < 0.02 and added.std() == pytest.approx(0.2, rel=0.06)


def test_a_changed_velocity_is_refused(adapter: LeRobotAdapter, monkeypatch: pytest.MonkeyPatch):
    observations, tasks = stack_observations(requests(2))
    encode = adapter.model.encode

    def tampered(batch):  # noqa: ANN001, ANN202
        encoded = encode(batch)
        context = flow.FlowContext(velocity=lambda x, t: 1.001 * encoded.context.velocity(x, t))
        return replace(encoded, context=context)

    monkeypatch.setattr(adapter.model, "encode", tampered)
    with pytest.raises(InputError, match=r"does not fit LeRobot 0\.6\.1: it differs from its sampler by \d"):
        adapter.self_check(observations, tasks)


def test_an_incompatible_lerobot_fails_at_load(path: Path, monkeypatch: pytest.MonkeyPatch):
    from lerobot.policies.smolvla import modeling_smolvla

    def midpoint(denoise, noise, num_steps, **options):  # noqa: ANN001, ANN003, ANN202
        x, dt = noise, -1.0 / num_steps
        for step in range(num_steps):
            x = x + dt * denoise(x, torch.full((len(x),), 1.0 + (step + 0.5) * dt))
        return x

    with monkeypatch.context() as patch:
        patch.setattr(modeling_smolvla, "euler_integrate", midpoint)
        with pytest.raises(InputError, match="differs from its sampler"):
            adapter_at(path)
    monkeypatch.delattr(modeling_smolvla.VLAFlowMatching, "embed_prefix")
    with pytest.raises(InputError, match=r"cannot drive it \(AttributeError: .*embed_prefix"):
        adapter_at(path)


def test_weights_that_compute_nan_are_refused(adapter: LeRobotAdapter):
    with torch.no_grad():
        adapter.policy.model.action_out_proj.bias.fill_(float("nan"))
    with pytest.raises(InputError, match="differs from its sampler by nan"):
        adapter.self_check(*stack_observations(requests(2)))


def test_values_are_those_of_evaluate_and_carry_no_gradient(adapter: LeRobotAdapter):
    perturb(adapter, 0.1)
    asked = requests(6)
    observations, tasks = stack_observations(asked)
    latent, _ = stored(adapter.decide(asked, 0))
    values = adapter.values(observations, tasks)
    evaluation = adapter.evaluate(observations, tasks, latent)
    assert (
        not values.requires_grad and evaluation.value.mean.requires_grad and evaluation.log_prob.requires_grad
    )
    assert torch.equal(
        values, evaluation.value.mean.detach()
    ) and values.shape == evaluation.entropy.shape == (6,)
    assert values.std() > 0


@pytest.mark.parametrize("stochastic", ["last", "all", "one"])
def test_gradients_reach_every_trainable_parameter(adapter: LeRobotAdapter, stochastic: str):
    adapter, asked = exploring(adapter, FlowSamplerConfig(stochastic=stochastic)), requests(8)
    perturb(adapter, 0.1)  # the critic starts at zero, where only its output layer has a gradient
    latent, _ = stored(adapter.decide(asked, 0))
    evaluation = adapter.evaluate(*stack_observations(asked), latent)
    (evaluation.log_prob.sum() + evaluation.value.mean.sum()).backward()
    parameters = adapter.trainable()
    silent = [k for k, p in parameters.items() if p.grad is None or not p.grad.abs().max() > 0]
    assert silent == []
    assert any("vision_model" in k for k in parameters) and any("lm_expert" in k for k in parameters)


@pytest.mark.parametrize("detach", [True, False])
def test_the_value_loss_reaches_the_backbone_only_when_asked(path: Path, detach: bool):
    adapter = adapter_at(path, value_head=ValueHeadConfig(detach=detach))
    perturb(adapter, 0.1)
    asked = requests(4)
    latent, _ = stored(adapter.decide(asked, 0))
    adapter.evaluate(*stack_observations(asked), latent).value.mean.square().sum().backward()
    reached = {k for k, p in adapter.trainable().items() if p.grad is not None and p.grad.abs().max() > 0}
    critic = {k for k in adapter.trainable() if k.startswith("value_head.")}
    assert critic <= reached
    assert (reached == critic) if detach else any("vision_model" in k for k in reached)


@pytest.mark.parametrize("config", [c for c in SAMPLERS if c.padded == "joint"], ids=name)
def test_log_prob_s_gradient_against_finite_differences(adapter: LeRobotAdapter, config: FlowSamplerConfig):
    adapter, asked = exploring(adapter, config), requests(8)
    decisions = adapter.decide(asked, 0)
    perturb(adapter, 0.2)
    parts = ("vision_model", "text_model", "lm_expert", "action_out_proj")
    check_gradient(adapter, asked, decisions, parts, step=0.05)


def test_published_weights_go_round_and_make_the_same_policy(loaded: LeRobotAdapter):
    trainer, reader, asked = copy.deepcopy(loaded), copy.deepcopy(loaded), requests(5)
    perturb(trainer, 0.1)
    exported = trainer.export_trainable()
    assert all(a.dtype == np.float32 for a in exported.values())
    assert any(k.startswith("value_head.") for k in exported)
    before = pickle.dumps(reader.decide(asked, 0))
    for array in exported.values():
        array.setflags(write=False)  # as out of Ray's object store
    reader.load_trainable(exported)
    assert pickle.dumps(reader.decide(asked, 0)) == pickle.dumps(trainer.decide(asked, 0)) != before
    perturb(trainer, 0.1)
    assert np.array_equal(exported["value_head.out.bias"], reader.export_trainable()["value_head.out.bias"])


def test_weights_that_do_not_fit_change_nothing(adapter: LeRobotAdapter):
    good = adapter.export_trainable()
    moved = {k: v + 1 for k, v in good.items()}
    first = next(iter(moved))
    with pytest.raises(ValueError, match=f"published weights differ by name: .*{first}"):
        adapter.load_trainable({k: v for k, v in moved.items() if k != first})
    last = list(moved)[-1]
    with pytest.raises(ValueError, match=rf"published {last} has shape \(7,\), not"):
        adapter.load_trainable(moved | {last: np.zeros(7, np.float32)})
    assert all(np.array_equal(a, good[k]) for k, a in adapter.export_trainable().items())


def test_training_touches_neither_normalisation_nor_what_lerobot_froze(
    adapter: LeRobotAdapter, path: Path, tmp_path: Path
):
    asked = requests(4)
    state = {k: v.clone() for k, v in adapter.policy.state_dict().items()}
    trainable = adapter.trainable()
    latent, _ = stored(adapter.decide(asked, 0))
    optimizer = torch.optim.AdamW(trainable.values(), lr=1e-2)
    evaluation = adapter.evaluate(*stack_observations(asked), latent)
    (evaluation.log_prob.sum() + evaluation.value.mean.sum()).backward()
    optimizer.step()
    save_pretrained(adapter, tmp_path / "trained", PolicyConfig(path=str(path), device="cpu"))
    files = sorted(f.name for f in path.glob("policy_*processor*.safetensors"))
    assert len(files) == 2
    for file in files:
        assert (tmp_path / "trained" / file).read_bytes() == (path / file).read_bytes()
    moved = {k for k, v in adapter.policy.state_dict().items() if not torch.equal(v, state[k])}
    assert moved == {k.removeprefix("policy.") for k in trainable if k.startswith("policy.")}
    frozen = {k for k, p in adapter.policy.named_parameters() if not p.requires_grad}
    assert frozen and not frozen & moved


@pytest.mark.parametrize("config", [c for c in SAMPLERS if c.stochastic == "last"], ids=name)
def test_only_executed_entries_are_scored(adapter: LeRobotAdapter, config: FlowSamplerConfig):
    adapter, asked = exploring(adapter, config), requests(4)
    decisions = adapter.decide(asked, 0)
    for decision in decisions:
        decision.latent["path"][1, 3:] += 1.0
        decision.latent["path"][1, :, 2:] += 1.0
    check_ratio_one(adapter, asked, decisions)
    for decision in decisions:
        decision.latent["path"][1, 2, 1] += 0.1
    assert log_ratio(adapter, asked, decisions).abs().min() > 1e-3


@pytest.mark.parametrize(("stochastic", "points"), [("last", 2), ("all", 4), ("one", 2)])
def test_the_latent_is_as_small_as_re_scoring_allows(adapter: LeRobotAdapter, stochastic: str, points: int):
    decision = exploring(adapter, FlowSamplerConfig(stochastic=stochastic)).decide(requests(1), 0)[0]
    assert decision.latent["path"].shape == (points, 5, 4)


def test_the_shape_is_the_policy_s(adapter: LeRobotAdapter):
    assert adapter.family.shape == flow.FlowShape(
        num_steps=3, chunk_size=5, executed=3, padded_dim=4, action_dim=2
    )


def test_half_precision_is_a_little_off_and_log_probs_stay_in_full(path: Path):
    full, half, asked = adapter_at(path), adapter_at(path, precision="bf16"), requests(6)
    decisions, other = full.decide(asked, 0), half.decide(asked, 0)
    gap = np.abs(np.stack([d.chunk for d in decisions]) - np.stack([d.chunk for d in other])).max()
    assert 1e-5 < gap < 0.1, "the network runs in bfloat16"
    latent, old = stored(other)
    evaluation = half.evaluate(*stack_observations(asked), latent)
    assert old.dtype == evaluation.log_prob.dtype == evaluation.value.mean.dtype == torch.float32
    assert (evaluation.log_prob - old).sum(1).abs().max() < 0.5
    evaluation.log_prob.sum().backward()
    assert all(p.dtype == torch.float32 for p in half.trainable().values())
    assert any(p.grad is not None and p.grad.abs().max() > 0 for p in half.trainable().values())


@pytest.mark.parametrize("config", SAMPLERS, ids=name)
def test_each_factor_is_an_action_and_all_of_them_exist(adapter: LeRobotAdapter, config: FlowSamplerConfig):
    adapter = exploring(adapter, config)
    decision = adapter.decide(requests(1), 0)[0]
    assert decision.log_prob.shape == (adapter.actions,)
    assert adapter.factors(stored([decision])[0]) is None
