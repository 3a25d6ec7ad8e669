# SPDX-License-Identifier: Apache-2.0
"""π0, π0.5 and π0-FAST beside the contract: caches, layouts, decoding, precision."""

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.experience import stack_observations
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.config import FlowSamplerConfig, PolicyConfig, TokenSamplerConfig
from accerl_lerobot.policies.flow import FlowFamily
from accerl_lerobot.testing import check_ratio_one, check_saved, perturb, stored
from tests.policies.cases import CASES
from tests.policies.tiny import adapter_at, requests
from tests.policies.tiny_pi import CHARACTERS, KINDS, LOWEST, SCALE, SKIP, VOCABULARY, write_pi
from tests.rounding import assert_close

LENGTH = 10
FIRST = VOCABULARY - 1 - SKIP  # token of FAST's token 0; the others lie below it


@pytest.fixture(params=KINDS)
def adapter(request: pytest.FixtureRequest, written: Callable[[str], Path]) -> LeRobotAdapter:
    return adapter_at(written(request.param))


def test_the_first_decision_of_a_process_is_lerobot_s_too(adapter: LeRobotAdapter):
    # LeRobot switches PaliGemma to eager attention when it first samples, which is not the default's result.
    config = adapter.policy.model.paligemma_with_expert.paligemma.model.language_model.config
    config._attn_implementation = "sdpa"
    model = type(adapter.model)(adapter.policy)
    assert config._attn_implementation == "eager"
    batch = adapter.processing.prepare(*stack_observations(requests(3)))
    with torch.no_grad():
        family = FlowFamily(model, FlowSamplerConfig())
        assert family.difference(batch, model.encode(batch)) == 0.0


def test_what_no_action_depends_on_is_not_trained(adapter: LeRobotAdapter):
    asked = requests(4)
    before = pickle.dumps(adapter.decide(asked, 0))
    frozen = {k: p for k, p in adapter.policy.named_parameters() if not p.requires_grad}
    for parameter in frozen.values():
        parameter.normal_()
    assert pickle.dumps(adapter.decide(asked, 0)) == before
    assert any("language_model.layers.1.mlp.up_proj" in name for name in frozen)


@pytest.mark.parametrize("kind", KINDS)
def test_a_bfloat16_checkpoint_acts_and_is_saved_in_float32(kind: str, tmp_path: Path):
    adapter = adapter_at(write_pi(tmp_path / "origin", kind, dtype="bfloat16", padded_dim=4))
    assert {p.dtype for p in adapter.policy.parameters()} == {torch.float32}
    perturb(adapter, 0.1)
    config = PolicyConfig(path=str(tmp_path / "origin"), device="cpu")
    again = check_saved(adapter, requests(16), config, tmp_path / "saved")
    assert again.policy.config.dtype == "float32"


@pytest.mark.parametrize("kind", KINDS)
def test_relative_actions_are_added_to_their_own_state(kind: str, tmp_path: Path):
    absolute = adapter_at(write_pi(tmp_path / "absolute", kind))
    relative = adapter_at(write_pi(tmp_path / "relative", kind, use_relative_actions=True))
    asked = requests(5)
    states = np.stack([r.observation["observation.state"] for r in asked])
    chunks = [np.stack([d.chunk for d in a.decide(asked, 0)]) for a in (absolute, relative)]
    assert_close(chunks[1], chunks[0] + states[:, None, :2])
    check_ratio_one(relative, asked, relative.decide(asked, 0))


@pytest.fixture
def fast(written: Callable[[str], Path]) -> LeRobotAdapter:
    """Ends about every tenth time it could."""
    adapter = adapter_at(written("pi0_fast"))
    CASES["pi0_fast"].prepare(adapter)
    return adapter


@pytest.mark.parametrize("sampler", ["sample_actions_fast_kv_cache", "sample_actions_fast"])
@pytest.mark.parametrize("temperature", [1.0, 0.6])
def test_lerobot_s_probabilities_are_ours(fast: Any, monkeypatch: Any, temperature: float, sampler: str):
    # It is made to draw our tokens, and the probabilities that it would have drawn from are read off.
    asked = requests(16)
    fast.family.sampler = TokenSamplerConfig(temperature=temperature)
    latent, log_prob = stored(fast.decide(asked, 0))
    tokens, seen = latent["tokens"], []

    def dictated(probabilities: Tensor, num_samples: int) -> Tensor:
        position = len(seen)
        seen.append(probabilities.gather(1, tokens[:, position : position + 1])[:, 0])
        return tokens[:, position : position + 1]

    monkeypatch.setattr(torch, "multinomial", dictated)
    policy, batch = fast.policy, fast.processing.prepare(*stack_observations(asked))
    drawn = getattr(policy.model, sampler)(
        *policy._preprocess_images(batch),
        batch["observation.language.tokens"],
        batch["observation.language.attention_mask"],
        max_decoding_steps=LENGTH,
        temperature=temperature,
    )
    assert torch.equal(drawn, tokens)
    counted = log_prob != 0
    assert_close(torch.stack(seen, 1).log()[counted], log_prob[counted])
    assert counted.any(0).all() and not counted.all()


def test_decoding_is_lerobot_s_and_never_fails(fast: LeRobotAdapter, caplog: pytest.LogCaptureFixture):
    end, half, zeros = fast.model.terminator, FIRST - CHARACTERS, FIRST - CHARACTERS - 1
    zero = FIRST + LOWEST

    def decoded(*tokens: int) -> Tensor:
        return fast.model.chunk(torch.tensor([[*tokens, *[end] * (LENGTH - len(tokens))]]))[0]

    one = decoded(zero - 8)
    first = 8 / SCALE / 2  # the constant of an orthonormal transform of four rows
    assert_close(one, torch.tensor([[first, 0.0]]).expand(4, -1))
    assert torch.equal(decoded(zero + 8), -one), "a sign"
    assert torch.equal(decoded(97, zero - 8, 98), one), "text between"
    for nothing in ([], [zeros] * 4, range(97, 97 + LENGTH), [VOCABULARY - 1]):
        assert not decoded(*nothing).any(), f"{nothing}: pairs, only text, or not FAST's"
    too_long = decoded(*[zero - 1] * LENGTH)
    assert too_long.any() and torch.isfinite(too_long).all()
    assert decoded(half).abs().max() > 1000, "LeRobot takes U+FFFD for a coefficient"
    assert caplog.messages == []
