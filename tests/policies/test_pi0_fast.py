# SPDX-License-Identifier: Apache-2.0
"""π0-FAST, in numbers: tokens are scored in the layout in which they are sampled, LeRobot's own at rest."""

from __future__ import annotations

import copy
import logging
import math
import pickle
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Decision, Request
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.base import stack_observations
from accerl_lerobot.policies.models import pi0_fast
from accerl_lerobot.policies.samplers import TokenSamplerConfig
from accerl_lerobot.policies.tokens import TokenContext, TokenFamily
from tests.policies.tiny import (
    adapter_at,
    check_batches,
    check_journey,
    log_ratio,
    perturb,
    requests,
    stored,
)
from tests.policies.tiny_pi import CHARACTERS, LOWEST, SCALE, SKIP, VOCABULARY, small, write_pi
from tests.rounding import assert_close

LENGTH = 10
FIRST = VOCABULARY - 1 - SKIP
"""Token of FAST's token 0; the others lie below it."""


@pytest.fixture(scope="module", autouse=True)
def sizes() -> Iterator[None]:
    with small():
        yield


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pi(tmp_path_factory.mktemp("pi0_fast") / "pretrained_model", "pi0_fast", num_steps=LENGTH)


@pytest.fixture(scope="module")
def loaded(path: Path) -> LeRobotAdapter:
    """Ends about every tenth time it could."""
    adapter = adapter_at(path)
    lean(adapter, adapter.model.terminator, 4.0)
    return adapter


@pytest.fixture
def adapter(loaded: LeRobotAdapter) -> LeRobotAdapter:
    """One of its own for each test."""
    return copy.deepcopy(loaded)


def lean(adapter: LeRobotAdapter, token: int, logit: float) -> None:
    """Makes a token about that likely, whatever is observed and has been said."""
    states: list[Tensor] = []
    head = adapter.policy.model.paligemma_with_expert.paligemma.lm_head
    hook = head.register_forward_pre_hook(lambda module, given: states.append(given[0]))
    adapter.decide(requests(16), 0)
    hook.remove()
    mean = torch.cat([state.flatten(0, -2) for state in states]).mean(0)
    with torch.no_grad():
        head.weight[token] = logit * mean / mean.square().sum()


def at(adapter: LeRobotAdapter, temperature: float) -> LeRobotAdapter:
    """The same policy, exploring at another temperature."""
    family = TokenFamily(adapter.model, TokenSamplerConfig(temperature=temperature))
    return LeRobotAdapter(
        adapter.policy, adapter.processing, adapter.model, family, adapter.value_head, adapter.precision
    )


def said(decisions: Sequence[Decision]) -> Tensor:
    return stored(decisions)[0]["tokens"]


@pytest.mark.parametrize("temperature", [1.0, 0.6, 2.0])
def test_decisions_and_ratio_one_do_not_depend_on_the_batch(adapter: LeRobotAdapter, temperature: float):
    together = check_batches(at(adapter, temperature), requests(48), few=12)
    lengths = (said(together) != adapter.model.terminator).sum(1)
    assert lengths.min() < LENGTH / 2 and lengths.max() == LENGTH, "some end early, some never"


