# SPDX-License-Identifier: Apache-2.0
"""The success model's learning: it stops when it has diverged, and looks at held-out pairs as it is told."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.config import SuccessLearnConfig
from accerl_lerobot.world_model.episodes import Episode
from accerl_lerobot.world_model.success import (
    VALIDATED,
    Examples,
    SuccessLearner,
    as_floats,
    new_success_model,
    validated,
)
from tests.world_model.test_pixels import K, dots
from tests.world_model.test_trial import Deterministic, with_successes

CONFIG = SuccessLearnConfig(batch=8, episodes=4, depth=2, every=3)


def examples(seed: int) -> Examples:
    return Examples(with_successes(dots(30, seed=seed)), K)


def new() -> SuccessLearner:
    torch.manual_seed(0)
    return SuccessLearner(new_success_model(K), CONFIG, seed=0)


def test_a_model_that_diverges_is_an_error_and_stays_as_it_was():
    learner, of, world = new(), examples(1), Deterministic("exact")
    learner.step(of, world)
    with torch.no_grad():
        learner.model.out.bias.fill_(torch.nan)
    before = {k: v.clone() for k, v in learner.model.state_dict().items()}
    with pytest.raises(
        FloatingPointError,
        match=r"^the success model's .* not finite at step 2; lower world_model.success.lr",
    ):
        learner.step(of, world)
    now = learner.model.state_dict()
    assert all(torch.equal(v, now[k]) for k, v in before.items() if k != "out.bias")


def test_what_is_learnt_is_the_same_with_validation_and_without_it():
    of, held, world = examples(1), examples(2), Deterministic("exact")
    learners = [new(), new()]
    for step in range(6):
        losses = [learner.step(of, world) for learner in learners]
        assert losses[0] == losses[1]
        if step % 2:
            validated(learners[0].model, held, seed=0)
            assert learners[0].model.training
    one, other = (learner.model.state_dict() for learner in learners)
    assert all(torch.equal(v, other[k]) for k, v in one.items())


def test_validation_is_of_the_same_seen_pairs_as_they_are():
    model, held = new().model, examples(2)
    found = validated(model, held, seed=0)
    assert found == validated(model, held, seed=0) != validated(model, held, seed=1)
    assert set(found) == {"loss", "accuracy", "progress"}
    # By hand: nothing is shaken, and half of the pairs are successes.
    before, after, success, progress = held.seen(VALIDATED, np.random.default_rng((0, 9)))
    assert success.sum() == VALIDATED / 2
    with torch.no_grad():
        frames = (as_floats(x, torch.device("cpu")) for x in (before, after))
        said, along = (torch.sigmoid(x).double().numpy() for x in model.logits(*frames))
    known = ~np.isnan(progress)
    error = np.square(along - progress)[known].mean()
    assert found["accuracy"] == pytest.approx(((said > 0.5) == success).mean())
    assert found["progress"] == pytest.approx(error, rel=1e-4)
    entropy = -(np.log(said[success]).mean() + np.log(1 - said[~success]).mean()) / 2
    assert found["loss"] == pytest.approx(entropy + error, rel=1e-4)


def test_validation_looks_at_held_out_episodes_alone(monkeypatch: pytest.MonkeyPatch):
    shown: list[np.ndarray] = []
    model, held = new().model, with_successes(dots(30, seed=2))
    real = model.loss

    def loss(before: torch.Tensor, after: torch.Tensor, *args: object) -> object:
        shown.extend((255 * x).round().byte().movedim(2, -1).numpy() for x in (before, after))
        return real(before, after, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(model, "loss", loss)
    validated(model, Examples(held, K), seed=0)
    assert sum(map(len, shown)) == 2 * VALIDATED
    assert {frame.tobytes() for part in shown for frame in part} <= frames_of(held)


def frames_of(episodes: list[Episode]) -> set[bytes]:
    return {frame.tobytes() for episode in episodes for frame in episode.frames}


def test_bad_values_name_their_field():
    with pytest.raises(InputError, match="^world_model.success.validate_every=-1: use a whole number from 0"):
        SuccessLearnConfig(validate_every=-1)
