# SPDX-License-Identifier: Apache-2.0
"""ACT and gaussian_actor beside the contract, and what about LeRobot's own would have led astray."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Request
from accerl_lerobot.policies.adapter import LeRobotAdapter, stack_observations
from accerl_lerobot.policies.config import GaussianSamplerConfig, PolicyConfig, TuningConfig
from accerl_lerobot.policies.saving import save_pretrained
from accerl_lerobot.testing import check_ratio_one, log_ratio, perturb, stored
from tests.policies.checkpoints import edit_config, write_act, write_gaussian_actor
from tests.policies.tiny import adapter_at, requests
from tests.rounding import assert_close


@pytest.fixture(scope="module")
def act(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_act(tmp_path_factory.mktemp("act") / "pretrained_model")


def asks(count: int, **options: bool) -> list[Request]:
    return requests(count, image=16, **options)


def test_the_std_starts_where_it_is_configured_and_stays_within_bounds(act: Path):
    # The checkpoint's action std is 0.5, so that is the factor from normalised to executed.
    adapter = adapter_at(act, GaussianSamplerConfig(std=0.24))
    noisy = np.stack([d.chunk for d in adapter.decide(asks(200), 0)])
    stock = np.stack([d.chunk for d in adapter.decide(asks(200, explore=False), 0)])
    added = (noisy - stock) / 0.5
    assert abs(added.mean()) < 0.03 and added.std() == pytest.approx(0.24, rel=0.05)
    with torch.no_grad():
        adapter.family.std.out.bias.copy_(torch.tensor([50.0, -50.0]))
    added = (np.stack([d.chunk for d in adapter.decide(asks(200), 0)]) - stock) / 0.5
    assert added[..., 0].std() == pytest.approx(0.6, rel=0.06)
    assert added[..., 1].std() == pytest.approx(0.06, rel=0.06)


def test_dropout_is_off_and_batch_norm_frozen(act: Path):
    adapter = adapter_at(act)
    kinds = {type(m).__name__ for m in adapter.policy.modules()}
    assert "Dropout" in kinds and "FrozenBatchNorm2d" in kinds and "BatchNorm2d" not in kinds
    assert adapter.policy.config.dropout > 0 and not any(m.training for m in adapter.policy.modules())


def test_what_inference_does_not_run_is_not_trained(act: Path):
    for mode in ("checkpoint", "full"):
        names = adapter_at(act, tuning=TuningConfig(mode=mode)).trainable()
        assert not [k for k in names if "vae_encoder" in k or "encoder_latent_input_proj.weight" in k]
        assert "policy.model.encoder_latent_input_proj.bias" in names


def test_temporal_ensembling_is_refused(act: Path, tmp_path: Path):
    copied = Path(shutil.copytree(act, tmp_path / "policy"))
    edit_config(copied, temporal_ensemble_coeff=0.01, n_action_steps=1)
    with pytest.raises(InputError, match="^policy.temporal_ensemble_coeff=0.01: averaging over earlier"):
        adapter_at(copied)


def test_a_checkpoint_without_a_std_of_its_own_starts_one(act: Path, tmp_path: Path):
    config = GaussianSamplerConfig()
    adapter = adapter_at(act, config)
    saved = tmp_path / "saved"
    save_pretrained(adapter, saved, PolicyConfig(path=str(act), device="cpu", sampler=config))
    assert (saved / "family.safetensors").is_file()
    assert json.loads((saved / "accerl.json").read_text())["sampler"]["type"] == "gaussian"


# ---- gaussian_actor


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


@pytest.mark.parametrize("shared", [True, False])
def test_the_log_prob_reaches_the_image_encoder(tmp_path: Path, shared: bool):
    options = {"freeze_vision_encoder": False, "shared_encoder": shared, "image_encoder_hidden_dim": 8}
    path = write_gaussian_actor(tmp_path / "policy", image=64, **options)
    adapter = adapter_at(path)
    asked = requests(4, image=64)
    latent, _ = stored(adapter.decide(asked, 0))
    perturb(adapter, 0.1)
    adapter.evaluate(*stack_observations(asked), latent).log_prob.sum().backward()
    images = {k: p for k, p in adapter.trainable().items() if "image_encoder" in k}
    assert images and all(p.grad.abs().max() > 0 for p in images.values())


def test_full_trains_a_frozen_image_encoder_too_but_not_the_critic_s(tmp_path: Path):
    path = write_gaussian_actor(tmp_path / "policy", image=64, shared_encoder=False)
    left, full = (
        adapter_at(path, tuning=TuningConfig(mode=mode)).trainable() for mode in ("checkpoint", "full")
    )
    assert not any("image_enc_layers" in k for k in left) and any("image_enc_layers" in k for k in full)
    assert not any("encoder_critic" in k for k in left | full)