def slow_log_prob(
    adapter: LeRobotAdapter, request: Request, tokens: Tensor, temperature: float
) -> list[float]:
    """Token by token without a cache, the attention mask entry by entry, the softmax in double precision."""
    from lerobot.policies.common.vla_utils import prepare_attention_masks_4d

    policy = adapter.policy
    network = policy.model.paligemma_with_expert
    batch = adapter.processing.prepare(*stack_observations([request]))
    (image,), _ = policy._preprocess_images(batch)
    prompt = batch["observation.language.tokens"][0][batch["observation.language.attention_mask"][0]]
    bos = policy._paligemma_tokenizer.bos_token_id
    result = []
    for position, token in enumerate(tokens.tolist()):
        words = torch.tensor([[*prompt.tolist(), bos, *tokens[:position].tolist()]])
        parts = [network.embed_image(image), network.embed_language_tokens(words)]
        embedded = torch.cat(parts, 1)
        size, prefix = embedded.shape[1], embedded.shape[1] - position
        mask = torch.zeros(1, size, size, dtype=torch.bool)
        for query in range(size):
            for key in range(size):
                mask[0, query, key] = key < prefix or key <= query
        (hidden, _), _ = network.forward(
            attention_mask=prepare_attention_masks_4d(mask),
            position_ids=torch.arange(size)[None],
            inputs_embeds=[embedded, None],
            use_cache=False,
        )
        logits = network.paligemma.lm_head(hidden[0, -1]).double().numpy() / temperature
        result.append(float(logits[token] - np.log(np.exp(logits - logits.max()).sum()) - logits.max()))
        if token == adapter.model.terminator:
            break
    return result + [0.0] * (len(tokens) - len(result))


@pytest.mark.parametrize("temperature", [1.0, 0.6])
def test_other_weights_give_the_oracle_s_ratio(adapter: LeRobotAdapter, temperature: float):
    adapter, asked = at(adapter, temperature), requests(6)
    decisions = adapter.decide(asked, 0)
    latent, old = stored(decisions)
    perturb(adapter, 0.2)
    with torch.no_grad():
        new = adapter.evaluate(*stack_observations(asked), latent).log_prob
        slow = [
            slow_log_prob(adapter, r, t, temperature) for r, t in zip(asked, latent["tokens"], strict=True)
        ]
    assert_close(new, slow)
    assert (new - old).abs().sum(1).median() > 0.05, "the weights must have moved the policy"


@pytest.mark.parametrize("sampler", ["sample_actions_fast_kv_cache", "sample_actions_fast"])
@pytest.mark.parametrize("temperature", [1.0, 0.6])
def test_lerobot_s_own_sampler_draws_from_the_same_probabilities(
    adapter: LeRobotAdapter, monkeypatch: pytest.MonkeyPatch, temperature: float, sampler: str
):
    # It is made to draw our tokens, and the probabilities that it would have drawn from are read off.
    adapter, asked = at(adapter, temperature), requests(16)
    latent, log_prob = stored(adapter.decide(asked, 0))
    tokens, seen = latent["tokens"], []

    def dictated(probabilities: Tensor, num_samples: int) -> Tensor:
        position = len(seen)
        seen.append(probabilities.gather(1, tokens[:, position : position + 1])[:, 0])
        return tokens[:, position : position + 1]

    monkeypatch.setattr(torch, "multinomial", dictated)
    policy, batch = adapter.policy, adapter.processing.prepare(*stack_observations(asked))
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


def test_at_rest_it_is_lerobot_s_greedy_sampler(adapter: LeRobotAdapter):
    asked = requests(12, explore=False)
    observations, tasks = stack_observations(asked)
    assert adapter.self_check(observations, tasks) == 0.0
    batch = adapter.processing.prepare(observations, tasks)
    stock = adapter.processing.unnormalise(adapter.policy.predict_action_chunk(batch)).numpy()
    for temperature in (1.0, 0.3):
        decisions = at(adapter, temperature).decide(asked, 0)
        assert np.array_equal(np.stack([d.chunk for d in decisions]), stock)
        assert not np.stack([d.log_prob for d in decisions]).any()
    noisy = np.stack([d.chunk for d in adapter.decide(requests(12), 0)])
    assert np.abs(noisy - stock).max() > 1e-2 and np.abs(stock).max() > 0


