# SPDX-License-Identifier: Apache-2.0
"""π0, π0.5 and π0-FAST beside the contract: caches, layouts, decoding, precision."""

import copy
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.experience import stack_observations
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.config import FlowSamplerConfig, TokenSamplerConfig
from accerl_lerobot.policies.flow import FlowFamily
from accerl_lerobot.testing import check_ratio_one, perturb, stored
from tests.policies.cases import CASES
from tests.policies.tiny import adapter_at, requests
from tests.policies.tiny_pi import CHARACTERS, KINDS, LOWEST, SCALE, SKIP, VOCABULARY, write_pi
from tests.rounding import assert_close

LANGUAGE_MODEL = "paligemma.model.language_model"
LENGTH = 10
FIRST = VOCABULARY - 1 - SKIP  # token of FAST's token 0; the others lie below it


@pytest.fixture(scope="module", params=KINDS)
def path(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return CASES[request.param].write(tmp_path_factory.mktemp(request.param) / "pretrained_model")


@pytest.fixture
def adapter(path: Path) -> LeRobotAdapter:
    return adapter_at(path)


def test_the_first_decision_of_a_process_is_lerobot_s_too(path: Path):
    # LeRobot switches PaliGemma to eager attention when it first samples, which is not the default's result.
    adapter, asked = adapter_at(path), requests(3, explore=False)
    config = adapter.policy.model.paligemma_with_expert.paligemma.model.language_model.config
    config._attn_implementation = "sdpa"
    model = type(adapter.model)(adapter.policy)
    assert config._attn_implementation == "eager"
    batch = adapter.processing.prepare(*stack_observations(asked))
    with torch.no_grad():
        family = FlowFamily(model, FlowSamplerConfig())
        assert family.difference(batch, model.encode(batch)) == 0.0


def test_what_no_action_depends_on_is_not_trained(adapter: LeRobotAdapter):
    asked = requests(4, explore=False)
    before = np.stack([d.chunk for d in adapter.decide(asked, 0)])
    frozen = {k: p for k, p in adapter.policy.named_parameters() if not p.requires_grad}
    for parameter in frozen.values():
        parameter.normal_()
    assert np.array_equal(np.stack([d.chunk for d in adapter.decide(asked, 0)]), before)
    assert f"model.paligemma_with_expert.{LANGUAGE_MODEL}.layers.1.mlp.up_proj.weight" in frozen


def test_a_bfloat16_checkpoint_acts_and_is_saved_in_float32(path: Path, tmp_path: Path):
    kind = adapter_at(path).policy.config.type
    origin = write_pi(tmp_path / "origin", kind, dtype="bfloat16", padded_dim=4)
    adapter, asked = adapter_at(origin), requests(16)
    assert {p.dtype for p in adapter.policy.parameters()} == {torch.float32}
    together = adapter.decide(asked, 0)
    alone = [adapter.decide([request], 0)[0] for request in asked]
    check_ratio_one(adapter, asked, alone)
    perturb(adapter, 0.1)
    adapter.save(tmp_path / "saved")
    again = adapter_at(tmp_path / "saved")
    assert again.policy.config.dtype == "float32"
    expected = adapter.decide(asked, 0)
    assert np.array_equal(again.decide(asked, 0)[0].chunk, expected[0].chunk), "not rounded to bfloat16"
    assert np.abs(expected[0].chunk - together[0].chunk).max() > 1e-3


def test_relative_actions_are_added_to_their_own_state(tmp_path: Path):
    for kind in KINDS:
        absolute = adapter_at(write_pi(tmp_path / f"{kind}-absolute", kind))
        relative = adapter_at(write_pi(tmp_path / f"{kind}-relative", kind, use_relative_actions=True))
        asked = requests(5)
        states = np.stack([r.observation["observation.state"] for r in asked])
        chunks = [np.stack([d.chunk for d in a.decide(asked, 0)]) for a in (absolute, relative)]
        assert_close(chunks[1], chunks[0] + states[:, None, :2])
        check_ratio_one(relative, asked, relative.decide(asked, 0))


@pytest.fixture(scope="module")
def loaded(tmp_path_factory: pytest.TempPathFactory) -> LeRobotAdapter:
    """Ends about every tenth time it could."""
    adapter = adapter_at(CASES["pi0_fast"].write(tmp_path_factory.mktemp("pi0_fast") / "pretrained_model"))
    CASES["pi0_fast"].prepare(adapter)
    return adapter


@pytest.fixture
def fast(loaded: LeRobotAdapter) -> LeRobotAdapter:
    """One of its own for each test."""
    return copy.deepcopy(loaded)


@pytest.mark.parametrize("sampler", ["sample_actions_fast_kv_cache", "sample_actions_fast"])
@pytest.mark.parametrize("temperature", [1.0, 0.6])
def test_lerobot_s_own_sampler_draws_from_the_same_probabilities(
    fast: LeRobotAdapter, monkeypatch: pytest.MonkeyPatch, temperature: float, sampler: str
):
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

    def padded(*tokens: int) -> list[int]:
        return [*tokens, *[end] * (LENGTH - len(tokens))]

    rows = {
        "one coefficient": padded(zero - 8),
        "a sign": padded(zero + 8),
        "pairs": padded(zeros, zeros, zeros, zeros),
        "text between": padded(97, zero - 8, 98),
        "nothing": padded(),
        "only text": list(range(97, 97 + LENGTH)),
        "too long": [zero - 1] * LENGTH,
        "not FAST's": padded(VOCABULARY - 1),
        "half a letter": padded(half),
    }
    chunks = fast.model.chunk(torch.tensor(list(rows.values())))
    assert caplog.messages == []
    by_name = dict(zip(rows, chunks, strict=True))
    first = 8 / SCALE / 2  # the constant of an orthonormal transform of four rows
    assert_close(by_name["one coefficient"], torch.tensor([[first, 0.0]]).expand(4, -1))
    assert torch.equal(by_name["a sign"], -by_name["one coefficient"])
    assert torch.equal(by_name["text between"], by_name["one coefficient"])
    for name in ("pairs", "nothing", "only text", "not FAST's"):
        assert not by_name[name].any(), name
    assert by_name["too long"].abs().max() > 0 and torch.isfinite(chunks).all()
    assert by_name["half a letter"].abs().max() > 1000, "LeRobot takes U+FFFD for a coefficient"
