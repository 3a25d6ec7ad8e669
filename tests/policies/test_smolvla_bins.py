# SPDX-License-Identifier: Apache-2.0
"""``smolvla_bins``, in numbers: what acts and what re-scores are one policy; at rest it is LeRobot's own."""

from __future__ import annotations

import copy
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from accerl_lerobot.algorithms import GIPOConfig
from accerl_lerobot.engine.local import LocalEngine
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Request
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.base import stack_observations
from accerl_lerobot.policies.config import PolicyConfig, TuningConfig
from accerl_lerobot.policies.loading import load_adapter, save_pretrained
from accerl_lerobot.policies.samplers import FlowSamplerConfig, TokenSamplerConfig
from accerl_lerobot.policies.tokens import TokenFamily
from accerl_lerobot.trainer.config import TrainerConfig
from tests.policies.tiny import (
    adapter_at,
    check_batches,
    check_journey,
    check_ratio_one,
    log_ratio,
    perturb,
    requests,
    stored,
)
from tests.policies.tiny_bins import write_bins
from tests.rounding import assert_close
from tests.runs import drive
from tests.test_local import learning_run, success, updates

BINS, ROWS, DIMS = 32, 3, 2
LOW, HIGH = -0.5, 1.5


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Rows that are not executed, and action units that are not the policy's."""
    directory = tmp_path_factory.mktemp("bins") / "pretrained_model"
    return write_bins(directory, chunk=5, executed=ROWS, num_bins=BINS, action_range=(LOW, HIGH))


@pytest.fixture(scope="module")
def loaded(path: Path) -> LeRobotAdapter:
    adapter = adapter_at(path)
    perturb(adapter, 0.3)  # a new head's logits are all but flat
    return adapter


@pytest.fixture
def adapter(loaded: LeRobotAdapter) -> LeRobotAdapter:
    """One of its own for each test."""
    return copy.deepcopy(loaded)


def at_temperature(adapter: LeRobotAdapter, temperature: float) -> LeRobotAdapter:
    family = TokenFamily(adapter.model, TokenSamplerConfig(temperature=temperature))
    return LeRobotAdapter(adapter.policy, adapter.processing, adapter.model, family, adapter.value_head)


def slow_log_probs(adapter: LeRobotAdapter, asked: list[Request], temperature: float) -> np.ndarray:
    """Log-probs of every bin, (B, L, bins), one request at a time, by the head's matrix in double
    precision."""
    head, rows = adapter.policy.model.head, []
    weight, bias = head.weight.detach().double().numpy(), head.bias.detach().double().numpy()
    for request in asked:
        observations, tasks = stack_observations([request])
        with torch.no_grad():
            hidden = adapter.policy.hidden(adapter.processing.prepare(observations, tasks))[0]
        logits = (hidden[: ROWS * DIMS].double().numpy() @ weight.T + bias) / temperature
        rows.append(logits - np.log(np.exp(logits).sum(-1, keepdims=True)))
    return np.stack(rows)


@pytest.mark.parametrize("temperature", [1.0, 0.7])
def test_decisions_and_ratio_one_do_not_depend_on_the_batch(adapter: LeRobotAdapter, temperature: float):
    together = check_batches(at_temperature(adapter, temperature), requests(64), few=16)
    for one in together:
        assert one.chunk.shape == (ROWS, DIMS) and one.latent["tokens"].dtype == np.int64
        assert one.log_prob.shape == (ROWS * DIMS,) and (one.log_prob < 0).all()
    assert len({d.chunk.tobytes() for d in together}) == 64


def test_the_chunk_is_the_tokens_bin_centres_in_the_world_s_units(adapter: LeRobotAdapter):
    decisions = adapter.decide(requests(8), 0)
    tokens = np.stack([d.latent["tokens"] for d in decisions]).reshape(8, ROWS, DIMS)
    expected = LOW + (HIGH - LOW) * (tokens + 0.5) / BINS
    assert_close(np.stack([d.chunk for d in decisions]), expected)
    assert len(np.unique(tokens)) > BINS // 2