def test_decisions_are_their_own_and_equal_to_the_bit(adapter: LeRobotAdapter):
    asked = requests(6)
    one = adapter.decide(asked, 7)
    torch.manual_seed(1)
    assert pickle.dumps(adapter.decide(asked, 7)) == pickle.dumps(one), "no global generator is read"
    assert one[0].chunk.shape == (4, 2) and one[0].chunk.dtype == np.float32
    assert one[0].log_prob.shape == (LENGTH,) and one[0].latent["tokens"].dtype == np.int64
    perturb(adapter, 0.1)
    first = requests(1)[0]
    decision = adapter.decide([first], 0)[0]
    for key, value in {
        "observation.state": np.full(4, 0.3, np.float32),
        "observation.images.front": np.zeros((32, 32, 3), np.uint8),
        "task": "Stay",
    }.items():
        changed = adapter.decide([replace(first, observation=first.observation | {key: value})], 0)[0]
        assert np.abs(changed.log_prob - decision.log_prob).max() > 1e-4
        assert abs(changed.value - decision.value) > 1e-5
    again = adapter.decide([replace(first, noise_seed=seed) for seed in range(20)], 0)
    assert len({d.latent["tokens"].tobytes() for d in again}) > 10 and len({d.value for d in again}) == 1


def test_ratio_one_after_save_and_load_and_a_segment_s_journey(
    adapter: LeRobotAdapter, path: Path, tmp_path: Path
):
    adapter, asked = at(adapter, 0.7), requests(9)
    perturb(adapter, 0.1)
    check_journey(adapter, asked, path, tmp_path / "saved")


def test_what_follows_the_terminator_does_not_count(adapter: LeRobotAdapter):
    asked = requests(24)
    latent, old = stored(adapter.decide(asked, 0))
    tokens, end = latent["tokens"], adapter.model.terminator
    factors = adapter.factors(latent)
    expected = np.array([[end not in row[:i] for i in range(LENGTH)] for row in tokens.tolist()])
    assert np.array_equal(factors, expected) and not factors.all()
    assert not old[~factors].any() and (old[factors] < 0).all()
    garbled = torch.where(factors, tokens, 17)
    with torch.no_grad():
        new = adapter.evaluate(*stack_observations(asked), {"tokens": garbled}).log_prob
    assert_close(new, old)
    assert torch.equal(adapter.model.chunk(garbled), adapter.model.chunk(tokens))


def test_one_reading_of_the_observations_serves_again_and_again(adapter: LeRobotAdapter):
    asked = requests(6)
    tokens = said(adapter.decide(asked, 0))
    encoded = adapter.encode(*stack_observations(asked))
    with torch.no_grad():
        first = encoded.context.logits(tokens)
        again = adapter.family.act(encoded, asked)
        assert torch.equal(again.latent["tokens"], tokens)
        assert torch.equal(encoded.context.logits(tokens), first)
        some = encoded.context.logits(tokens[:, :3])
    assert some.shape == (6, 3, VOCABULARY)
    assert_close(some, first[:, :3])


def test_the_layout_of_training_is_another_policy_s(adapter: LeRobotAdapter, monkeypatch: pytest.MonkeyPatch):
    """BOS as the first causal token, as LeRobot's loss has it: the self-check refuses to score like that."""
    asked = requests(4)
    observations, tasks = stack_observations(asked)
    encode = adapter.model.encode

    def in_training_layout(batch: dict[str, Tensor]) -> Any:
        policy, encoded = adapter.policy, encode(batch)
        bos = policy._paligemma_tokenizer.bos_token_id

        def logits(tokens: Tensor) -> Tensor:
            from lerobot.policies.common.vla_utils import prepare_attention_masks_4d

            causal = torch.cat([torch.full_like(tokens[:, :1], bos), tokens[:, :-1]], 1)
            embedded, pad, att, _, _ = policy.model.embed_prefix_fast(
                *policy._preprocess_images(batch),
                batch["observation.language.tokens"],
                batch["observation.language.attention_mask"],
                fast_action_tokens=causal,
                fast_action_masks=torch.ones_like(causal, dtype=torch.bool),
            )
            (hidden, _), _ = policy.model.paligemma_with_expert.forward(
                attention_mask=prepare_attention_masks_4d(att, dtype=embedded.dtype),
                position_ids=torch.cumsum(pad, 1) - 1,
                inputs_embeds=[embedded, None],
                use_cache=False,
            )
            return policy.model.paligemma_with_expert.paligemma.lm_head(hidden[:, -tokens.shape[1] :])

        return replace(encoded, context=TokenContext(logits=logits, generate=encoded.context.generate))

    decisions = adapter.decide(asked, 0)
    monkeypatch.setattr(adapter.model, "encode", in_training_layout)
    assert log_ratio(adapter, asked, decisions).abs().max() > 1e-3
    with pytest.raises(InputError, match=r"does not fit LeRobot 0\.6\.1: it differs from its sampler"):
        adapter.self_check(observations, tasks)


