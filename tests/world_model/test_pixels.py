# SPDX-License-Identifier: Apache-2.0
"""The pixel model on an environment of one dot that goes where it is told."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from accerl_lerobot.world_model import pixels
from accerl_lerobot.world_model.config import LearnConfig, PixelModelConfig, WorldModelConfig
from accerl_lerobot.world_model.contract import Prediction, Windows, WorldModelSpec, context_of
from accerl_lerobot.world_model.data import Episode, cut_windows, shuffle_actions, window_starts
from accerl_lerobot.world_model.learners import Learner, train_from_scratch
from accerl_lerobot.world_model.pixels import Attention, FrameNetwork, PixelWorldModel
from accerl_lerobot.world_model.validation import sensitivity, skill, squared_errors
from tests.rounding import assert_close

SIZE, K = 16, 2
SPEC = WorldModelSpec(
    cameras=("observation.images.top",),
    image_size=(SIZE, SIZE),
    state_dim=2,
    action_dim=2,
    chunk=K,
    context=2,
    fps=80,
)
CHANNELS = (24, 32)


def dots(count: int, steps: int = 12, seed: int = 0) -> list[Episode]:
    """A white square of 4×4 pixels on grey, moved by its actions; its state is where it is."""
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        at = rng.uniform(2, SIZE - 6, 2)
        frames, states, actions = [], [], []
        for _ in range(steps):
            frame = np.full((1, SIZE, SIZE, 3), 60, np.uint8)
            y, x = np.round(at).astype(int)
            frame[:, y : y + 4, x : x + 4] = 220
            frames.append(frame)
            states.append(at.astype(np.float32))
            action = rng.uniform(-2, 2, 2)
            at = np.clip(at + action, 0, SIZE - 4)
            actions.append((action / 2).astype(np.float32))
        made.append(
            Episode(
                frames=np.stack(frames),
                times=np.arange(steps),
                state=np.stack(states),
                actions=np.stack(actions),
                success_at=-1,
                task="go",
                own=False,
            )
        )
    return made


def model(**options: object) -> PixelWorldModel:
    torch.manual_seed(0)
    return PixelWorldModel(SPEC, PixelModelConfig(channels=CHANNELS, **options))  # type: ignore[arg-type]


def windows(episodes: list[Episode], chunks: int = 3) -> Windows:
    at = [p for p in window_starts(episodes) if p.frame + K * chunks < len(episodes[p.episode].frames)]
    return cut_windows(episodes, at, SPEC, chunks)


def rollout(
    made: PixelWorldModel, of: Windows, actions: np.ndarray | None = None, seed: int = 0
) -> list[Prediction]:
    """One rollout after another, as many as the windows have chunks."""
    chosen = of.actions if actions is None else actions
    state = made.begin(context_of(of), of.task)
    predictions = []
    for r in range(chosen.shape[1]):
        seeds = [1000 * seed + 10 * i + r for i in range(len(of))]
        predictions.append(made.step(state, torch.from_numpy(chosen[:, r]), seeds))
        state = predictions[-1].state
    return predictions


def awake[M: torch.nn.Module](made: M) -> M:
    """Random where it starts at zero."""
    with torch.no_grad():
        for p in made.parameters():
            if not p.any():
                p.normal_(std=0.1)
    return made


def test_a_new_model_is_a_copy_of_the_last_frame():
    of = windows(dots(2))
    for one in rollout(model(), of):
        assert np.array_equal(one.frames.numpy(), of.frames[:, 1])


def test_frames_go_in_and_come_out_in_the_order_of_the_cameras():
    of = windows(dots(2))
    frames, anchor = (np.concatenate([x, 255 - x], -4) for x in (of.frames, of.anchor))
    of, spec = replace(of, frames=frames, anchor=anchor), replace(SPEC, cameras=("a", "b"))
    made = PixelWorldModel(spec, PixelModelConfig(channels=CHANNELS))
    assert np.array_equal(rollout(made, of)[0].frames.numpy(), frames[:, 1])


def test_a_rollout_depends_on_its_row_alone():
    of = windows(dots(2), chunks=2)
    made = awake(model())
    together = rollout(made, of)
    assert torch.equal(together[1].frames, rollout(made, of)[1].frames)
    state = made.begin(context_of(of, slice(3, 4)), of.task[3:4])
    alone = made.step(state, torch.from_numpy(of.actions[3:4, 0]), [30])
    assert (alone.frames.int() - together[0].frames[3:4].int()).abs().max() <= 1, "rounding"
    assert_close(alone.robot, together[0].robot[3:4])


def test_a_state_is_not_changed_by_going_on_from_it():
    of = windows(dots(1))
    made = awake(model())
    state = made.begin(context_of(of), of.task)
    before = {k: v.clone() for k, v in state.items()}
    first = made.step(state, torch.from_numpy(of.actions[:, 0]), range(len(of)))
    assert all(torch.equal(v, state[k]) for k, v in before.items())
    assert torch.equal(first.state["frames"][:, 0], state["frames"][:, 1]), "the context rolls"
    assert torch.equal(first.state["frames"][:, 1], first.frames)
    assert torch.equal(first.state["anchor"], state["anchor"]), "the anchor stays"


def test_a_picture_that_is_no_number_is_uncertain(monkeypatch: pytest.MonkeyPatch):
    of = windows(dots(1))
    made = awake(model())
    state, change = made.begin(context_of(of), of.task), made._change

    def broken(*given: object) -> torch.Tensor:
        image = change(*given)  # type: ignore[arg-type]
        image[1, 0, 2, 2] = torch.nan
        return image

    monkeypatch.setattr(made, "_change", broken)
    doubt = made.step(state, torch.from_numpy(of.actions[:, 0]), range(len(of))).uncertainty
    assert doubt[1] == torch.inf and torch.isfinite(doubt).sum() == len(of) - 1


def test_actions_that_are_not_executed_do_not_matter():
    of = windows(dots(2))
    cut_short = replace(of, steps=np.where(np.arange(3) == 0, 1, of.steps))
    changed = cut_short.actions.copy()
    changed[:, 0, 1] = 9.0
    made = awake(model())
    made.fit_statistics(of)
    losses = [
        float(made.loss(w, torch.Generator().manual_seed(0))[0])
        for w in (cut_short, replace(cut_short, actions=changed), replace(of, actions=changed))
    ]
    assert losses[0] == losses[1] != losses[2]


def test_what_is_not_valid_is_not_learnt():
    of = windows(dots(2))
    steps = of.steps.copy()
    steps[1:] = 0
    frames = of.frames.copy()
    frames[1:, 2:] = 0
    made = awake(model())

    def loss(of: Windows) -> float:
        return float(made.loss(of, torch.Generator().manual_seed(0))[0])

    one = loss(replace(of, steps=steps))
    assert one == loss(replace(of, steps=steps, frames=frames)) != loss(replace(of, frames=frames))


def test_statistics_by_hand():
    of = windows(dots(4))
    made = model()
    made.fit_statistics(of)
    state, motion = of.state[:, 1], of.state[:, 2] - of.state[:, 1]
    assert_close(made.robot_mean, state.mean(0), largest=float(np.abs(state).max()))
    assert_close(made.robot_std, state.std(0))
    assert_close(made.motion_std, motion.std(0))
    assert_close(made.action_std, of.actions[:, 0].reshape(-1, 2).std(0))
    off = of.frames[:, 2].astype(float) - of.frames[:, 1]
    assert float(made.change) == pytest.approx(np.sqrt(np.square(off / 127.5).mean()), rel=1e-4)


def test_only_what_is_learned_from_is_shown_with_noise(monkeypatch):
    of, made = windows(dots(3)), awake(model())
    made.fit_statistics(of)

    def loss(level: float, seed: int) -> float:
        monkeypatch.setattr(pixels, "CONTEXT_NOISE", level)
        return made.loss(of, torch.Generator().manual_seed(seed))[0].item()

    clean = rollout(made, of)
    assert loss(0.0, 0) == loss(0.0, 1) and loss(0.5, 0) == loss(0.5, 0) != loss(0.5, 1)
    little, much = (abs(loss(0.0, 0) - loss(level, 0)) for level in (0.05, 0.5))
    assert 0 < 3 * little < much, "as much as was asked for"
    for one, other in zip(clean, rollout(made, of), strict=True):
        assert torch.equal(one.frames, other.frames) and torch.equal(one.robot, other.robot)


def test_every_chunk_is_predicted_for_the_task():
    of = windows(dots(3))
    made = awake(model())
    one, other = (rollout(made, replace(of, task=(task,) * len(of))) for task in ("left", "right"))
    for first, second in zip(one, other, strict=True):
        assert not torch.equal(first.frames, second.frames) and not torch.equal(first.robot, second.robot)


def test_the_loss_reaches_every_weight():
    made = awake(model())
    of = windows(dots(3))
    made.fit_statistics(of)
    loss, metrics = made.loss(of, torch.Generator().manual_seed(0))
    loss.backward()
    silent = [k for k, p in made.named_parameters() if p.grad is None or not p.grad.abs().max() > 0]
    assert silent == [] and set(metrics) == {"image", "state", "image_imagined"}


def trained(shuffle: bool = False, **options: object) -> Learner:
    learn = LearnConfig(steps=250, batch=16, lr=2e-3)
    config = WorldModelConfig(learn=learn, longest=3, shuffle_actions=shuffle)
    return train_from_scratch(model(**options), dots(60), config, seed=0)


@pytest.fixture(scope="module")
def learnt() -> Learner:
    return trained()


def scores(learner: Learner, depth: int = 0) -> tuple[float, float]:
    """(skill, sensitivity) on dots that were not seen."""
    episodes = dots(12, seed=5)
    of = windows(episodes)
    wanted = of.frames[:, 2 + depth]
    with torch.no_grad():
        true = squared_errors(rollout(learner.serving, of)[depth].frames.numpy(), wanted)
        wrong = shuffle_actions(of, np.random.default_rng(0)).actions
        other = squared_errors(rollout(learner.serving, of, wrong)[depth].frames.numpy(), wanted)
    copy = squared_errors(of.frames[:, 1], wanted)
    return skill(true, copy, of.episode)["value"], sensitivity(true, other, of.episode)["low"]


def test_it_learns_where_the_dot_goes(learnt: Learner):
    assert scores(learnt)[0] > 0.5 and scores(learnt, depth=2)[0] > 0.3
    assert scores(learnt)[1] > 2


def test_it_learns_where_the_robot_goes(learnt: Learner):
    of = windows(dots(12, seed=5))
    predictions = rollout(learnt.serving, of)
    for depth, most in ((0, 0.5), (2, 1.0)):
        assert np.abs(predictions[depth].robot.numpy() - of.state[:, depth + 2]).mean() < most
    strange = of.actions + 20
    assert rollout(learnt.serving, of, strange)[0].uncertainty.mean() > 3 * predictions[0].uncertainty.mean()


@pytest.mark.slow
def test_a_model_of_shuffled_actions_ignores_them():
    _, low = scores(trained(shuffle=True))
    assert 0.8 < low < 1.1


def test_the_weights_that_serve_follow_those_that_learn(learnt: Learner):
    now, mean = learnt.model.state_dict(), learnt.serving.state_dict()
    assert all(torch.equal(now[k], mean[k]) for k in now if "." not in k), "statistics"
    learner = copy.deepcopy(learnt)
    learner.count = 10**6
    learner._average()
    for name, value in learner.serving.named_parameters():
        torch.testing.assert_close(value, 0.99 * mean[name] + 0.01 * now[name])


@pytest.mark.parametrize("channels", [(8, 8, 12), (7,), (10, 14)], ids=["deep", "flat", "odd widths"])
def test_networks_of_other_sizes(channels: tuple[int, ...]):
    torch.manual_seed(0)
    network, side = FrameNetwork(3, 6, 8, 3, channels), 8 * 2 ** (len(channels) - 1)
    given = {"frames": torch.randn(2, 6, side, side), "chunk": torch.randn(2, 8), "state": torch.randn(2, 3)}
    assert not network(**given).any(), "it starts at no change"
    image = awake(network)(**given)
    assert image.shape == (2, 3, side, side) and torch.isfinite(image).all()
    for name, value in given.items():
        assert (awake(network)(**given | {name: value.flip(0)}) - image).abs().max() > 1e-3, name


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