@pytest.mark.parametrize("temperature", [1.0, 0.7])
def test_other_weights_give_the_oracle_s_ratio(adapter: LeRobotAdapter, temperature: float):
    adapter, asked = at_temperature(adapter, temperature), requests(4)
    decisions = adapter.decide(asked, 0)
    old = slow_log_probs(adapter, asked, temperature)
    perturb(adapter, 0.3, seed=1)
    new = slow_log_probs(adapter, asked, temperature)
    tokens = np.stack([d.latent["tokens"] for d in decisions])[..., None]
    assert_close(np.stack([d.log_prob for d in decisions]), np.take_along_axis(old, tokens, -1)[..., 0])
    expected = np.take_along_axis(new - old, tokens, -1)[..., 0].sum(1)
    assert np.allclose(log_ratio(adapter, asked, decisions), expected, atol=1e-4)
    assert np.abs(expected).max() > 0.05, "the weights must have moved the policy"


def test_weighted_samples_of_mu_are_samples_of_pi(adapter: LeRobotAdapter):
    count, one = 4000, requests(1)[0]
    asked = [Request(observation=one.observation, noise_seed=i) for i in range(count)]
    decisions = adapter.decide(asked, 0)
    before = np.exp(slow_log_probs(adapter, [one], 1.0))[0]
    perturb(adapter, 0.1, seed=1)
    with torch.no_grad():
        adapter.policy.model.head.bias += torch.linspace(-0.4, 0.4, BINS)
    ratio = log_ratio(adapter, asked, decisions).double().exp().numpy()
    after = np.exp(slow_log_probs(adapter, [one], 1.0))[0]

    def payoff(first: np.ndarray, last: np.ndarray) -> np.ndarray:
        return np.tanh(2 * first - last) + first * last

    def exact(p: np.ndarray) -> float:
        centres = LOW + (HIGH - LOW) * (np.arange(BINS) + 0.5) / BINS
        return float(p[0] @ payoff(centres[:, None], centres[None]) @ p[-1])

    chunks = np.stack([d.chunk for d in decisions])
    product = ratio * payoff(chunks[:, 0, 0], chunks[:, -1, -1])
    error = product.std() / math.sqrt(count)
    assert abs(exact(before) - exact(after)) > 8 * error, "the weights must matter, or the test shows nothing"
    assert abs(product.mean() - exact(after)) < 4 * error
    assert abs(ratio.mean() - 1) < 4 * ratio.std() / math.sqrt(count)


def test_ratio_one_after_save_and_load_and_a_segment_s_journey(
    adapter: LeRobotAdapter, path: Path, tmp_path: Path
):
    adapter, asked = at_temperature(adapter, 0.7), requests(9)
    perturb(adapter, 0.1)
    check_journey(adapter, asked, path, tmp_path / "saved")


def test_not_exploring_is_lerobot_s_own_policy(adapter: LeRobotAdapter):
    asked = requests(6, explore=False)
    observations, tasks = stack_observations(asked)
    assert adapter.self_check(observations, tasks) == 0.0
    batch = adapter.processing.prepare(observations, tasks)
    stock = adapter.processing.unnormalise(adapter.policy.predict_action_chunk(batch))
    assert stock.shape == (6, 5, DIMS)
    decisions = adapter.decide(asked, 0)
    chunks = np.stack([d.chunk for d in decisions])
    assert np.array_equal(chunks, stock[:, :ROWS].numpy())
    assert not any(d.log_prob.any() for d in decisions)
    steps = [adapter.processing.unnormalise(adapter.policy.select_action(batch)) for _ in range(2 * ROWS)]
    assert np.array_equal(chunks, torch.stack(steps[:ROWS], 1).numpy())
    assert np.array_equal(chunks, torch.stack(steps[ROWS:], 1).numpy()), "a new chunk once used up"
    noisy = np.stack([d.chunk for d in adapter.decide(requests(6), 0)])
    assert np.abs(noisy - chunks).max() > 0.1


