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
from accerl_lerobot.policies.family import Encoded
from accerl_lerobot.policies.tokens import TokenContext, TokenFamily, TokenModel
from tests.rounding import assert_close

VOCABULARY, LENGTH, WIDTH = 4, 3, 5
END = 3


class Recurrent(TokenModel):
    """Autoregressive: h ← tanh(h + E[token]), logits = U h; the observation is the first h."""

    terminator, length, width = END, LENGTH, WIDTH

    def __init__(self, perturbation: float = 0.0) -> None:
        draw = torch.Generator().manual_seed(1)
        self.embedding = torch.randn(VOCABULARY, WIDTH, generator=draw)
        self.out = torch.randn(VOCABULARY, WIDTH, generator=draw)
        self.decoder = torch.randn(LENGTH, VOCABULARY, 2, generator=draw)
        self.out += perturbation * torch.randn(VOCABULARY, WIDTH, generator=draw)
        self.embedding += perturbation * torch.randn(VOCABULARY, WIDTH, generator=draw)

    def encode(self, batch: dict[str, Tensor]) -> Encoded:
        start = batch["observation"]
        mask = torch.ones(len(start), 1, dtype=torch.bool)

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
                assert chosen.dtype == torch.int64
                if (chosen == END).all():
                    break
                h = torch.tanh(h + self.embedding[chosen])

        context = TokenContext(logits=logits, generate=generate)
        return Encoded(features=start[:, None], mask=mask, context=context)

    def chunk(self, tokens: Tensor) -> Tensor:
        """One action that hangs on all tokens and on where the terminator is."""
        return sum(self.decoder[i, tokens[:, i]] for i in range(LENGTH))[:, None]

    def stock(self, batch: dict[str, Tensor]) -> Tensor:
        rows = []
        for start in batch["observation"]:
            said = _greedy(self, start.numpy().astype(np.float64))
            rows.append(self.chunk(torch.tensor([said]))[0])
        return torch.stack(rows)


class Parallel(TokenModel):
    """All logits at once, from the observation alone."""

    terminator, length, width = None, LENGTH, WIDTH

    def __init__(self, perturbation: float = 0.0) -> None:
        draw = torch.Generator().manual_seed(2)
        self.out = torch.randn(LENGTH, VOCABULARY, WIDTH, generator=draw)
        self.out += perturbation * torch.randn(LENGTH, VOCABULARY, WIDTH, generator=draw)

    def encode(self, batch: dict[str, Tensor]) -> Encoded:
        start = batch["observation"]
        logits = torch.einsum("bw,lvw->blv", start, self.out)
        mask = torch.ones(len(start), 1, dtype=torch.bool)
        return Encoded(features=start[:, None], mask=mask, context=TokenContext(logits=lambda tokens: logits))

    def chunk(self, tokens: Tensor) -> Tensor:
        return (tokens / VOCABULARY)[..., None]

    def stock(self, batch: dict[str, Tensor]) -> Tensor:
        return self.chunk(torch.einsum("bw,lvw->blv", batch["observation"], self.out).argmax(-1))


def slow_logits(model: Any, start: np.ndarray, said: tuple[int, ...]) -> np.ndarray:
    """Logits (V,) of position ``len(said)``, in double precision."""
    if isinstance(model, Parallel):
        return model.out[len(said)].double().numpy() @ start
    h = start
    for token in said:
        h = np.tanh(h + model.embedding[token].double().numpy())
    return model.out.double().numpy() @ h


def slow_probabilities(
    model: Any, start: np.ndarray, said: tuple[int, ...], temperature: float
) -> list[float]:
    weights = [math.exp(x / temperature) for x in slow_logits(model, start, said)]
    return [w / sum(weights) for w in weights]


def _greedy(model: Any, start: np.ndarray) -> list[int]:
    said: tuple[int, ...] = ()
    while len(said) < LENGTH:
        ended = model.terminator is not None and model.terminator in said
        said += (END if ended else int(np.argmax(slow_logits(model, start, said))),)
    return list(said)


def sequences(model: Any) -> list[tuple[int, ...]]:
    """All that the model can say, the terminator to the end after the first."""
    every = itertools.product(range(VOCABULARY), repeat=LENGTH)
    if model.terminator is None:
        return list(every)
    return [s for s in every if all(b == END for a, b in itertools.pairwise(s) if a == END)]


