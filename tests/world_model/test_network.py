# SPDX-License-Identifier: Apache-2.0
"""The network and its objectives, against slow arithmetic and diffusers."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.world_model.config import NetworkConfig
from accerl_lerobot.world_model.model.network import (
    PREDICT,
    Attention,
    Denoiser,
    denoise,
    edm_levels,
    edm_loss,
    edm_sample,
    flow_loss,
    flow_sample,
    precondition,
    refiner_loss,
    refiner_sample,
)
from tests.rounding import assert_close

SMALL = NetworkConfig(channels=(8, 12), condition=16, planes=4)


def network(config: NetworkConfig = SMALL, state: int = 3) -> Denoiser:
    torch.manual_seed(0)
    return Denoiser(image=3, frames=6, action=8, state=state, config=config)


def inputs(seed: int = 0, size: int = 16, state: int = 3) -> dict[str, Tensor]:
    g = torch.Generator().manual_seed(seed)
    return {
        "x": torch.randn(2, 3, size, size, generator=g),
        "label": torch.randn(2, generator=g),
        "frames": torch.randn(2, 6, size, size, generator=g),
        "chunk": torch.randn(2, 8, generator=g),
        "state": torch.randn(2, state, generator=g),
    }


def awake(made: Denoiser) -> Denoiser:
    """Without the zeros it starts with."""
    with torch.no_grad():
        for p in made.parameters():
            if not p.any():
                p.normal_(std=0.2)
    return made


def test_it_starts_at_nothing_and_can_leave_it():
    made = network()
    image = made(**inputs())
    assert image.shape == (2, 3, 16, 16) and not image.any()
    (image - 1).square().sum().backward()
    assert made.leave[-1].bias.grad.abs().max() > 0


def test_all_parameters_learn():
    made = awake(network())
    made(**inputs()).square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().max() > 0 for p in made.parameters())


@pytest.mark.parametrize("what", ["x", "label", "frames", "chunk", "state"])
def test_everything_it_is_told_matters(what: str):
    made, one = awake(network()), inputs()
    other = one | {what: inputs(seed=1)[what]}
    with torch.no_grad():
        assert (made(**one) - made(**other)).abs().max() > 1e-3


def test_rows_of_a_batch_do_not_meet():
    made, one = awake(network()), inputs()
    with torch.no_grad():
        together = made(**one)
        alone = made(**{k: v[1:] for k, v in one.items()})
    assert_close(alone, together[1:])


@pytest.mark.parametrize(
    "config",
    [
        NetworkConfig(space_to_depth=2, channels=(8, 8, 12), blocks=2, condition=16, planes=0),
        NetworkConfig(space_to_depth=1, channels=(7,), condition=16),
        NetworkConfig(channels=(10, 14), condition=16),
    ],
    ids=["deep", "flat", "odd widths"],
)
def test_other_sizes(config: NetworkConfig):
    side = 2 * config.multiple
    image = awake(network(config))(**inputs(size=side))
    assert image.shape == (2, 3, side, side) and torch.isfinite(image).all()


def test_attention_is_softmax_attention():
    torch.manual_seed(0)
    layer = Attention(6)
    torch.nn.init.normal_(layer.out.weight, std=0.3)
    x = torch.randn(2, 6, 3, 2)
    with torch.no_grad():
        got = layer(x)
        h = layer.into(layer.norm(x)).flatten(2)
        for b in range(2):
            q, k, v = h[b].view(3, 6, 6)
            mixed = v @ torch.softmax(q.T @ k / 6**0.5, -1).T
            want = x[b] + layer.out(mixed.view(1, 6, 3, 2))[0]
            assert_close(got[b], want)


SIGMA_DATA = 0.5


def images(count: int = 3, seed: int = 0) -> Tensor:
    return torch.randn(count, 2, 4, 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def curved(x: Tensor, label: Tensor) -> Tensor:
    """Some network: not linear, and its label matters."""
    return torch.tanh(1.3 * x - 0.2) * (1 + 0.5 * label[:, None, None, None]) + 0.1 * x.flip(-1)


def test_preconditioning_by_hand():
    at = precondition(torch.tensor([0.5, 2.0], dtype=torch.float64), SIGMA_DATA)
    assert at.skip.flatten().tolist() == pytest.approx([0.5, 0.25 / 4.25])
    assert at.out.flatten().tolist() == pytest.approx([0.25 / math.sqrt(0.5), 1.0 / math.sqrt(4.25)])
    assert at.into.flatten().tolist() == pytest.approx([1 / math.sqrt(0.5), 1 / math.sqrt(4.25)])
    assert at.label.tolist() == pytest.approx([math.log(0.5) / 4, math.log(2) / 4])


def test_edm_loss_is_the_weighted_error_of_the_denoiser():
    """λ(σ) = 1/c_out²; image by image, entry by entry."""
    clean, noise, sigma = images(), images(seed=1), torch.tensor([0.1, 0.7, 3.0], dtype=torch.float64)
    loss = edm_loss(curved, clean, noise, sigma, SIGMA_DATA)
    for b in range(3):
        s = float(sigma[b])
        estimate = denoise(curved, clean[b : b + 1] + s * noise[b : b + 1], sigma[b : b + 1], SIGMA_DATA)
        weight = (s**2 + SIGMA_DATA**2) / (s * SIGMA_DATA) ** 2
        errors = (estimate[0] - clean[b]).numpy() ** 2
        assert float(loss[b]) == pytest.approx(weight * errors.mean(), rel=1e-9)


@pytest.mark.parametrize("steps", [1, 2, 3, 7])
def test_the_sampler_is_diffusers_edm_euler(steps: int):
    from diffusers import EDMEulerScheduler

    scheduler = EDMEulerScheduler(sigma_min=0.002, sigma_max=5.0, sigma_data=SIGMA_DATA, rho=7.0)
    scheduler.set_timesteps(steps)
    levels = edm_levels(steps, 0.002, 5.0)
    assert np.allclose(levels, scheduler.sigmas.tolist(), rtol=1e-4)
    noise = images().float()
    x = noise * levels[0]
    for t in scheduler.timesteps:
        output = curved(scheduler.scale_model_input(x, t), t.expand(len(x)).float())
        x = scheduler.step(output, t, x).prev_sample
    ours = edm_sample(curved, noise, levels, SIGMA_DATA)
    assert (ours - x).abs().max() < 2e-5 and x.std() > 0.1


def test_the_sampler_finds_a_gaussian():
    """For images from N(m, s²) the best denoiser is known; its samples have their mean and std."""
    mean, std = 0.4, 0.3

    def best(x: Tensor, label: Tensor) -> Tensor:
        sigma = (4 * label).exp()
        at = precondition(sigma, SIGMA_DATA)
        noisy = x / at.into
        wide = sigma[:, None, None, None].square()
        clean = (std**2 * noisy + wide * mean) / (std**2 + wide)
        return (clean - at.skip * noisy) / at.out

    noise = torch.randn(4000, 1, 1, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    sampled = edm_sample(best, noise, edm_levels(200, 0.002, 80.0), SIGMA_DATA)
    assert float(sampled.mean()) == pytest.approx(mean, abs=0.02)
    assert float(sampled.std()) == pytest.approx(std, rel=0.05)


def test_one_edm_step_is_the_estimate_itself():
    noise = images()
    at_once = edm_sample(curved, noise, edm_levels(1, 0.002, 5.0), SIGMA_DATA)
    sigma = torch.full((3,), 5.0, dtype=torch.float64)
    assert torch.equal(at_once, denoise(curved, 5.0 * noise, sigma, SIGMA_DATA))


def test_flow_loss_by_hand():
    clean, noise = images(), images(seed=1)
    t = torch.tensor([0.0, 0.25, 1.0], dtype=torch.float64)
    loss = flow_loss(curved, clean, noise, t)
    for b, when in enumerate((0.0, 0.25, 1.0)):
        x = (1 - when) * clean[b : b + 1] + when * noise[b : b + 1]
        error = curved(x, t[b : b + 1]) - (noise[b] - clean[b])
        assert float(loss[b]) == pytest.approx(float((error**2).mean()), rel=1e-12)


@pytest.mark.parametrize("steps", [1, 4])
def test_flow_of_a_straight_line_arrives_in_any_number_of_steps(steps: int):
    clean, noise = images(), images(seed=1)
    sampled = flow_sample(lambda x, t: noise - clean, noise, steps)
    assert torch.allclose(sampled, clean, atol=1e-12)


def test_the_refiner_predicts_and_refines_in_one_pass():
    clean, noise = images(4), images(4, seed=1)
    sigma = torch.tensor([0.1, 0.2, 0.3, 0.4], dtype=torch.float64)
    predict = torch.tensor([True, False, True, False])
    passes: list[tuple[Tensor, Tensor]] = []

    def network(x: Tensor, label: Tensor) -> Tensor:
        passes.append((x, label))
        return curved(x, label)

    loss = refiner_loss(network, clean, noise, sigma, predict, SIGMA_DATA)
    ((given, label),) = passes
    assert not given[predict].any() and given[~predict].abs().min() > 0
    assert label[predict].tolist() == [PREDICT] * 2 and label.max() == PREDICT
    regression = (
        (curved(torch.zeros_like(clean), torch.ones(4)) - clean / SIGMA_DATA).square().mean((1, 2, 3))
    )
    diffusion = edm_loss(curved, clean, noise, sigma, SIGMA_DATA)
    assert torch.allclose(loss, torch.where(predict, regression, diffusion))


def test_refining_starts_from_the_prediction():
    noise = images(6).view(3, 2, 2, 4, 4)
    predicted = SIGMA_DATA * curved(torch.zeros(3, 2, 4, 4), torch.full((3,), PREDICT)).double()
    assert torch.allclose(refiner_sample(curved, noise[:, :0], [], SIGMA_DATA), predicted)
    x = predicted
    for i, level in enumerate((0.2, 0.05)):
        x = denoise(curved, x + level * noise[:, i], torch.full((3,), level), SIGMA_DATA)
    assert torch.allclose(refiner_sample(curved, noise, [0.2, 0.05], SIGMA_DATA), x)


def test_a_network_that_says_nothing_makes_no_change():
    """A network that starts at zero, as ours does, starts as "the frame stays": the refiner's image is the
    change."""
    silent = lambda x, label: torch.zeros_like(x)  # noqa: E731
    assert not refiner_sample(silent, images(3)[:, None][:, :0], [], SIGMA_DATA).any()
