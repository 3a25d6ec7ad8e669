# SPDX-License-Identifier: Apache-2.0
"""The tokens family's likelihood: a chunk is a sequence of L tokens, each drawn from a softmax of V logits.

Two kinds of model. A *parallel* one gives the logits of all positions in one pass, and tokens are independent
given the observations (OpenVLA-OFT, arXiv 2502.19645; AcceRL, arXiv 2603.18464). An *autoregressive* one
gives position l from the tokens before it (π0-FAST, arXiv 2501.09747), and ends with a terminator token.

    π(tokens | o) = Π_l softmax(logits_l / temperature)[token_l]

Position l is a factor of the log-prob as long as no terminator precedes it; the terminator itself is one.
What a model decodes from the tokens is a function of them, so their density is the action's: exact, with
nothing left out.

A token is drawn by inverting the distribution function at one uniform number per position, which comes from
the request's own seed: what a request gets does not depend on its batch, and costs L random numbers, not L·V.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from accerl_lerobot.experience import Request
from accerl_lerobot.policies.config import TokenSamplerConfig
from accerl_lerobot.policies.family import Action, Encoded, Family, Latent, Model

Choose = Callable[[Tensor, int], Tensor]  # (logits (B, V), position) → tokens (B,), int64


@dataclass(frozen=True, kw_only=True)
class TokenContext:
    """`Encoded.context` of a token model: logits given the observations.

    Logits are in the dtype the network computes in, -inf where a token is impossible.
    """

    logits: Callable[[Tensor], Tensor]
    """tokens (B, L) → logits (B, L, V), differentiable; position l depends on ``tokens[:, :l]`` only, and in
    a parallel model on no token at all. With a terminator, any number of positions from the first on."""
    generate: Callable[[Choose], None] | None = None
    """None in a parallel model; an autoregressive one has a terminator. Calls `Choose` for positions 0, 1, …
    and feeds the model with what it answers; ends after L positions, or once the answer is the terminator in
    every row (a row that has ended goes on getting it). The logits are those of the call above, up to
    rounding."""


class TokenModel(Model):
    """A LeRobot policy that chooses tokens; `Encoded.context` is a `TokenContext`."""

    terminator: int | None  # the token after which the others mean nothing; None: all L always count
    length: int  # L, most tokens of a decision. Tokens that reach no executed action have no place among them

    @abstractmethod
    def chunk(self, tokens: Tensor) -> Tensor:
        """Tokens (B, L), terminators to the end after the first, to the executed (B, K, A), normalised."""


def draw(logits: Tensor, uniform: Tensor, temperature: float) -> Tensor:
    """Tokens (...) from logits (..., V): the distribution function inverted at `uniform` (...) in [0, 1)."""
    # In double precision: in single the sum is off by more than many a token's probability.
    probabilities = torch.softmax(logits.float() / temperature, -1)
    cumulative = probabilities.double().cumsum(-1)
    total = cumulative[..., -1:]
    place = uniform.to(cumulative)[..., None] * total
    tokens = torch.searchsorted(cumulative, place, right=True)[..., 0]
    return tokens.clamp(max=logits.shape[-1] - 1)  # only where logits are NaN, which the log-prob shows


def token_log_prob(logits: Tensor, tokens: Tensor, temperature: float) -> Tensor:
    """Log-prob of each token (...), in fp32, from logits (..., V)."""
    log_probs = torch.log_softmax(logits.float() / temperature, -1)
    return log_probs.gather(-1, tokens[..., None])[..., 0]


def token_entropy(logits: Tensor, temperature: float) -> Tensor:
    """Entropy (...) in nats of the distribution over the V tokens, exact."""
    log_probs = torch.log_softmax(logits.float() / temperature, -1)
    impossible = log_probs == -torch.inf
    finite = log_probs.masked_fill(impossible, 0.0)  # 0·log 0 is 0, and so is its gradient
    return -(log_probs.exp() * finite).sum(-1)


def existing(tokens: Tensor, terminator: int | None) -> Tensor:
    """bool (B, L): up to and including the first terminator."""
    if terminator is None:
        return torch.ones_like(tokens, dtype=torch.bool)
    ends = (tokens == terminator).long()
    ends_before = ends.cumsum(1) - ends
    return ends_before == 0


class TokenFamily(Family):
    """Token policies explored by sampling at a temperature.

    The latent is ``tokens``, int64 (L,), the terminator from the first one on."""

    model: TokenModel
    sampler: TokenSamplerConfig

    def act(self, encoded: Encoded, requests: Sequence[Request]) -> Action:
        """Samples; where a request does not explore, the most likely token."""
        device = encoded.features.device
        explore = self.exploring(requests, device)
        generators = [np.random.default_rng(request.noise_seed) for request in requests]
        draws = np.stack([generator.random(self.model.length) for generator in generators])
        uniform = torch.from_numpy(draws).to(device)
        tokens, log_prob = self._decide(encoded, explore, uniform)
        counted = explore[:, None] & existing(tokens, self.model.terminator)
        log_prob = torch.where(counted, log_prob, 0.0)
        return Action(self.model.chunk(tokens), {"tokens": tokens}, log_prob)

    def score(self, encoded: Encoded, latent: Latent) -> tuple[Tensor, Tensor]:
        """Re-scores; the entropy is that of the distributions the factors were drawn from."""
        tokens = latent["tokens"]
        factors = existing(tokens, self.model.terminator)
        # Positions at which every row has ended are not computed: a logit for each of V tokens is a lot.
        used = int(factors.any(0).sum())
        used_tokens = tokens[:, :used]
        temperature = self.sampler.temperature
        logits = encoded.context.logits(used_tokens)
        log_prob = token_log_prob(logits, used_tokens, temperature)
        log_prob = nn.functional.pad(log_prob, (0, tokens.shape[1] - used))
        log_prob = torch.where(factors, log_prob, 0.0)
        entropy = token_entropy(logits, temperature)
        entropy = torch.where(factors[:, :used], entropy, 0.0)
        return log_prob, entropy.sum(1)

    def factors(self, latent: Latent) -> Tensor | None:
        terminator = self.model.terminator
        if terminator is None:
            return None
        return existing(latent["tokens"], terminator)

    def _decide(self, encoded: Encoded, explore: Tensor, uniform: Tensor) -> tuple[Tensor, Tensor]:
        """Tokens and their log-probs, each (B, L), in one pass or position by position."""
        context: TokenContext = encoded.context
        terminator = self.model.terminator
        temperature = self.sampler.temperature

        def pick(logits: Tensor, uniform: Tensor, explore: Tensor) -> tuple[Tensor, Tensor]:
            drawn = draw(logits, uniform, temperature)
            tokens = torch.where(explore, drawn, logits.argmax(-1))
            return tokens, token_log_prob(logits, tokens, temperature)

        if context.generate is None:
            logits = context.logits(torch.zeros_like(uniform, dtype=torch.long))
            return pick(logits, uniform, explore[:, None])
        assert terminator is not None
        tokens = torch.full_like(uniform, terminator, dtype=torch.long)
        log_prob = torch.zeros_like(uniform, dtype=torch.float32)
        running = torch.ones_like(explore)

        def choose(logits: Tensor, position: int) -> Tensor:
            picked, each = pick(logits, uniform[:, position], explore)
            tokens[:, position] = torch.where(running, picked, terminator)
            log_prob[:, position] = each
            running.logical_and_(picked != terminator)
            return tokens[:, position]

        context.generate(choose)
        return tokens, log_prob
