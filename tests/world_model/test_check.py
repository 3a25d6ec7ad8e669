# SPDX-License-Identifier: Apache-2.0
"""The check: models whose quality is known must get the numbers they deserve; its statistics by hand."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.world_model import pretrain
from accerl_lerobot.world_model.contract import Context, LearnableWorldModel, Prediction, State
from accerl_lerobot.world_model.pretrain import auroc, check, choose_threshold, donors
from tests.world_model.test_pixels import SIZE, SPEC, K, dots, drawn, ending_on_the_right


class Deterministic(LearnableWorldModel):
    """The dot's own environment: exact, or ignoring actions, or standing still."""

    def __init__(self, kind: str) -> None:
        super().__init__(SPEC, None)  # type: ignore[arg-type]
        self.kind = kind

    def begin(self, context: Context, tasks: Sequence[str]) -> State:
        return {"frames": context.frames[:, -1], "robot": context.robot[:, -1]}

    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Prediction:
        assert len(set(seeds)) == len(actions)
        robot, frames = state["robot"], state["frames"]
        if self.kind != "still":
            moves = 2 * actions if self.kind == "exact" else torch.full_like(actions, 0.4)
            for k in range(K):
                robot = (robot + moves[:, k]).clamp(0, SIZE - 4)
            frames = torch.from_numpy(np.stack([drawn(at) for at in robot.numpy()]))
        return Prediction(state={"frames": frames, "robot": robot}, frames=frames, robot=robot)

    def fit_statistics(self, windows: Any) -> None:
        """It has none."""

    def loss(self, windows: Any, generator: torch.Generator) -> Any:
        """It does not learn."""


class OnTheRight:
    """A perfect success model of the dot."""

    def probabilities(self, frames: Tensor, tasks: Tensor) -> Tensor:
        x = (frames[:, 0, :, :, 0] > 200).any(1).int().argmax(1)
        return 0.1 + 0.8 * (x > SIZE / 2 + 0.5)


def world(kind: str) -> Any:
    return SimpleNamespace(model=Deterministic(kind), success=OnTheRight())


@pytest.mark.parametrize("kind", ["exact", "ignoring", "still"])
def test_models_of_known_quality(kind: str):
    found = check(world(kind), ending_on_the_right(dots(60, steps=30, seed=2)))
    values = {name: outcome["value"] for name, outcome in found["checks"].items()}
    assert found["passed"] is (kind == "exact")
    if kind == "exact":
        assert values["skill"] > 0.99 and values["sensitivity"] > 10 and values["auroc"] > 0.9
    else:
        assert values["sensitivity"] == pytest.approx(1)
    if kind == "still":
        assert values["skill"] == 0 and values["auroc"] == 0.5, "where nothing moves nothing succeeds"


def test_replays_are_of_all_parts_of_a_merged_dataset(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(pretrain, "MOST_REPLAYS", 12)
    episodes = ending_on_the_right(dots(60, steps=30, seed=2))
    sorted_by_outcome = sorted(episodes, key=lambda episode: episode.success)
    assert not any(episode.success for episode in sorted_by_outcome[:12])
    assert check(world("exact"), sorted_by_outcome)["checks"]["auroc"]["holds"]


def test_actions_are_another_episode_s():
    episode = torch.tensor([2, 0, 0, 1, 2, 0, 3, 3])
    chosen = donors(episode)
    assert sorted(chosen.tolist()) == list(range(8)) and (episode[chosen] != episode).all()
    assert donors(torch.tensor([0])).tolist() == [0]


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
