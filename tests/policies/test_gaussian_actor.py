# SPDX-License-Identifier: Apache-2.0
"""gaussian_actor, in numbers, and what about LeRobot's own would have led astray."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from accerl_lerobot.engine.local import LocalEngine
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Request
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.base import stack_observations
from accerl_lerobot.policies.config import PolicyConfig, TuningConfig
from accerl_lerobot.policies.loading import load_adapter, save_pretrained
from accerl_lerobot.policies.samplers import GaussianSamplerConfig
from accerl_lerobot.trainer.config import TrainerConfig
from tests.policies.checkpoints import write_gaussian_actor
from tests.policies.contract import PolicyContract
from tests.policies.tiny import adapter_at, check_ratio_one, log_ratio, perturb, requests, stored
from tests.rounding import assert_close
from tests.runs import drive
from tests.test_local import learning_run, success, updates


class TestContract(PolicyContract):
    samplers = [GaussianSamplerConfig(), GaussianSamplerConfig(at_rest="mean")]
    parts = ("state_encoder", "actor.network", "mean_layer", "std_layer")
    shape = (1, 2)
    one_token = True

    @staticmethod
    def write(directory: Path) -> Path:
        return write_gaussian_actor(directory)


class TestContractWithImages(PolicyContract):
    """Encoders of its own for the critic, which nothing here reads, and one for images."""

    samplers = [GaussianSamplerConfig()]
    parts = ("encoder_actor.image_encoder", "encoder_actor.post_encoders", "encoder_actor.state_encoder")
    shape = (1, 2)
    image = 64
    one_token = True

    @staticmethod
    def write(directory: Path) -> Path:
        return write_gaussian_actor(
            directory, image=64, freeze_vision_encoder=False, shared_encoder=False, image_encoder_hidden_dim=8
        )


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_gaussian_actor(tmp_path_factory.mktemp("actor") / "pretrained_model")


@pytest.fixture
def adapter(path: Path) -> LeRobotAdapter:
    return adapter_at(path)


@contextlib.contextmanager
def lerobot_draws(asked: list[Request]) -> Iterator[None]:
    """Inside, LeRobot's sampler gets the noise of these requests instead of random numbers."""
    drawn = [np.random.default_rng(r.noise_seed).standard_normal((1, 2), dtype=np.float32)[0] for r in asked]
    eps = torch.from_numpy(np.stack(drawn))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            "torch.distributions.multivariate_normal._standard_normal", lambda shape, dtype, device: eps
        )
        yield


def test_not_exploring_is_lerobot_s_sampler(path: Path, adapter: LeRobotAdapter):
    asked = requests(6, explore=False)
    batch = adapter.processing.prepare(*stack_observations(asked))
    with lerobot_draws(asked):
        stock = adapter.processing.unnormalise(adapter.policy.select_action(batch)).numpy()
    chunks = np.stack([d.chunk[0] for d in adapter.decide(asked, 0)])
    assert_close(chunks, stock)  # LeRobot takes the square root by a Cholesky decomposition
    resting = adapter_at(path, GaussianSamplerConfig(at_rest="mean"))
    mean = np.tanh(adapter.policy(batch)["action_mean"].detach().numpy()) * 2  # the world's actions are ±2
    assert_close(np.stack([d.chunk[0] for d in resting.decide(asked, 0)]), mean)
    assert np.abs(mean - stock).max() > 0.1, "so the mean is another policy than LeRobot's"


def test_log_prob_is_lerobot_s_where_that_is_finite(adapter: LeRobotAdapter):
    asked = requests(6)
    decisions = adapter.decide(asked, 0)
    batch = adapter.processing.prepare(*stack_observations(asked))
    with lerobot_draws(asked):
        stock = adapter.policy(batch)["log_prob"].detach().numpy()
    assert np.allclose([d.log_prob.sum() for d in decisions], stock, atol=1e-4)


