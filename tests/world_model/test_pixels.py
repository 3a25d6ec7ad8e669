# SPDX-License-Identifier: Apache-2.0
"""The networks on an environment of one dot that goes where it is told, their training and their check."""

import copy
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.errors import NonFiniteError
from accerl_lerobot.experience import task_codes
from accerl_lerobot.world_model.config import PixelModelConfig
from accerl_lerobot.world_model.contract import Episode, Prediction, WindowStart, WorldModelSpec, cut_windows
from accerl_lerobot.world_model.imagined import World
from accerl_lerobot.world_model.pixels import PixelWorldModel
from accerl_lerobot.world_model.pretrain import auroc, check, choose_threshold, skill_and_sensitivity
from accerl_lerobot.world_model.training import Trainer, balanced
from tests.rounding import assert_close

SIZE, K = 16, 2
SPEC = WorldModelSpec(
    cameras=("observation.images.top",), image_size=(SIZE, SIZE), state_dim=2, action_dim=2, chunk=K,
    fps=80,
)  # fmt: skip


def dots(count: int, steps: int = 12, seed: int = 0) -> list[Episode]:
    """A white square of 4×4 pixels on grey, moved by its actions; its state is where it is."""
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        at = rng.uniform(2, SIZE - 6, 2)
        frames, states, actions = [], [], []
        for _ in range(steps):
            frames.append(drawn(at))
            states.append(at.astype(np.float32))
            action = rng.uniform(-2, 2, 2)
            at = np.clip(at + action, 0, SIZE - 4)
            actions.append((action / 2).astype(np.float32))
        seen = {"frames": np.stack(frames), "state": np.stack(states), "actions": np.stack(actions)}
        made.append(Episode(**seen, times=np.arange(steps), success=False, task="go"))
    return made


def drawn(at: np.ndarray) -> np.ndarray:
    """uint8 (1, H, W, 3)."""
    frame = np.full((1, SIZE, SIZE, 3), 60, np.uint8)
    y, x = np.round(at).astype(int)
    frame[:, y : y + 4, x : x + 4] = 220
    return frame


def ending_on_the_right(episodes: list[Episode]) -> list[Episode]:
    """Episodes that end one step after the picture shows the dot on the right."""
    made = []
    for episode in episodes:
        there = np.flatnonzero(episode.state[:, 1].round() > SIZE / 2)
        t = int(there[0]) + 1 if len(there) else len(episode.actions)
        cut = {name: getattr(episode, name)[:t] for name in ("frames", "times", "state", "actions")}
        if t > 2:
            made.append(replace(episode, **cut, success=len(there) > 0))
    return made


def model(channels: tuple[int, ...] = (24, 32)) -> PixelWorldModel:
    torch.manual_seed(0)
    return PixelWorldModel(SPEC, PixelModelConfig(channels=channels))


def windows(episodes: list[Episode], chunks: int = 3) -> Any:
    last = [len(episode.frames) - K * chunks for episode in episodes]
    at = [WindowStart(e, frame) for e, most in zip(episodes, last, strict=True) for frame in range(most)]
    return cut_windows(at, SPEC, chunks)


def rollout(made: PixelWorldModel, of: Any) -> list[Prediction]:
    state, predictions = made.begin(of.context, of.tasks), []
    for chunk in range(of.actions.shape[1]):
        predictions.append(made.step(state, of.actions[:, chunk]))
        state = predictions[-1].state
    return predictions


def awake[M: torch.nn.Module](made: M) -> M:
    """Random where it starts at zero."""
    with torch.no_grad():
        for p in made.parameters():
            if not p.any():
                p.normal_(std=0.1)
    return made


def test_a_new_model_is_a_copy_of_the_last_frame_of_each_camera():
    of = windows(dots(2))
    frames, first = (torch.cat([x, 255 - x], -4) for x in (of.context.frames, of.context.first_frame))
    of = of._replace(context=of.context._replace(frames=frames, first_frame=first))
    made = PixelWorldModel(replace(SPEC, cameras=("a", "b")), PixelModelConfig(channels=(24, 32)))
    for one in rollout(made, of):
        assert torch.equal(one.frames, frames[:, -1])
    probabilities = World(made).success.probabilities(frames[:, -1], of.codes)
    assert probabilities.shape == (len(frames),), "and the success model sees both"


