# SPDX-License-Identifier: Apache-2.0
"""The tokens family against a slow oracle, on two models small enough to enumerate what they can say."""

import itertools
import math
from collections import Counter
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.experience import Request
from accerl_lerobot.policies import tokens as tk
from accerl_lerobot.policies.config import TokenSamplerConfig
from accerl_lerobot.policies.family import Action, Encoded
from accerl_lerobot.policies.tokens import TokenContext, TokenFamily
from tests.rounding import assert_close

VOCABULARY, LENGTH, WIDTH = 4, 3, 5
END = 3
COUNT = 20_000


class Recurrent:
    """Autoregressive: h ← tanh(h + E[token]), logits = U h; the observation is the first h."""

    terminator, length = END, LENGTH

    def __init__(self, perturbation: float = 0.0) -> None:
        draw = torch.Generator().manual_seed(1)
        weights, moved = torch.randn(2, 2, VOCABULARY, WIDTH, generator=draw)
        self.embedding, self.out = weights + perturbation * moved

    def context(self, start: Tensor) -> TokenContext:
        def logits(tokens: Tensor) -> Tensor:
            h, rows = start, []
            for position in range(tokens.shape[1]):
                rows.append(h @ self.out.T)
                h = torch.tanh(h + self.embedding[tokens[:, position]])
            return torch.stack(rows, 1)

        def generate(choose: tk.Choose) -> None:
            h = start
            for position in range(LENGTH):
                chosen = choose(h @ self.out.T, position)
                if (chosen == END).all():
                    break
                h = torch.tanh(h + self.embedding[chosen])

        return TokenContext(logits=logits, generate=generate)

    def slow_logits(self, start: np.ndarray, said: tuple[int, ...]) -> np.ndarray:
        """Logits (V,) of position ``len(said)``, in double precision."""
        h = start
        for token in said:
            h = np.tanh(h + self.embedding[token].double().numpy())
        return self.out.double().numpy() @ h

    def chunk(self, tokens: Tensor) -> Tensor:
        return (tokens / VOCABULARY)[..., None]


class Parallel(Recurrent):
    """All logits at once, from the observation alone."""

    terminator = None

    def __init__(self, perturbation: float = 0.0) -> None:
        draw = torch.Generator().manual_seed(2)
        weights, moved = torch.randn(2, LENGTH, VOCABULARY, WIDTH, generator=draw)
        self.out = weights + perturbation * moved

    def context(self, start: Tensor) -> TokenContext:
        logits = torch.einsum("bw,lvw->blv", start, self.out)
        return TokenContext(logits=lambda tokens: logits)

    def slow_logits(self, start: np.ndarray, said: tuple[int, ...]) -> np.ndarray:
        return self.out[len(said)].double().numpy() @ start


def sequences(model: Any) -> list[tuple[int, ...]]:
    """All that the model can say, the terminator to the end after the first."""
    every = itertools.product(range(VOCABULARY), repeat=LENGTH)
    return [s for s in every if all(b == END for a, b in itertools.pairwise(s) if a == model.terminator)]


def oracle(model: Any, said: tuple[int, ...], temperature: float) -> tuple[list, float, list]:
    """Log-probs (L,), entropy and factors (L,) of one sequence."""
    log_probs, entropy, exists = [], 0.0, []
    for position in range(LENGTH):
        exists.append(model.terminator not in said[:position])
        weights = np.exp(model.slow_logits(START[0].double().numpy(), said[:position]) / temperature)
        p = weights / weights.sum()
        log_probs.append(exists[-1] * math.log(p[said[position]]))
        entropy -= exists[-1] * float(p @ np.log(p))
    return log_probs, entropy, exists


def probabilities(model: Any, temperature: float = 1.0) -> list[float]:
    """Those of `sequences`."""
    return [math.exp(sum(oracle(model, said, temperature)[0])) for said in sequences(model)]


START = torch.randn(1, WIDTH, generator=torch.Generator().manual_seed(0))  # the observation


def encoded(model: Any, count: int) -> Encoded:
    starts = START.expand(count, -1)
    mask = torch.ones(count, 1, dtype=torch.bool)
    return Encoded(features=starts[:, None], mask=mask, context=model.context(starts))


