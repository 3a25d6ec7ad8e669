# SPDX-License-Identifier: Apache-2.0
"""π0 and π0.5, in numbers: what acts and what re-scores are one policy; at rest it is LeRobot's own."""

from __future__ import annotations

import copy
import importlib
import math
import pickle
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Request
from accerl_lerobot.policies import flow
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.base import stack_observations
from accerl_lerobot.policies.samplers import FlowSamplerConfig
from tests.policies.flow_contract import exploring, name, samplers, slow_log_prob
from tests.policies.tiny import (
    adapter_at,
    check_batches,
    check_gradient,
    check_journey,
    log_ratio,
    perturb,
    requests,
    stored,
)
from tests.policies.tiny_pi import KINDS, small, write_pi
from tests.rounding import assert_close

COVERING = (
    "last-euler-joint",
    "all-flow_sde-joint",
    "all-euler-analytic",
    "one-euler-joint",
    "one-flow_sde-analytic",
)
"""Every option in each place; all of their combinations are tried on SmolVLA and in `test_flow`."""
SAMPLERS = [config for config in samplers(0.4) if name(config) in COVERING]
LANGUAGE_MODEL = "paligemma.model.language_model"


@pytest.fixture(scope="module", autouse=True)
def sizes() -> Iterator[None]:
    with small():
        yield


