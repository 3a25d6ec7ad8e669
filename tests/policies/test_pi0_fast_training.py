# SPDX-License-Identifier: Apache-2.0
"""π0-FAST in training: gradients, importance weights, precision, and that a policy gets better."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.algorithms import GIPOConfig
from accerl_lerobot.engine.config import RunConfig
from accerl_lerobot.engine.contract import Engine
from accerl_lerobot.engine.local import LocalEngine
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.evaluation.config import evaluation_plans
from accerl_lerobot.experience import Request
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.base import stack_observations
from accerl_lerobot.policies.config import PolicyConfig, TuningConfig
from accerl_lerobot.policies.loading import save_pretrained
from accerl_lerobot.policies.samplers import TokenSamplerConfig
from accerl_lerobot.replay import ReplayConfig
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.trainer.config import TrainerConfig
from tests.policies.tiny import (
    TOLERANCE,
    adapter_at,
    check_gradient,
    check_ratio_one,
    log_ratio,
    perturb,
    requests,
    stored,
)
from tests.policies.tiny_pi import LOWEST, SKIP, VOCABULARY, small, write_pi
from tests.rounding import assert_close
from tests.runs import collect, drive, tiny_run

LENGTH = 10


@pytest.fixture(scope="module", autouse=True)
def sizes() -> Iterator[None]:
    with small():
        yield


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pi(tmp_path_factory.mktemp("pi0_fast") / "pretrained_model", "pi0_fast", num_steps=LENGTH)


@pytest.fixture(scope="module")
def loaded(path: Path) -> LeRobotAdapter:
    return adapter_at(path)


@pytest.fixture
def adapter(loaded: LeRobotAdapter) -> LeRobotAdapter:
    """One of its own for each test."""
    return copy.deepcopy(loaded)


def test_gradients_reach_every_trainable_parameter(adapter: LeRobotAdapter):
    asked = requests(8)
    perturb(adapter, 0.1)  # the critic starts at zero, where only its output layer has a gradient
    latent, _ = stored(adapter.decide(asked, 0))
    evaluation = adapter.evaluate(*stack_observations(asked), latent)
    (evaluation.log_prob.sum() + evaluation.value.mean.sum()).backward()
    parameters = adapter.trainable()
    assert [k for k, p in parameters.items() if p.grad is None or not p.grad.abs().max() > 0] == []
    for part in ("vision_tower", "multi_modal_projector", "embed_tokens", "lm_head"):
        assert any(part in k for k in parameters), part
    embedding = adapter.policy.model.paligemma_with_expert.paligemma.model.language_model.embed_tokens
    fed = latent["tokens"][:, :-1][adapter.factors(latent)[:, 1:]].unique()
    assert len(fed) > 10 and (embedding.weight.grad[fed].abs().amax(1) > 0).all(), "what was said is read"


@pytest.mark.parametrize("temperature", [1.0, 0.6])
def test_log_prob_s_gradient_against_finite_differences(path: Path, temperature: float):
    adapter = adapter_at(path, TokenSamplerConfig(temperature=temperature))
    asked = requests(8)
    decisions = adapter.decide(asked, 0)
    perturb(adapter, 0.05)
    parts = ("vision_tower", "embed_tokens", "language_model.layers", "lm_head")
    check_gradient(adapter, asked, decisions, parts, step=0.02)


def deviation(one: Tensor, other: Tensor) -> float:
    """Difference of two means in units of its standard error."""
    error = math.sqrt(one.var().item() / len(one) + other.var().item() / len(other))
    return abs(one.mean().item() - other.mean().item()) / error


@pytest.mark.parametrize("temperature", [1.0, 0.6])
def test_weighted_samples_of_mu_are_samples_of_pi(tmp_path: Path, temperature: float):
    path = write_pi(tmp_path / "fast", "pi0_fast", chunk=2, executed=2, num_steps=4, prompt=28)
    adapter, count = adapter_at(path, TokenSamplerConfig(temperature=temperature)), 4000
    prepared = adapter.processing.prepare(*stack_observations(requests(1)))
    batch = {k: v.expand(count, *v.shape[1:]) for k, v in prepared.items() if isinstance(v, Tensor)}
    head = adapter.policy.model.paligemma_with_expert.paligemma.lm_head.weight

    @torch.no_grad()
    def act(seed: int) -> tuple[Tensor, dict[str, Tensor], Tensor]:
        asked = [Request(observation={}, noise_seed=seed + i) for i in range(count)]
        action = adapter.family.act(adapter.model.encode(batch), asked)
        executed = adapter.processing.unnormalise(action.chunk)
        payoff = torch.tanh(executed[:, 0, 0] + executed[:, 1, 0]) * (1 + torch.tanh(executed[:, 0, 1]) ** 2)
        return payoff, action.latent, action.log_prob.sum(1)

    old, latent, behaviour = act(0)
    perturb(adapter, 0.03)
    last = VOCABULARY - 1 - SKIP + LOWEST  # of those whose coefficient is above zero
    with torch.no_grad():
        head[last - 30 : last] += 0.03 * adapter.model.encode(prepared).features[0, -1]
        ratio = (adapter.family.score(adapter.model.encode(batch), latent).log_prob.sum(1) - behaviour).exp()
    new, _, _ = act(10_000)
    assert deviation(old, new) > 8, "the weights must matter, or the test shows nothing"
    assert deviation(ratio, torch.ones(2)) < 4
    assert deviation(ratio * old, new) < 4


def test_log_probs_are_float32_where_the_network_is_bfloat16(path: Path):
    adapter, asked = adapter_at(path, TokenSamplerConfig(temperature=0.7), precision="bf16"), requests(6)
    written: list[Tensor] = []
    head = adapter.policy.model.paligemma_with_expert.paligemma.lm_head
    head.register_forward_hook(lambda *given: written.append(given[2].detach()))
    latent, old = stored(adapter.decide(asked, 0))
    written.clear()
    evaluation = adapter.evaluate(*stack_observations(asked), latent)
    assert {t.dtype for t in written} == {torch.bfloat16} and evaluation.log_prob.dtype == torch.float32
    exact = torch.log_softmax(written[0].double() / 0.7, -1)
    exact = exact.gather(-1, latent["tokens"][..., None])[..., 0]
    factors = adapter.factors(latent)
    assert_close(evaluation.log_prob[factors], exact[factors])
    assert (evaluation.log_prob - old).abs().max() < 0.5, "two passes, two roundings"


def test_what_is_tuned(path: Path, tmp_path: Path):
    with pytest.raises(InputError, match="^policy.tuning.mode='expert': pi0_fast has no action expert"):
        adapter_at(path, tuning=TuningConfig(mode="expert"))
    tuning = TuningConfig(mode="lora", rank=4, targets=r".*language_model.*\.(q|v)_proj")
    config = PolicyConfig(path=str(path), device="cpu", tuning=tuning)
    adapter, asked = adapter_at(path, tuning=tuning), requests(5)
    perturb(adapter, 0.5)
    decisions = adapter.decide(asked, 0)
    assert log_ratio(adapter_at(path), asked, decisions).abs().max() > 1e-3
    save_pretrained(adapter, tmp_path / "saved", config)
    plain = adapter_at(tmp_path / "saved")
    check_ratio_one(plain, asked, decisions)


def test_a_random_policy_gets_better(tmp_path: Path):
    # Its state is text, which it would have to learn to read. What it does learn is to stay near the middle.
    checkpoint = write_pi(tmp_path / "fast", "pi0_fast", prompt=40, num_steps=5)
    config: RunConfig = tiny_run(
        checkpoint,
        env=SimulatedConfig(max_steps=8, tolerance=0.3, reward="dense", terminate_on_success=False),
        policy=PolicyConfig(path=str(checkpoint), device="cpu", sampler=TokenSamplerConfig()),
        rollout=RolloutConfig(worlds=32, segment_length=8),
        replay=ReplayConfig(capacity=512, min_decisions=64, ahead=128, samples_per_insert=2.0),
        algorithm=GIPOConfig(gamma=0.5, level="token"),
        trainer=TrainerConfig(
            updates=40,
            batch_decisions=128,
            lr=3e-3,
            value_lr=5e-3,
            warmup_updates=3,
            value_warmup_updates=5,
        ),
    )
    engine = LocalEngine(config, ("match",))
    before = played(engine)
    engine.train()
    updates = [u for progress in drive(engine) for u in progress.updates]
    after = played(engine)
    engine.close()
    assert after > before + 0.7, f"{before:.2f} → {after:.2f}"
    rewards = [u["reward_mean"] for u in updates]
    assert np.mean(rewards[-10:]) > np.mean(rewards[:10]) + 0.2
    assert updates[0]["ratio_max_dev"] <= TOLERANCE


def played(engine: Engine, episodes: int = 64) -> float:
    """Mean return of the greedy policy."""
    engine.plan(evaluation_plans(("match",), episodes, "test"))
    return float(np.mean([r.episode_return for r in collect(engine, "test", episodes)]))