def family(model: Any, temperature: float = 1.0) -> TokenFamily:
    return TokenFamily(model, TokenSamplerConfig(temperature=temperature))


def act(model: Any, temperature: float = 1.0) -> Action:
    asked = [Request(observation={}, noise_seed=i) for i in range(COUNT)]
    return family(model, temperature).act(encoded(model, COUNT), asked)


KINDS = pytest.mark.parametrize("kind", [Recurrent, Parallel])


@pytest.mark.parametrize("temperature", [1.0, 0.5, 3.0])
@KINDS
def test_scores_are_the_oracle_s_for_all_that_can_be_said(kind: Any, temperature: float):
    model = kind()
    said = sequences(model)
    latent = {"tokens": torch.tensor(said)}
    log_prob, entropy = family(model, temperature).score(encoded(model, len(said)), latent)
    expected = [oracle(model, s, temperature) for s in said]
    assert_close(log_prob, [e[0] for e in expected])
    assert_close(entropy, [e[1] for e in expected])
    assert log_prob.sum(1).exp().sum() == pytest.approx(1.0, abs=1e-4), "a density over them"
    factors = family(model).factors(latent)
    if kind is Recurrent:
        assert factors is not None and factors.tolist() == [e[2] for e in expected]
        assert not factors.all()
    else:
        assert factors is None


@pytest.mark.parametrize("temperature", [1.0, 0.4, 3.0])
@KINDS
def test_sequences_are_as_frequent_as_their_probability(kind: Any, temperature: float):
    model = kind()
    seen = Counter(map(tuple, act(model, temperature).latent["tokens"].tolist()))
    said = sequences(model)
    assert seen.keys() <= set(said)
    found, expected = np.array([seen[s] for s in said]), COUNT * np.array(probabilities(model, temperature))
    freedom = len(said) - 1
    assert ((found - expected) ** 2 / expected).sum() < freedom + 5 * math.sqrt(2 * freedom), "χ²"


@KINDS
def test_weighted_samples_of_mu_are_samples_of_pi(kind: Any):
    old, new = kind(), kind(0.3)
    action = act(old)
    log_prob = family(new).score(encoded(new, COUNT), action.latent)[0]
    ratio = (log_prob - action.log_prob).sum(1).exp().double()

    def payoff(chunk: Tensor) -> Tensor:
        x = chunk.flatten(1).double()
        return torch.tanh(2 * (x[:, 0] - x[:, -1])) + x[:, 0] ** 2

    payoffs = payoff(old.chunk(torch.tensor(sequences(old))))
    of_old, of_new = (float(np.dot(probabilities(model), payoffs)) for model in (old, new))
    product = ratio * payoff(action.chunk)
    error = float(product.std()) / math.sqrt(COUNT)
    assert abs(of_old - of_new) > 10 * error, "the weights must matter, or the test shows nothing"
    assert abs(float(product.mean()) - of_new) < 4 * error
    assert abs(float(ratio.mean()) - 1) < 4 * float(ratio.std()) / math.sqrt(COUNT)


def test_impossible_tokens_are_never_drawn_and_spoil_nothing():
    logits = torch.tensor([[-torch.inf, 0.0, -torch.inf, 1.0, -torch.inf]], requires_grad=True)
    edges = torch.tensor([0.0, 0.2, 1 - 2**-53], dtype=torch.float64)
    assert tk.draw(logits.detach().expand(3, -1), edges, 1.0).tolist() == [1, 1, 3]
    entropy = tk.token_entropy(logits, 1.0)
    p = 1 / (1 + math.e)
    assert entropy.item() == pytest.approx(-p * math.log(p) - (1 - p) * math.log(1 - p), rel=1e-4)
    (entropy.sum() + tk.token_log_prob(logits, torch.tensor([3]), 1.0).sum()).backward()
    assert logits.grad is not None and torch.isfinite(logits.grad).all()


def test_a_large_vocabulary_is_drawn_from_without_rounding():
    # A quarter of a million equal tokens: in single precision the distribution function stops short of 1.
    size = 250_000
    place = (torch.arange(50, dtype=torch.float64) + 0.5) / 50
    drawn = tk.draw(torch.zeros(50, size), place, 1.0)
    assert (drawn - (place * size).long()).abs().max() <= 1
