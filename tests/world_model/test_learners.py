# SPDX-License-Identifier: Apache-2.0
"""Training of world model and success model: held-out losses, divergence, two cameras."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from accerl_lerobot.world_model.config import LearnConfig, PixelModelConfig, SuccessLearnConfig
from accerl_lerobot.world_model.data import Episode, Windows
from accerl_lerobot.world_model.learners import (
    HELD_OUT_SAMPLES,
    Examples,
    HeldOut,
    SuccessLearner,
    as_floats,
    held_out_success_metrics,
    new_success_model,
    train_from_scratch,
)
from accerl_lerobot.world_model.metrics import skill, squared_errors
from accerl_lerobot.world_model.pixels import PixelWorldModel
from tests.world_model.test_pixels import NETWORK, SIZE, SPEC, K, awake, dots, model, rollout, windows
from tests.world_model.test_validate import Deterministic, with_successes

CONFIG = LearnConfig(steps=12, batch=4, anchors=3, validate_every=5)


def darker(episodes: list[Episode]) -> list[Episode]:
    """As they are, but known by their frames, of which no pixel is as bright as before."""
    return [replace(episode, frames=episode.frames // 2) for episode in episodes]


Told = list[tuple[int, dict[str, float]]]


def learn(held_out: list[Episode], **changes: Any) -> tuple[dict[str, torch.Tensor], Told, Told]:
    """All weights and statistics in the end, and what was told of the steps and of what is held out."""
    steps: Told = []
    told: Told = []
    learner = train_from_scratch(
        awake(model()), dots(6), replace(CONFIG, **changes), 3,
        on_step=lambda step, metrics: steps.append((step, metrics)),
        held_out=HeldOut(held_out, lambda step, metrics: told.append((step, metrics))),
    )  # fmt: skip
    weights = {f"{name}.{k}": v for name in ("model", "serving") for k, v in learner.state()[name].items()}
    return weights, steps, told


def test_what_is_learned_is_the_same_with_it_and_without_it():
    held_out = darker(dots(3, seed=5))
    with_it, steps, told = learn(held_out)
    assert [step for step, _ in told] == [5, 10] and [step for step, _ in steps] == list(range(1, 13))
    for without, same, nothing in (learn(held_out, validate_every=0), learn([]), learn(dots(1, steps=1))):
        assert nothing == [] and same == steps
        assert (
            all(torch.equal(v, without[k]) for k, v in with_it.items()) and without.keys() == with_it.keys()
        )


def test_it_is_of_held_out_windows_alone_and_of_the_weights_that_serve(monkeypatch: pytest.MonkeyPatch):
    seen: list[tuple[bool, Windows, float, torch.Tensor]] = []
    real = PixelWorldModel.loss

    def loss(self: PixelWorldModel, windows: Windows, generator: torch.Generator) -> Any:
        made = real(self, windows, generator)
        weight = next(self.parameters())
        seen.append((torch.is_grad_enabled(), windows, made[0].item(), weight.detach().clone()))
        assert weight.requires_grad is torch.is_grad_enabled(), "only one of the two is trained"
        return made

    monkeypatch.setattr(PixelWorldModel, "loss", loss)
    held_out = darker(dots(12, seed=5))
    _, _, told = learn(held_out)
    trained, looked_at = ([one for one in seen if one[0] is kind] for kind in (True, False))
    assert len(trained) == 12 and len(looked_at) == len(told) == 2
    assert all(of.frames.max() == 220 for _, of, _, _ in trained)
    for (_, of, value, _), (_, metrics) in zip(looked_at, told, strict=True):
        assert of.frames.max() == of.anchor.max() == 110 and len(of) == HELD_OUT_SAMPLES
        assert set(metrics) == {"image", "image_imagined", "state", "loss"} and metrics["loss"] == value
        assert metrics["loss"] == pytest.approx(metrics["image"] + metrics["state"], rel=1e-4)
    (_, first, _, weight), (_, second, _, later) = looked_at
    assert all(np.array_equal(getattr(first, k), getattr(second, k)) for k in ("frames", "anchor", "actions"))
    assert len({w.tobytes() for w in first.frames}) > HELD_OUT_SAMPLES / 2, "not one and the same window"
    assert not torch.equal(weight, later)


def test_equal_weights_have_equal_losses():
    """The noise is always the same: what changes is what was learnt."""
    frozen = {"lr": 1e-12, "average": 0.0, "weight_decay": 0.0}
    (_, first), (_, second) = learn(darker(dots(3, seed=5)), **frozen)[2]
    assert first == pytest.approx(second, rel=1e-6)


def test_a_placebo_is_looked_at_with_true_actions(monkeypatch: pytest.MonkeyPatch):
    seen: list[Windows] = []
    real = PixelWorldModel.loss

    def loss(self: PixelWorldModel, windows: Windows, generator: torch.Generator) -> Any:
        seen.append(windows)
        return real(self, windows, generator)

    monkeypatch.setattr(PixelWorldModel, "loss", loss)
    held_out = darker(dots(3, seed=5))
    train_from_scratch(
        model(),
        dots(6),
        replace(CONFIG, steps=5),
        3,
        shuffle=True,
        held_out=HeldOut(held_out, lambda step, metrics: None),
    )
    *_, windows = seen
    made = {e.state[t].tobytes(): e.actions[t : t + K] for e in held_out for t in range(len(e))}
    whole = np.flatnonzero(windows.steps[:, 0] == K)
    assert len(whole) > 20
    for row in whole:
        assert np.array_equal(windows.actions[row, 0], made[windows.state[row, 1].tobytes()])


SUCCESS_CONFIG = SuccessLearnConfig(batch=8, episodes=4, depth=2, refresh_every=3)


def examples(seed: int) -> Examples:
    return Examples(with_successes(dots(30, seed=seed)), K)


def new() -> SuccessLearner:
    torch.manual_seed(0)
    return SuccessLearner(new_success_model(K), SUCCESS_CONFIG, seed=0)


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


def test_what_is_learned_is_the_same_with_validation_and_without_it():
    of, held, world = examples(1), examples(2), Deterministic("exact")
    learners = [new(), new()]
    for step in range(6):
        losses = [learner.step(of, world) for learner in learners]
        assert losses[0] == losses[1]
        if step % 2:
            held_out_success_metrics(learners[0].model, held, seed=0)
            assert learners[0].model.training
    one, other = (learner.model.state_dict() for learner in learners)
    assert all(torch.equal(v, other[k]) for k, v in one.items())


def test_validation_is_of_the_same_seen_pairs_as_they_are():
    model, held = new().model, examples(2)
    found = held_out_success_metrics(model, held, seed=0)
    assert (
        found
        == held_out_success_metrics(model, held, seed=0)
        != held_out_success_metrics(model, held, seed=1)
    )
    assert set(found) == {"loss", "accuracy", "progress"}
    # By hand: nothing is shaken, and half of the pairs are successes.
    before, after, success, progress = held.sample(HELD_OUT_SAMPLES, np.random.default_rng((0, 9)))
    assert success.sum() == HELD_OUT_SAMPLES / 2
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
    held_out_success_metrics(model, Examples(held, K), seed=0)
    assert sum(map(len, shown)) == 2 * HELD_OUT_SAMPLES
    assert {frame.tobytes() for part in shown for frame in part} <= frames_of(held)


def frames_of(episodes: list[Episode]) -> set[bytes]:
    return {frame.tobytes() for episode in episodes for frame in episode.frames}


TWO = replace(SPEC, cameras=("observation.images.top", "observation.images.wrist"))


def drawn(at: np.ndarray) -> np.ndarray:
    """A black square on light grey, uint8 (H, W, 3)."""
    frame = np.full((SIZE, SIZE, 3), 180, np.uint8)
    y, x = np.round(at).astype(int)
    frame[y : y + 4, x : x + 4] = 20
    return frame


def gone(at: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """Where the second camera's dot is after these actions (K, A): it goes the other way."""
    for action in actions:
        at = np.clip(at - 2 * action, 0, SIZE - 4)
    return at