def test_a_rollout_depends_on_its_row_alone():
    of, made = windows(dots(2), chunks=2), awake(model())
    together = rollout(made, of)[0]
    context = of.context._make(tensor[3:4] for tensor in of.context)
    alone = made.step(made.begin(context, of.tasks[3:4]), of.actions[3:4, 0])
    assert (alone.frames.int() - together.frames[3:4].int()).abs().max() <= 1, "rounding"
    assert_close(alone.robot, together.robot[3:4])


def test_a_state_is_not_changed_by_going_on_from_it():
    of, made = windows(dots(1)), awake(model())
    state = made.begin(of.context, of.tasks)
    before = copy.deepcopy(state)
    first = made.step(state, of.actions[:, 0])
    assert all(torch.equal(tensor, state[name]) for name, tensor in before.items())
    assert torch.equal(first.state["frames"][:, 0], state["frames"][:, 1]), "the context rolls"
    assert torch.equal(first.state["frames"][:, 1], first.frames)
    assert torch.equal(first.state["first_frame"], state["first_frame"])
    assert_close(first.state["commanded_sum"], state["commanded_sum"] + of.actions[:, 0].sum(1))


def loss(made: PixelWorldModel, of: Any) -> float:
    torch.manual_seed(0)
    return made.loss(of)[0].item()


def test_neither_actions_that_are_not_executed_nor_chunks_beyond_the_end_are_learnt():
    of, made = windows(dots(2)), awake(model())
    made.fit_statistics(of)
    short, ended, actions, frames = of.steps.clone(), of.steps.clone(), of.actions.clone(), of.frames.clone()
    short[:, 0], actions[:, 0, 1] = 1, 9.0
    ended[1:], frames[1:] = 0, 0
    for steps, change in ((short, {"actions": actions}), (ended, {"frames": frames})):
        cut = of._replace(steps=steps)
        assert loss(made, cut) == pytest.approx(loss(made, cut._replace(**change)))
        assert loss(made, of) != pytest.approx(loss(made, of._replace(**change)))


def test_statistics_by_hand():
    of, made = windows(dots(4)), model()
    made.fit_statistics(of)
    state, motion = of.context.robot[:, -1], of.robot[:, 0] - of.context.robot[:, -1]
    assert_close(made.moving_mean[-4:-2], state.mean(0), largest=float(state.abs().max()))
    assert_close(made.moving_std[-4:-2], state.numpy().std(0))
    assert_close(made.moving_std[: K * 2], of.actions[:, 0].flatten(1).numpy().std(0))
    assert_close(made.motion_std, motion.numpy().std(0))
    off = of.frames[:, 0].double() - of.context.frames[:, -1].double()
    assert float(made.change) == pytest.approx(float((off / 127.5).square().mean().sqrt()), rel=1e-4)


def test_every_chunk_is_predicted_for_the_task_and_the_loss_reaches_every_weight():
    of, made = windows(dots(3)), awake(model())
    one, other = (rollout(made, of._replace(tasks=(task,) * len(of.tasks))) for task in ("left", "right"))
    for first, second in zip(one, other, strict=True):
        assert not torch.equal(first.frames, second.frames) and not torch.equal(first.robot, second.robot)
    made.fit_statistics(of)
    made.loss(of)[0].backward()
    silent = [k for k, p in made.named_parameters() if p.grad is None or not p.grad.abs().max() > 1e-12]
    assert [name for name in silent if not name.endswith("to_k.bias")] == [], "softmax ignores that one"


@pytest.fixture(scope="module")
def learnt() -> Trainer:
    trainer = Trainer(World(model()), dots(60), 3e-3, steps=150)
    trainer.fit_statistics()
    for _ in range(150):
        metrics = trainer.step()
    assert "success" not in metrics, "there are only failures"
    return trainer


def test_it_learns_where_dot_and_robot_go(learnt: Trainer):
    found = skill_and_sensitivity(learnt.serving, dots(12, seed=5))
    assert found["skill"] > 0.5 and found["sensitivity"] > 1.5
    of = windows(dots(12, seed=5))
    predictions = rollout(learnt.serving.model, of)  # type: ignore[arg-type]
    for depth, most in ((0, 0.5), (2, 1.0)):
        assert (predictions[depth].robot - of.robot[:, depth]).abs().mean() < most


def test_a_training_that_diverges_is_an_error_and_changes_nothing(learnt: Trainer):
    trainer = copy.deepcopy(learnt)
    with torch.no_grad():
        trainer.world.model.network.planes.bias.fill_(torch.nan)  # type: ignore[union-attr]
    before = copy.deepcopy(trainer.world.state_dict())
    with pytest.raises(NonFiniteError, match=r"a step of the world model.*lower world_model\.lr"):
        for _ in range(99):
            trainer.step()
    for name, tensor in trainer.world.state_dict().items():
        torch.testing.assert_close(tensor, before[name], equal_nan=True)