@pytest.fixture(scope="module", params=KINDS)
def path(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Padded dims, and rows that are not executed."""
    directory = tmp_path_factory.mktemp(request.param) / "pretrained_model"
    return write_pi(directory, request.param, chunk=5, executed=3, padded_dim=4, action_dim=2)


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
    for one in check_batches(exploring(adapter, config), requests(32), few=8):
        assert one.chunk.shape == (3, 2) and one.chunk.dtype == one.log_prob.dtype == np.float32


@pytest.mark.parametrize("config", SAMPLERS, ids=name)
def test_other_weights_give_the_oracle_s_ratio(adapter: LeRobotAdapter, config: FlowSamplerConfig):
    adapter, asked = exploring(adapter, config), requests(4)
    decisions = adapter.decide(asked, 0)
    latent, old = stored(decisions)
    perturb(adapter, 0.2)
    expected = slow_log_prob(adapter, asked, latent)
    change = log_ratio(adapter, asked, decisions).numpy()
    assert np.allclose(change, (expected - old.numpy()).sum(1), rtol=1e-4, atol=2e-4)
    assert np.abs(change).max() > 0.05, "the weights must have moved the policy"


def test_the_same_batch_gives_the_same_decisions_to_the_bit(adapter: LeRobotAdapter):
    asked = requests(12)
    together = adapter.decide(asked, 7)
    assert together[0].log_prob.shape == (3,)
    assert pickle.dumps(adapter.decide(asked, 7)) == pickle.dumps(together)


def others(first: Request) -> list[Request]:
    """Requests that differ from `first` in one thing each: state, image, instruction."""
    changes: dict[str, Any] = {
        "observation.state": np.full(4, 0.3, np.float32),
        "observation.images.front": np.zeros((32, 32, 3), np.uint8),
        "task": "Stay",
    }
    return [
        Request(observation=first.observation | {key: value}, noise_seed=first.noise_seed)
        for key, value in changes.items()
    ]


def test_all_that_is_observed_reaches_actor_and_critic(adapter: LeRobotAdapter):
    perturb(adapter, 0.1)  # an untrained critic says 0
    first = requests(1)[0]
    decision = adapter.decide([first], 0)[0]
    for other in others(first):
        changed = adapter.decide([other], 0)[0]
        assert np.abs(changed.chunk - decision.chunk).max() > 1e-3
        assert abs(changed.value - decision.value) > 1e-5
    seed = adapter.decide([replace(first, noise_seed=99)], 0)[0]
    assert np.abs(seed.chunk - decision.chunk).max() > 1e-3 and seed.value == decision.value


def test_the_state_counts_in_full_however_the_critic_weights_its_tokens(tmp_path: Path):
    adapter = adapter_at(write_pi(tmp_path / "pi0", "pi0"))
    first = requests(1)[0]
    arrays, tasks = stack_observations([first])
    encoded = adapter.encode(arrays, tasks)
    weights = torch.softmax(torch.randn(encoded.mask.shape).masked_fill(~encoded.mask, -math.inf), -1)
    pooled = (weights[..., None] * encoded.features).sum(1)
    assert_close(pooled[0, -4:], first.observation["observation.state"] / 0.5)


@pytest.mark.parametrize("config", [c for c in SAMPLERS if c.padded == "joint"], ids=name)
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
    chunks = np.stack([d.chunk for d in adapter.decide(asked, 0)])
    assert np.array_equal(chunks, stock[:, :3].numpy())
    noisy = np.stack([d.chunk for d in adapter.decide(requests(6), 0)])
    assert np.abs(noisy - chunks).max() > 1e-2


def test_the_first_decision_of_a_process_is_lerobot_s_too(path: Path):
    # LeRobot switches PaliGemma to eager attention when it first samples, which is not the default's result.
    adapter, asked = adapter_at(path), requests(3, explore=False)
    config = adapter.policy.model.paligemma_with_expert.paligemma.model.language_model.config
    config._attn_implementation = "sdpa"
    model = type(adapter.model)(adapter.policy)
    assert config._attn_implementation == "eager"
    batch = adapter.processing.prepare(*stack_observations(asked))
    with torch.no_grad():
        assert flow.difference(model, batch, model.encode(batch)) == 0.0


def test_one_cache_serves_every_step(adapter: LeRobotAdapter, monkeypatch: pytest.MonkeyPatch):
    model = adapter.policy.model
    seen: list[tuple[int, Tensor]] = []
    denoise = model.denoise_step

    def recording(**given: Any) -> Tensor:
        cache = given["past_key_values"]
        seen.append((id(cache), cache.layers[0].keys.clone()))
        return denoise(**given)

    monkeypatch.setattr(model, "denoise_step", recording)
    prefixes: list[object] = []
    embed = model.embed_prefix
    monkeypatch.setattr(model, "embed_prefix", lambda *rest: prefixes.append(1) or embed(*rest))
    asked = requests(3)
    latent, _ = stored(adapter.decide(asked, 0))
    adapter = exploring(adapter, FlowSamplerConfig(stochastic="last"))
    assert len(seen) == 3 and len(prefixes) == 1
    assert len({cache for cache, _ in seen}) == 1
    assert all(torch.equal(keys, seen[0][1]) for _, keys in seen), "what a step adds goes into a copy"
    one = exploring(adapter, FlowSamplerConfig(stochastic="one"))
    latent, _ = stored(one.decide(asked, 0))
    seen.clear()
    one.evaluate(*stack_observations(asked), latent).log_prob.sum().backward()
    assert len(seen) == 1, "one drawn step is one pass of the suffix"


def test_a_changed_velocity_is_refused(adapter: LeRobotAdapter, monkeypatch: pytest.MonkeyPatch):
    encode = adapter.model.encode

    def tampered(batch: dict[str, Tensor]) -> Any:
        encoded = encode(batch)
        context = flow.FlowContext(velocity=lambda x, t: 1.001 * encoded.context.velocity(x, t))
        return replace(encoded, context=context)

    monkeypatch.setattr(adapter.model, "encode", tampered)
    with pytest.raises(InputError, match=r"does not fit LeRobot 0\.6\.1: it differs from its sampler by \d"):
        adapter.self_check(*stack_observations(requests(2)))


def test_an_incompatible_lerobot_fails_at_load(path: Path, monkeypatch: pytest.MonkeyPatch):
    module = importlib.import_module(type(adapter_at(path).policy).__module__)

    def midpoint(denoise: Any, noise: Tensor, num_steps: int, **options: Any) -> Tensor:
        x, dt = noise, -1.0 / num_steps
        for step in range(num_steps):
            x = x + dt * denoise(x, torch.full((len(x),), 1.0 + (step + 0.5) * dt))
        return x

    with monkeypatch.context() as patch:
        patch.setattr(module, "euler_integrate", midpoint)
        with pytest.raises(InputError, match="differs from its sampler"):
            adapter_at(path)
    core = module.PI0Pytorch if hasattr(module, "PI0Pytorch") else module.PI05Pytorch
    monkeypatch.delattr(core, "embed_prefix")
    with pytest.raises(InputError, match=r"cannot drive it \(AttributeError: .*embed_prefix"):
        adapter_at(path)


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
    for part in ("vision_tower", "multi_modal_projector", "embed_tokens", "gemma_expert", "action_in_proj"):
        assert any(part in k for k in parameters), part


def test_what_no_action_depends_on_is_not_trained(adapter: LeRobotAdapter):
    asked = requests(4, explore=False)
    before = np.stack([d.chunk for d in adapter.decide(asked, 0)])
    frozen = {k: p for k, p in adapter.policy.named_parameters() if not p.requires_grad}
    for parameter in frozen.values():
        parameter.normal_()
    assert np.array_equal(np.stack([d.chunk for d in adapter.decide(asked, 0)]), before)
    assert {k.split("with_expert.")[1] for k in frozen} == {
        "paligemma.lm_head.weight",
        "gemma_expert.lm_head.weight",
        f"{LANGUAGE_MODEL}.norm.weight",
        f"{LANGUAGE_MODEL}.layers.1.self_attn.q_proj.weight",
        f"{LANGUAGE_MODEL}.layers.1.self_attn.o_proj.weight",
        f"{LANGUAGE_MODEL}.layers.1.mlp.gate_proj.weight",
        f"{LANGUAGE_MODEL}.layers.1.mlp.up_proj.weight",
        f"{LANGUAGE_MODEL}.layers.1.mlp.down_proj.weight",
        f"{LANGUAGE_MODEL}.layers.1.post_attention_layernorm.weight",
    }


@pytest.mark.parametrize("config", [c for c in SAMPLERS if c.padded == "joint"], ids=name)
def test_log_prob_s_gradient_against_finite_differences(adapter: LeRobotAdapter, config: FlowSamplerConfig):
    adapter, asked = exploring(adapter, config), requests(8)
    decisions = adapter.decide(asked, 0)
    perturb(adapter, 0.05)
    parts = ("vision_tower", LANGUAGE_MODEL, "gemma_expert", "action_out_proj")
    check_gradient(adapter, asked, decisions, parts, step=0.02)


class Ensemble:
    """One observation, decided `count` times by a policy in its current weights."""

    def __init__(self, adapter: LeRobotAdapter, count: int) -> None:
        self.adapter, self.count = adapter, count
        observations, tasks = stack_observations(requests(1))
        batch = adapter.processing.prepare(observations, tasks)
        self.batch = {
            k: v.expand(count, *v.shape[1:]) if isinstance(v, Tensor) else v for k, v in batch.items()
        }

    @torch.no_grad()
    def act(self, seed: int) -> tuple[Tensor, dict[str, Tensor], Tensor]:
        """(payoff of the executed actions (count,), latent, log-prob (count,))."""
        asked = [Request(observation={}, noise_seed=seed + i) for i in range(self.count)]
        action = self.adapter.family.act(self.adapter.model.encode(self.batch), asked)
        executed = self.adapter.processing.unnormalise(action.chunk)
        a, b = executed[:, 0, 0], executed[:, -1, 1]
        return torch.tanh(2 * a + 0.5) + torch.tanh(b + 0.3 * a * b), action.latent, action.log_prob.sum(1)

    @torch.no_grad()
    def score(self, latent: dict[str, Tensor]) -> Tensor:
        return self.adapter.family.score(self.adapter.model.encode(self.batch), latent).log_prob.sum(1)


def deviation(one: Tensor, other: Tensor) -> float:
    """Difference of two means in units of its standard error."""
    error = math.sqrt(one.var().item() / len(one) + other.var().item() / len(other))
    return abs(one.mean().item() - other.mean().item()) / error


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "config",
    [
        FlowSamplerConfig(stochastic="last", noise="euler", noise_level=0.5),
        FlowSamplerConfig(stochastic="all", noise="flow_sde", noise_level=0.8),
    ],
    ids=name,
)
def test_weighted_samples_of_mu_are_samples_of_pi(tmp_path: Path, kind: str, config: FlowSamplerConfig):
    path = write_pi(tmp_path / kind, kind, chunk=2, executed=1, padded_dim=3, num_steps=2, prompt=28)
    ensemble = Ensemble(adapter_at(path, config), 2000)
    old, latent, behaviour = ensemble.act(0)
    perturb(ensemble.adapter, 0.02)
    with torch.no_grad():  # padded dims drift as well, and feed back
        ensemble.adapter.policy.model.action_out_proj.bias += torch.tensor([-0.25, -0.25, 0.4])
    ratio = (ensemble.score(latent) - behaviour).exp()
    new, _, _ = ensemble.act(10_000)
    assert deviation(old, new) > 6, "the weights must matter, or the test shows nothing"
    assert deviation(ratio, torch.ones(2)) < 4
    assert deviation(ratio * old, new) < 4