def oracle(
    model: Any, start: np.ndarray, said: tuple[int, ...], temperature: float
) -> tuple[list, float, list]:
    """Log-probs (L,), entropy and factors (L,) of one sequence."""
    log_probs, entropy, exists = [], 0.0, []
    for position in range(LENGTH):
        exists.append(model.terminator is None or model.terminator not in said[:position])
        if not exists[-1]:
            log_probs.append(0.0)
            continue
        p = slow_probabilities(model, start, said[:position], temperature)
        log_probs.append(math.log(p[said[position]]))
        entropy -= sum(x * math.log(x) for x in p)
    return log_probs, entropy, exists


def observations(count: int, seed: int = 0) -> Tensor:
    return torch.randn(count, WIDTH, generator=torch.Generator().manual_seed(seed))


def requests(count: int, explore: bool = True, first: int = 0) -> list[Request]:
    return [Request(observation={}, noise_seed=first + i, explore=explore) for i in range(count)]


def family(model: Any, temperature: float = 1.0) -> TokenFamily:
    return TokenFamily(model, TokenSamplerConfig(temperature=temperature))


def encoded(model: Any, starts: Tensor) -> Encoded:
    return model.encode({"observation": starts})


MODELS = [Recurrent, Parallel]


@pytest.mark.parametrize("temperature", [1.0, 0.5, 3.0])
@pytest.mark.parametrize("kind", MODELS)
def test_scores_are_the_oracle_s_for_all_that_can_be_said(kind: Any, temperature: float):
    model = kind()
    said = sequences(model)
    start = observations(1)
    tokens_family, latent = family(model, temperature), {"tokens": torch.tensor(said)}
    log_prob, entropy = tokens_family.score(encoded(model, start.expand(len(said), -1)), latent)
    factors = tokens_family.factors(latent)
    expected = [oracle(model, start[0].double().numpy(), s, temperature) for s in said]
    assert_close(log_prob, [e[0] for e in expected])
    assert_close(entropy, [e[1] for e in expected])
    assert log_prob.sum(1).exp().sum() == pytest.approx(1.0, abs=1e-4), "a density over them"
    if kind is Recurrent:
        assert factors is not None and factors.tolist() == [e[2] for e in expected]
        assert not factors.all()
    else:
        assert factors is None


@pytest.mark.parametrize("temperature", [1.0, 0.4, 3.0])
@pytest.mark.parametrize("kind", MODELS)
def test_sequences_are_as_frequent_as_their_probability(kind: Any, temperature: float):
    model, start, count = kind(), observations(1), 20_000
    read = encoded(model, start.expand(count, -1))
    action = family(model, temperature).act(read, requests(count))
    seen = Counter(map(tuple, action.latent["tokens"].tolist()))
    said = sequences(model)
    assert seen.keys() <= set(said)
    squares = 0.0
    for sequence in said:
        p = math.exp(sum(oracle(model, start[0].double().numpy(), sequence, temperature)[0]))
        squares += (seen[sequence] - count * p) ** 2 / (count * p)
    freedom = len(said) - 1
    assert squares < freedom + 5 * math.sqrt(2 * freedom), "χ²"


@pytest.mark.parametrize("kind", MODELS)
def test_weighted_samples_of_mu_are_samples_of_pi(kind: Any):
    old, new, start, count = kind(), kind(0.3), observations(1, seed=1), 20_000
    starts = start.expand(count, -1)
    action = family(old).act(encoded(old, starts), requests(count))
    log_prob = family(new).score(encoded(new, starts), action.latent)[0]
    ratio = (log_prob - action.log_prob).sum(1).exp().double()

    def payoff(chunk: Tensor) -> Tensor:
        x = chunk.flatten(1).double()
        return torch.tanh(2 * (x[:, 0] - x[:, -1])) + x[:, 0] ** 2

    def exact(model: Any) -> float:
        said = sequences(model)
        each = [math.exp(sum(oracle(model, start[0].double().numpy(), s, 1.0)[0])) for s in said]
        return float(np.dot(each, payoff(old.chunk(torch.tensor(said)))))

    product = ratio * payoff(action.chunk)
    error = float(product.std()) / math.sqrt(count)
    assert abs(exact(old) - exact(new)) > 10 * error, "the weights must matter, or the test shows nothing"
    assert abs(float(product.mean()) - exact(new)) < 4 * error
    assert abs(float(ratio.mean()) - 1) < 4 * float(ratio.std()) / math.sqrt(count)


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


@pytest.mark.parametrize("kind", MODELS)
def test_the_self_check_passes_the_most_likely_tokens_and_no_others(kind: Any):
    model, batch = kind(), {"observation": observations(6)}
    read, stock = model.encode(batch), model.stock(batch)
    assert family(model, 2.0).difference(batch, read) == 0.0
    model.stock = lambda batch: stock + 0.1
    assert family(model).difference(batch, read) == pytest.approx(0.1, rel=1e-4)
