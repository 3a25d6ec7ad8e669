# SPDX-License-Identifier: Apache-2.0
"""The network of the pixel model."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from accerl_lerobot.world_model.pixels import Attention, FrameNetwork
from tests.rounding import assert_close


def network(*channels: int) -> FrameNetwork:
    torch.manual_seed(0)
    return FrameNetwork(image=3, frames=6, action=8, state=3, channels=channels or (8, 12))


def inputs(seed: int = 0, size: int = 16) -> dict[str, Tensor]:
    g = torch.Generator().manual_seed(seed)
    return {
        "frames": torch.randn(2, 6, size, size, generator=g),
        "chunk": torch.randn(2, 8, generator=g),
        "state": torch.randn(2, 3, generator=g),
    }


def awake(made: FrameNetwork) -> FrameNetwork:
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


@pytest.mark.parametrize("what", ["frames", "chunk", "state"])
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


@pytest.mark.parametrize("channels", [(8, 8, 12), (7,), (10, 14)], ids=["deep", "flat", "odd widths"])
def test_other_sizes(channels: tuple[int, ...]):
    side = 8 * 2 ** (len(channels) - 1)
    image = awake(network(*channels))(**inputs(size=side))
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
