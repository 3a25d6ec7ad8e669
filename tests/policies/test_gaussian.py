# SPDX-License-Identifier: Apache-2.0
"""The Gaussian likelihood on a policy small enough to know its expectations, and ACT beside the contract."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Request
from accerl_lerobot.policies.config import GaussianSamplerConfig, TuningConfig
from accerl_lerobot.policies.family import Encoded
from accerl_lerobot.policies.gaussian import GaussianContext, GaussianFamily, GaussianModel
from tests.policies.checkpoints import edit_config, write_act
from tests.policies.tiny import adapter_at, deviation, requests

SAMPLES = 40_000
EXACT, WRONG = 4.0, 10.0
"""Monte-Carlo errors: agreement is below the first, a detected mistake above the second."""


class Small(GaussianModel):
    """Three rows of two dims, of which two rows are executed."""

    executed, action_dim, width, row_width = 2, 2, 4, 4

    def encode(self, batch: dict[str, Tensor]) -> Encoded:
        raise NotImplementedError

    def under(self, weights: float, count: int) -> Encoded:
        """Mean and rows as a function of the policy's weights, here one number."""
        mean = torch.linspace(-0.5, 0.8, 6).view(1, 3, 2) + 0.3 * weights
        rows = torch.sin(torch.arange(12.0) + weights).view(1, 3, 4)
        context = GaussianContext(mean=mean.expand(count, -1, -1), rows=rows.expand(count, -1, -1))
        return Encoded(features=torch.zeros(count, 1, 4), mask=torch.ones(count, 1).bool(), context=context)


def asked(count: int, explore: bool = True, seed: int = 0) -> list[Request]:
    return [Request(observation={}, noise_seed=1_000_000 * seed + i, explore=explore) for i in range(count)]


def family() -> GaussianFamily:
    made = GaussianFamily(Small(), GaussianSamplerConfig(std=0.4))
    with torch.no_grad():
        made.std.out.weight.copy_(torch.linspace(-1, 1, 8).view(2, 4))
    return made


def payoff(chunk: Tensor) -> Tensor:
    """Depends on every executed entry, and on two of them together."""
    return torch.tanh(2 * chunk[:, 0, 0] + chunk[:, 1, 1]) + 0.5 * chunk[:, 0, 1] ** 2 + 0.6 * chunk[:, 1, 0]


def test_weighted_samples_of_mu_are_samples_of_pi():
    it, (mu, pi) = family(), (0.0, 1.0)
    with torch.no_grad():
        acted = it.act(it.model.under(mu, SAMPLES), asked(SAMPLES))
        score = it.score(it.model.under(pi, SAMPLES), acted.latent)
        new = payoff(it.act(it.model.under(pi, SAMPLES), asked(SAMPLES, seed=1)).chunk)
        old = payoff(it.act(it.model.under(mu, SAMPLES), asked(SAMPLES, seed=2)).chunk)
    ratio = (score.log_prob - acted.log_prob).sum(1).exp()
    product = ratio * payoff(acted.chunk)
    assert deviation(old, new) > WRONG, "the weights must matter, or the test shows nothing"
    assert deviation(ratio, torch.ones(2)) < EXACT
    assert deviation(product, new) < EXACT
    partial = (score.log_prob - acted.log_prob)[:, :1].sum(1).exp() * payoff(acted.chunk)
    assert deviation(partial, new) > WRONG, "an executed row left out of the density is noticed"


def test_entropy_is_the_mean_surprise_of_what_is_sampled():
    it = family()
    with torch.no_grad():
        encoded = it.model.under(0.0, SAMPLES)
        acted = it.act(encoded, asked(SAMPLES))
        entropy = it.score(encoded, acted.latent).entropy
    assert entropy.shape == (SAMPLES,) and entropy.std() < 1e-4
    assert deviation(-acted.log_prob.sum(1), entropy) < EXACT


def test_evaluation():
    it = family()
    encoded = it.model.under(0.0, 4)
    still, moving = it.act(encoded, asked(4, explore=False)), it.act(encoded, asked(4))
    assert not still.log_prob.any() and still.chunk.shape == (4, 2, 2)
    assert torch.equal(still.chunk, encoded.context.mean[:, :2])
    assert not torch.equal(moving.chunk, encoded.context.mean[:, :2])


def test_the_learned_std_does_not_shape_the_features():
    it = family()
    encoded = it.model.under(0.0, 4)
    encoded.context.rows.requires_grad_()
    it.score(encoded, it.act(encoded, asked(4)).latent).log_prob.sum().backward()
    assert encoded.context.rows.grad is None and it.std.out.weight.grad.abs().max() > 0


# ---- ACT


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