def test_a_policy_that_acts_otherwise_is_refused(adapter: LeRobotAdapter, monkeypatch: pytest.MonkeyPatch):
    example = stack_observations(requests(2))
    stock = type(adapter.policy).predict_action_chunk
    with monkeypatch.context() as patch:
        shifted = lambda self, batch: stock(self, batch) + 2 / BINS  # noqa: E731  one bin
        patch.setattr(type(adapter.policy), "predict_action_chunk", shifted)
        with pytest.raises(InputError, match=r"does not fit LeRobot 0\.6\.1: it differs .* by 6\.25e-02"):
            adapter.self_check(*example)
    with monkeypatch.context() as patch:
        patch.delattr(type(adapter.policy), "hidden")
        with pytest.raises(InputError, match=r"cannot drive it \(AttributeError: .*hidden"):
            adapter.self_check(*example)
    with torch.no_grad():
        adapter.policy.model.head.bias.fill_(float("nan"))
    with pytest.raises(InputError, match="differs from its sampler by nan"):
        adapter.self_check(*example)


def test_values_are_those_of_evaluate_and_read_the_action_queries(adapter: LeRobotAdapter):
    asked = requests(6)
    observations, tasks = stack_observations(asked)
    latent, _ = stored(adapter.decide(asked, 0))
    values = adapter.values(observations, tasks)
    evaluation = adapter.evaluate(observations, tasks, latent)
    assert torch.equal(values, evaluation.value.mean.detach()) and values.std() > 0
    assert not values.requires_grad and evaluation.log_prob.requires_grad
    batch = adapter.processing.prepare(observations, tasks)
    encoded = adapter.model.encode(batch)
    assert torch.equal(encoded.features, adapter.policy.hidden(batch))
    assert encoded.features.shape == (6, 5 * DIMS, 32) and encoded.mask.all()
    assert adapter.actions == ROWS


def test_gradients_reach_every_trainable_parameter(adapter: LeRobotAdapter):
    asked = requests(8)
    latent, _ = stored(adapter.decide(asked, 0))
    evaluation = adapter.evaluate(*stack_observations(asked), latent)
    (evaluation.log_prob.sum() + evaluation.value.mean.sum()).backward()
    parameters = adapter.trainable()
    silent = [k for k, p in parameters.items() if p.grad is None or not p.grad.abs().max() > 0]
    assert silent == []
    for part in ("vision_model", "connector", "text_model", "state_proj", "queries", "head", "value_head"):
        assert any(part in k for k in parameters), part


@pytest.mark.parametrize("what", ["log_prob", "entropy"])
def test_gradients_against_finite_differences(adapter: LeRobotAdapter, what: str):
    # fp32: along the gradient itself, where the change is large against rounding.
    asked = requests(8)
    latent, _ = stored(adapter.decide(asked, 0))
    observations = stack_observations(asked)
    getattr(adapter.evaluate(*observations, latent), what).sum().backward()
    named = {k: p for k, p in adapter.trainable().items() if not k.startswith("value_head.")}
    for part in ("vision_model", "text_model", "queries", "head"):
        gradients = {k: p.grad.clone() for k, p in named.items() if part in k}
        norm = float(torch.cat([g.flatten() for g in gradients.values()]).norm())
        home, scores, step = {k: named[k].detach().clone() for k in gradients}, [], 0.05 / norm
        for sign in (1, -1):
            with torch.no_grad():
                for key, gradient in gradients.items():
                    named[key].copy_(home[key] + sign * step * gradient / norm)
                scores.append(float(getattr(adapter.evaluate(*observations, latent), what).double().sum()))
        with torch.no_grad():
            for key, value in home.items():
                named[key].copy_(value)
        assert (scores[0] - scores[1]) / (2 * step) == pytest.approx(norm, rel=0.02), part