def seen_twice(episodes: list[Episode], seed: int) -> tuple[list[Episode], list[np.ndarray]]:
    """With a second camera, and where its dot is at each frame."""
    rng, made, paths = np.random.default_rng(seed), [], []
    for episode in episodes:
        path = [rng.uniform(2, SIZE - 6, 2)]
        for action in episode.actions[:-1]:
            path.append(gone(path[-1], action[None]))
        second = np.stack([drawn(at) for at in path])[:, None]
        made.append(replace(episode, frames=np.concatenate([episode.frames, second], 1)))
        paths.append(np.stack(path))
    return made, paths


def two_cameras(seed: int = 0) -> PixelWorldModel:
    torch.manual_seed(seed)
    return PixelWorldModel(TWO, PixelModelConfig(network=NETWORK))


def swapped(of: Windows) -> Windows:
    """Each camera shows what the other one did."""
    return replace(of, frames=of.frames[:, :, ::-1].copy(), anchor=of.anchor[:, ::-1].copy())


def test_frames_go_in_and_come_out_in_the_order_of_the_cameras():
    """A new model is a copy of the last frame."""
    of = windows(seen_twice(dots(2), 1)[0])
    for shown in (of, swapped(of)):
        frames = rollout(two_cameras(), shown)[0].frames.numpy()
        assert frames.shape[1:] == (2, SIZE, SIZE, 3) and np.array_equal(frames, shown.frames[:, 1])
    assert not np.array_equal(of.frames[:, 1, 0], of.frames[:, 1, 1])


@pytest.fixture(scope="module")
def learnt() -> PixelWorldModel:
    config = LearnConfig(steps=200, batch=16, lr=2e-3, warmup=10, anchors=3)
    return train_from_scratch(two_cameras(), seen_twice(dots(60), 1)[0], config, seed=0).serving


def skills(frames: np.ndarray, wanted: np.ndarray, newest: np.ndarray, of: Windows) -> list[float]:
    """Skill for each camera, frames uint8 (B, V, H, W, 3)."""
    return [
        skill(
            squared_errors(frames[:, v : v + 1], wanted[:, v : v + 1]),
            squared_errors(newest[:, v : v + 1], wanted[:, v : v + 1]),
            of.episode,
        ).value
        for v in range(2)
    ]


@pytest.mark.slow
def test_either_camera_is_predicted_in_its_place(learnt: PixelWorldModel):
    of = windows(seen_twice(dots(12, seed=5), 6)[0])
    frames, wanted = rollout(learnt, of)[0].frames.numpy(), of.frames[:, 2]
    assert min(skills(frames, wanted, of.frames[:, 1], of)) > 0.4
    # Each looks like its own camera, and nothing like the other one.
    crossed = squared_errors(frames[:, ::-1], wanted).mean()
    assert crossed > 10 * squared_errors(frames, wanted).mean()