def test_saturated_actions_are_re_scored(adapter: LeRobotAdapter):
    """LeRobot's own density of the action it returned is not even finite there."""
    from lerobot.policies.gaussian_actor.modeling_gaussian_actor import TanhMultivariateNormalDiag

    with torch.no_grad():
        adapter.policy.actor.mean_layer.bias.copy_(torch.tensor([20.0, -40.0]))
    asked = requests(16)
    decisions = adapter.decide(asked, 0)
    assert all(np.array_equal(d.chunk, [[2.0, -2.0]]) for d in decisions), "every bit of the noise is gone"
    check_ratio_one(adapter, asked, decisions)
    assert np.isfinite([d.log_prob for d in decisions]).all()
    latent, old = stored(decisions)
    mean = torch.tensor([20.0, -40.0]).expand(16, 2)
    stock = TanhMultivariateNormalDiag(loc=mean, scale_diag=torch.ones(16, 2))
    assert not torch.isfinite(stock.log_prob(torch.tanh(latent["u"][:, 0]))).any()
    with torch.no_grad():
        adapter.policy.actor.mean_layer.bias += 0.3
    latent["u"] = latent["u"].double().float()
    change = log_ratio(adapter, asked, decisions)
    assert torch.isfinite(change).all() and change.abs().max() > 0.05
    evaluation = adapter.evaluate(*stack_observations(asked), latent)
    evaluation.log_prob.sum().backward()
    assert torch.isfinite(adapter.policy.actor.mean_layer.bias.grad).all()


def test_neither_chunks_nor_scores_come_from_lerobot(adapter: LeRobotAdapter):
    batch = adapter.processing.prepare(*stack_observations(requests(2)))
    with pytest.raises(NotImplementedError):
        adapter.policy.predict_action_chunk(batch)
    one, other = adapter.policy(batch)["action"], adapter.policy(batch)["action"]
    assert not torch.equal(one, other), "its forward samples anew and cannot score a given action"
    decision = adapter.decide(requests(1), 0)[0]
    assert decision.chunk.shape == (1, 2) and decision.latent["u"].shape == (1, 2)