def test_the_checkpoint_is_stock_lerobot_s(adapter: LeRobotAdapter, path: Path, tmp_path: Path):
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors

    save_pretrained(adapter, tmp_path / "saved", PolicyConfig(path=str(path), device="cpu"))
    policy = get_policy_class("smolvla_bins").from_pretrained(tmp_path / "saved")
    pre, post = make_pre_post_processors(policy.config, pretrained_path=str(tmp_path / "saved"))
    asked = requests(3, explore=False)
    observations, tasks = stack_observations(asked)
    images = torch.from_numpy(observations["observation.images.front"]).permute(0, 3, 1, 2) / 255
    state = torch.from_numpy(observations["observation.state"])
    batch = pre({"observation.images.front": images, "observation.state": state, "task": tasks})
    chunk = post(policy.predict_action_chunk(batch))
    assert np.array_equal(chunk[:, :ROWS].numpy(), np.stack([d.chunk for d in adapter.decide(asked, 0)]))
    assert policy.config.vlm_model_name == str(tmp_path / "saved" / "backbone")


def test_lora_and_expert_tuning(path: Path, tmp_path: Path):
    lora = load_adapter(PolicyConfig(path=str(path), device="cpu", tuning=TuningConfig(mode="lora", rank=2)))
    names = [k for k in lora.trainable() if k.startswith("policy.")]
    assert names and all(".lora_" in k for k in names)
    for part in ("q_proj", "v_proj", "state_proj", "head"):
        assert any(part in k for k in names), part
    perturb(lora, 1.0)
    save_pretrained(lora, tmp_path / "merged", PolicyConfig(path=str(path), device="cpu"))
    asked = requests(4)
    decisions = lora.decide(asked, 0)
    check_ratio_one(adapter_at(tmp_path / "merged"), asked, decisions)
    assert log_ratio(adapter_at(path), asked, decisions).abs().max() > 0.01
    expert = load_adapter(PolicyConfig(path=str(path), device="cpu", tuning=TuningConfig(mode="expert")))
    heads = {k.split(".")[2] for k in expert.trainable() if k.startswith("policy.")}
    assert heads == {"queries", "state_proj", "head"}


def test_a_run_s_options_are_checked(path: Path):
    with pytest.raises(InputError, match=r"^policy\.sampler\.type=.*explores by tokens"):
        adapter_at(path, FlowSamplerConfig())
    with pytest.raises(InputError, match=r"^policy\.num_steps=.*does not denoise"):
        adapter_at(path, num_steps=3)
    short = adapter_at(path, n_action_steps=1)
    decision = short.decide(requests(1), 0)[0]
    assert decision.chunk.shape == (1, DIMS) and decision.latent["tokens"].shape == (DIMS,)


def test_it_learns_by_reinforcement(tmp_path: Path):
    """From random weights: 4 tokens a decision, a reward at every step."""
    checkpoint = write_bins(tmp_path / "pretrained_model", chunk=2, executed=2, num_bins=16)
    config = learning_run(
        checkpoint,
        env=SimulatedConfig(max_steps=4, hold=2, tolerance=0.3, reward="dense", terminate_on_success=False),
        policy=PolicyConfig(path=str(checkpoint), device="cpu"),
        algorithm=GIPOConfig(gamma=0.5, entropy_coef=0.03),
        trainer=TrainerConfig(
            updates=80, batch_decisions=256, lr=4e-3, value_lr=3e-3, warmup_updates=3, value_warmup_updates=5
        ),
    )
    engine = LocalEngine(config, ("match",))
    before = success(engine)
    engine.train()
    history = updates(drive(engine))
    after = success(engine)
    engine.close()
    assert before < 0.25 and after > 0.5, f"{before:.0%} → {after:.0%}"
    rewards = [u["reward_mean"] for u in history]
    assert np.mean(rewards[-10:]) > np.mean(rewards[:10]) + 0.5
    assert history[-1]["entropy"] < history[0]["entropy"] - 1