def test_the_success_model_learns_how_replayed_episodes_end():
    """Half of its frames show successes, although few do."""
    torch.manual_seed(0)
    trainer = Trainer(World(model(channels=(8, 8))), ending_on_the_right(dots(80, steps=20, seed=1)), 2e-3)
    trainer.fit_statistics()
    for _ in range(60):
        trainer.step()
    batch = balanced(trainer._labelled)  # type: ignore[arg-type]
    assert batch.success.tolist() == [True] * 16 + [False] * 16
    shown = dots(200, seed=7)
    frames = torch.from_numpy(np.stack([episode.frames[-1] for episode in shown]))
    right = np.array([episode.state[-1, 1].round() > SIZE / 2 for episode in shown])
    codes = torch.from_numpy(task_codes(["go"] * 200))
    success = trainer.serving.success
    found = success.probabilities(frames, codes)
    assert auroc(found.numpy(), right) > 0.9
    assert not torch.allclose(found, success.probabilities(frames, -codes)), "it knows the task"


class Deterministic:
    """The dot's own environment: exact, or ignoring actions, or standing still."""

    spec = SPEC

    def __init__(self, kind: str) -> None:
        self.kind = kind

    def begin(self, context: Any, tasks: Any) -> dict[str, Tensor]:
        return {"frames": context.frames[:, -1], "robot": context.robot[:, -1]}

    def step(self, state: dict[str, Tensor], actions: Tensor) -> Prediction:
        robot, frames = state["robot"], state["frames"]
        if self.kind != "still":
            moves = 2 * actions if self.kind == "exact" else torch.full_like(actions, 0.4)
            for k in range(K):
                robot = (robot + moves[:, k]).clamp(0, SIZE - 4)
            frames = torch.from_numpy(np.stack([drawn(at) for at in robot.numpy()]))
        return Prediction(state={"frames": frames, "robot": robot}, frames=frames, robot=robot)


def on_the_right(frames: Tensor, codes: Tensor) -> Tensor:
    x = (frames[:, 0, :, :, 0] > 200).any(1).int().argmax(1)
    return 0.1 + 0.8 * (x > SIZE / 2 + 0.5)


@pytest.mark.parametrize("kind", ["exact", "ignoring", "still"])
def test_models_of_known_quality(kind: str):
    success = SimpleNamespace(probabilities=on_the_right)
    world: Any = SimpleNamespace(model=Deterministic(kind), success=success, device="cpu")
    found = check(world, ending_on_the_right(dots(60, steps=30, seed=2)))
    if kind == "exact":
        assert found["skill"] > 0.99 and found["sensitivity"] > 10 and found["auroc"] > 0.9
        assert found["failed"] == []
    else:
        assert found["sensitivity"] == pytest.approx(1) and found["failed"]
    if kind == "still":
        assert found["skill"] == 0 and found["auroc"] == 0.5, "where nothing moves nothing succeeds"


@pytest.mark.parametrize(
    ("failures", "successes", "expected"),
    [
        ([0.3, 0.2], [0.92], 0.5),  # never below one half
        ([0.95, 0.9, 0.6, 0.2], [0.92], 0.95),  # of four failures none may pass
        ([0.9] + 9 * [0.1], [0.6, 0.95], 0.5),  # of ten failures one may pass
        ([0.9] + 9 * [0.1], [0.92, 0.95], 0.9),  # and need not
        ([], [0.9], 0.5),
    ],
)
def test_the_threshold_by_hand(failures: list[float], successes: list[float], expected: float):
    scores = np.array(failures + successes, np.float32)
    achieved = np.array([False] * len(failures) + [True] * len(successes))
    chosen = choose_threshold(scores, achieved)
    assert chosen == pytest.approx(expected) and (expected == 0.5 or chosen >= np.float32(expected))


def test_auroc_is_the_share_of_pairs_in_order():
    rng = np.random.default_rng(0)
    scores, labels = rng.integers(0, 6, 40).astype(float), rng.random(40) < 0.4
    pairs = [(a > b) + 0.5 * (a == b) for a in scores[labels] for b in scores[~labels]]
    assert auroc(scores, labels) == pytest.approx(np.mean(pairs))
    assert np.isnan(auroc(scores, np.zeros(40, bool)))