def test_an_incompatible_lerobot_fails_at_load(path: Path, monkeypatch: pytest.MonkeyPatch):
    from lerobot.policies.pi0_fast import modeling_pi0_fast

    core, policy = modeling_pi0_fast.PI0FastPytorch, modeling_pi0_fast.PI0FastPolicy
    sample, predict = core.sample_actions_fast_kv_cache, policy.predict_action_chunk

    def next_one(self: Any, *rest: Any, **options: Any) -> Tensor:
        return sample(self, *rest, **options) + 1

    def louder(self: Any, batch: dict[str, Tensor]) -> Tensor:
        return predict(self, batch) + 0.1

    for owner, attribute, changed in (
        (core, "sample_actions_fast_kv_cache", next_one),
        (policy, "predict_action_chunk", louder),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(owner, attribute, changed)
            with pytest.raises(InputError, match="differs from its sampler"):
                adapter_at(path)
    with monkeypatch.context() as patch:  # other tokens, the same chunk
        patch.setattr(core, "sample_actions_fast_kv_cache", next_one)
        patch.setattr(
            policy, "detokenize_actions", lambda self, tokens, **sizes: torch.zeros(len(tokens), 4, 2)
        )
        with pytest.raises(InputError, match="differs from its sampler"):
            adapter_at(path)
    monkeypatch.delattr(core, "embed_prefix_fast")
    with pytest.raises(InputError, match=r"cannot drive it \(AttributeError: .*embed_prefix_fast"):
        adapter_at(path)


def test_decoding_is_lerobot_s_and_never_fails(adapter: LeRobotAdapter, caplog: pytest.LogCaptureFixture):
    end, half, zeros = adapter.model.terminator, FIRST - CHARACTERS, FIRST - CHARACTERS - 1
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
    with caplog.at_level(logging.WARNING):
        pi0_fast._Undecodable.said = False
        chunks = adapter.model.chunk(torch.tensor(list(rows.values())))
    assert caplog.messages == ["tokens that FAST cannot decode were drawn; such a chunk is all zeros"]
    by_name = dict(zip(rows, chunks, strict=True))
    first = 8 / SCALE / 2  # the constant of an orthonormal transform of four rows
    assert_close(by_name["one coefficient"], torch.tensor([[first, 0.0]]).expand(4, -1))
    assert torch.equal(by_name["a sign"], -by_name["one coefficient"])
    assert torch.equal(by_name["text between"], by_name["one coefficient"])
    for name in ("pairs", "nothing", "only text", "not FAST's"):
        assert not by_name[name].any(), name
    assert by_name["too long"].abs().max() > 0 and torch.isfinite(chunks).all()
    assert by_name["half a letter"].abs().max() > 1000, "LeRobot takes U+FFFD for a coefficient"


def test_the_tokeniser_of_actions_goes_there_and_back(adapter: LeRobotAdapter):
    tokenizer = adapter.policy.action_tokenizer
    chunks = np.random.default_rng(0).uniform(-1, 1, (20, 4, 2))
    tokens = [torch.tensor(each) for each in tokenizer(torch.from_numpy(chunks))]
    decoded = adapter.policy.decode_actions_with_fast(tokens, 4, 2)
    # Each coefficient is off by at most half a step, so the chunk's norm is by at most √8 of them.
    assert np.linalg.norm((decoded - chunks).reshape(20, -1), axis=1).max() <= 0.5 / SCALE * math.sqrt(8)
    assert np.abs(decoded - chunks).max() > 0