def slow(policy: torch.nn.Module, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and std by hand, in float64."""
    weights = {k: v.double().numpy() for k, v in policy.state_dict().items()}

    def linear(name: str, x: np.ndarray) -> np.ndarray:
        return weights[f"{name}.weight"] @ x + weights[f"{name}.bias"]

    def norm(name: str, x: np.ndarray) -> np.ndarray:
        x = (x - x.mean()) / math.sqrt(x.var() + 1e-5)
        return x * weights[f"{name}.weight"] + weights[f"{name}.bias"]

    x = np.tanh(norm("actor.encoder.state_encoder.1", linear("actor.encoder.state_encoder.0", state)))
    for i in (0, 3):
        x = norm(f"actor.network.net.{i + 1}", linear(f"actor.network.net.{i}", x))
        x = x / (1 + np.exp(-x))
    variance = np.clip(np.exp(linear("actor.std_layer", x)), 1e-5, 10.0)
    return linear("actor.mean_layer", x), np.sqrt(variance)


def test_other_weights_give_the_ratio_of_a_slow_computation(adapter: LeRobotAdapter):
    asked = requests(8)
    decisions = adapter.decide(asked, 0)
    perturb(adapter, 0.3)
    expected = []
    for request, decision in zip(asked, decisions, strict=True):
        # The checkpoint's states are within ±2.
        mean, std = slow(adapter.policy, request.observation["observation.state"].astype(np.float64) / 2)
        u = decision.latent["u"][0].astype(np.float64)
        density = -0.5 * ((u - mean) / std) ** 2 - np.log(std * math.sqrt(2 * math.pi))
        new = (density - np.log(1 - np.tanh(u) ** 2)).sum()
        expected.append(new - decision.log_prob.astype(np.float64).sum())
    change = log_ratio(adapter, asked, decisions).numpy()
    assert_close(change, expected, rel=1e-3)
    assert np.abs(change).max() > 0.1, "the weights must have moved the policy"


def test_a_saved_checkpoint_is_stock_lerobot_s(adapter: LeRobotAdapter, path: Path, tmp_path: Path):
    from lerobot.policies.factory import make_pre_post_processors
    from lerobot.policies.gaussian_actor.modeling_gaussian_actor import GaussianActorPolicy

    perturb(adapter, 0.3)
    save_pretrained(adapter, tmp_path / "saved", PolicyConfig(path=str(path), device="cpu"))
    stock = GaussianActorPolicy.from_pretrained(tmp_path / "saved")
    pre, post = make_pre_post_processors(stock.config, pretrained_path=str(tmp_path / "saved"))
    asked = requests(6, explore=False)
    states = np.stack([r.observation["observation.state"] for r in asked])
    with lerobot_draws(asked):
        action = post(stock.select_action(pre({"observation.state": torch.from_numpy(states)}))).numpy()
    assert_close(np.stack([d.chunk[0] for d in adapter.decide(asked, 0)]), action)


def test_a_repaired_lerobot_is_noticed(path: Path, monkeypatch: pytest.MonkeyPatch):
    """If what it clamps became the std that it is called, our log-probs would be another policy's."""
    from lerobot.policies.gaussian_actor import modeling_gaussian_actor as module

    stock = module.TanhMultivariateNormalDiag
    monkeypatch.setattr(
        module, "TanhMultivariateNormalDiag", lambda loc, scale_diag: stock(loc, scale_diag.square())
    )
    with pytest.raises(InputError, match="differs from its sampler"):
        adapter_at(path)


def test_every_action_is_squashed_whatever_the_config_says(tmp_path: Path):
    from lerobot.policies.gaussian_actor.configuration_gaussian_actor import PolicyConfig as Head

    path = write_gaussian_actor(tmp_path / "policy", policy_kwargs=Head(use_tanh_squash=False))
    adapter = adapter_at(path)  # which compares it with LeRobot's sampler
    with torch.no_grad():
        adapter.policy.actor.mean_layer.bias.fill_(5.0)
    assert np.abs(adapter.decide(requests(8), 0)[0].chunk).max() <= 2.0


def test_a_discrete_gripper_is_refused(tmp_path: Path):
    path = write_gaussian_actor(tmp_path / "policy", num_discrete_actions=3)
    with pytest.raises(InputError, match="^policy.num_discrete_actions=3: .* has no density"):
        adapter_at(path)


def test_the_log_prob_reaches_a_shared_image_encoder(tmp_path: Path):
    path = write_gaussian_actor(tmp_path / "policy", image=64, freeze_vision_encoder=False)
    adapter = adapter_at(path)
    asked = requests(4, image=64)
    latent, _ = stored(adapter.decide(asked, 0))
    perturb(adapter, 0.1)
    adapter.evaluate(*stack_observations(asked), latent).log_prob.sum().backward()
    images = {k: p for k, p in adapter.trainable().items() if "image_encoder" in k}
    assert images and all(p.grad.abs().max() > 0 for p in images.values())


class TestTuning:
    def test_there_is_no_expert(self, path: Path):
        with pytest.raises(InputError, match="gaussian_actor has no action expert"):
            adapter_at(path, tuning=TuningConfig(mode="expert"))

    def test_full_trains_a_frozen_image_encoder_too_but_not_the_critic_s(self, tmp_path: Path):
        path = write_gaussian_actor(tmp_path / "policy", image=64, shared_encoder=False)
        left, full = (
            adapter_at(path, tuning=TuningConfig(mode=mode)).trainable() for mode in ("checkpoint", "full")
        )
        assert not any("image_enc_layers" in k for k in left) and any("image_enc_layers" in k for k in full)
        assert not any("encoder_critic" in k for k in left | full)

    def test_lora_on_an_encoder_that_the_policy_holds_under_three_names(self, path: Path, tmp_path: Path):
        tuning = TuningConfig(mode="lora", rank=2, targets=r".*state_encoder\.0|actor\.mean_layer")
        config = PolicyConfig(path=str(path), device="cpu", tuning=tuning)
        torch.manual_seed(0)  # of the adapters
        adapter, asked = load_adapter(config), requests(6, explore=False)
        before = np.stack([d.chunk for d in adapter.decide(asked, 0)])
        assert len([k for k in adapter.trainable() if ".lora_" in k]) == 4
        with torch.no_grad():
            for name, parameter in adapter.trainable().items():
                if ".lora_B" in name:
                    parameter += 0.2 * torch.randn(parameter.shape)
        after = np.stack([d.chunk for d in adapter.decide(asked, 0)])
        save_pretrained(adapter, tmp_path / "saved", config)
        again = adapter_at(tmp_path / "saved")
        assert_close(np.stack([d.chunk for d in again.decide(asked, 0)]), after)
        assert np.abs(after - before).max() > 1e-2


def test_a_random_policy_learns_the_task(path: Path):
    run = learning_run(
        path,
        env=SimulatedConfig(
            max_steps=8, tolerance=0.3, reward="dense", terminate_on_success=False, image_size=8
        ),
        policy=PolicyConfig(path=str(path), device="cpu"),
        trainer=TrainerConfig(
            updates=100, batch_decisions=128, lr=2e-3, value_lr=3e-3, warmup_updates=3, value_warmup_updates=5
        ),
    )
    engine = LocalEngine(run, ("match",))
    before = success(engine)
    engine.train()
    history = updates(drive(engine))
    after = success(engine)
    engine.close()
    assert after > max(0.8, before + 0.3), f"{before:.0%} → {after:.0%}"
    rewards = [u["reward_mean"] for u in history]
    assert np.mean(rewards[-10:]) > np.mean(rewards[:10]) + 0.2
