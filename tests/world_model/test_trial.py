# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Trials: models whose worth is known must get the numbers they deserve."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.config import SuccessLearnConfig, TrialConfig
from accerl_lerobot.world_model.contract import Dream, State, WorldModel
from accerl_lerobot.world_model.episodes import Episode
from accerl_lerobot.world_model.success import SuccessLearner, new_success_model
from accerl_lerobot.world_model.trial import dream, trial_windows, try_out, wrong_actions
from tests.world_model.test_pixels import SIZE, SPEC, K, dots

CONFIG = TrialConfig(depth=3, every=2)


class Deterministic(WorldModel):
    """The dot's own world: exact, or not listening, or standing still."""

    def __init__(self, kind: str) -> None:
        self.spec, self.kind = SPEC, kind
        self.calls: list[int] = []

    def begin(self, frames: Tensor, robot: Tensor, tasks: Sequence[str]) -> State:
        assert len(tasks) == len(frames)
        return {"frames": frames[:, -1], "robot": robot}

    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Dream:
        assert len(set(seeds)) == len(actions)
        self.calls.append(len(actions))
        if self.kind == "copy":
            moved, frames = state["robot"], state["frames"]
        else:
            made = 2 * actions if self.kind == "exact" else torch.full_like(actions, 0.4)
            at = state["robot"]
            for k in range(K):
                at = (at + made[:, k]).clamp(0, SIZE - 4)
            moved, frames = at, torch.stack([drawn(x) for x in at])
        doubt = torch.zeros(len(actions))
        return Dream(state={"frames": frames, "robot": moved}, frames=frames, robot=moved, uncertainty=doubt)


def drawn(at: Tensor) -> Tensor:
    frame = torch.full((1, SIZE, SIZE, 3), 60, dtype=torch.uint8)
    y, x = (int(v) for v in at.round())
    frame[:, y : y + 4, x : x + 4] = 220
    return frame


def with_successes(episodes: list[Episode]) -> list[Episode]:
    """An episode ends when the dot reaches the right; the picture shows it by then."""
    made = []
    for episode in episodes:
        there = np.flatnonzero(episode.state[:, 1] > SIZE / 2)
        if not len(there):
            made.append(episode)
        if not len(there) or there[0] < 2:
            continue
        t = int(there[0]) + 1
        made.append(
            replace(
                episode,
                frames=episode.frames[:t],
                times=episode.times[:t],
                state=episode.state[:t],
                actions=episode.actions[:t],
                success_at=t - 1,
            )  # fmt: skip
        )
    return made


def test_the_exact_world_passes():
    found = try_out(Deterministic("exact"), dots(12, seed=3), CONFIG)
    assert found["passed"] and found["trials"] == 12 * 6
    for depth, row in enumerate(found["depths"]):
        assert row["depth"] == depth + 1 and row["trials"] == 12 * (5 - depth)
        assert row["skill_changed"]["value"] > 0.99 and row["state_error"] < 1e-4 < row["state_error_copy"]
        assert row["sensitivity_shuffled"]["low"] > 10 and row["psnr"] > 40
        assert min(row[f"sensitivity_{arm}"]["value"] for arm in ("zero", "opposite")) > 10
    assert set(found["gates"]) == {"skill_changed_first", "skill_changed_last", "sensitivity_low"}


def test_a_copy_of_the_last_frame_fails():
    found = try_out(Deterministic("copy"), dots(12, seed=3), CONFIG)
    assert not found["passed"] and not any(gate["holds"] for gate in found["gates"].values())
    assert [row["skill"]["value"] for row in found["depths"]] == [0, 0, 0]
    assert found["depths"][0]["sensitivity_shuffled"]["value"] == 1


def test_a_world_that_does_not_listen_fails_by_its_sensitivity():
    gates = try_out(Deterministic("deaf"), dots(12, seed=3), CONFIG)["gates"]
    assert gates["sensitivity_low"] == {"value": 1.0, "above": 1.2, "holds": False}


def test_trials_are_the_same_for_the_same_seed_and_batched():
    episodes = dots(30, seed=3)
    model = Deterministic("exact")
    windows = trial_windows(episodes, model, replace(CONFIG, most=100), seed=1)
    assert len(windows) == 100 and len(np.unique(windows.episode)) > 20
    again = trial_windows(episodes, model, replace(CONFIG, most=100), seed=1)
    assert np.array_equal(windows.frames, again.frames)
    other = trial_windows(episodes, model, replace(CONFIG, most=100), seed=2)
    assert not np.array_equal(windows.frames, other.frames)
    dreams = dream(model, windows, windows.actions)
    assert model.calls == [64] * 3 + [36] * 3
    assert dreams.frames.shape == (100, 3, 1, SIZE, SIZE, 3) and dreams.uncertainty.shape == (100, 3)


def test_wrong_actions_are_wrong():
    windows = trial_windows(dots(6, seed=3), Deterministic("exact"), CONFIG, seed=0)
    rng = np.random.default_rng(0)
    assert wrong_actions(windows, "true", rng) is windows.actions
    assert not wrong_actions(windows, "zero", rng).any()
    assert np.array_equal(wrong_actions(windows, "opposite", rng), -windows.actions)
    shuffled = wrong_actions(windows, "shuffled", rng)
    for i in range(len(windows)):
        from_ = [j for j in range(len(windows)) if np.array_equal(shuffled[i], windows.actions[j])]
        assert from_ and all(windows.episode[j] != windows.episode[i] for j in from_)


def test_the_success_model_is_judged_on_what_was_dreamt():
    learn, held = with_successes(dots(120, seed=1)), with_successes(dots(120, seed=2))
    assert sum(e.success for e in held) > 10
    torch.manual_seed(0)
    success = new_success_model(K)
    learner = SuccessLearner(success, SuccessLearnConfig(steps=1, batch=32, lr=2e-3, dreamt=0.3), seed=0)
    world = Deterministic("exact")
    for _ in range(120):
        metrics = learner.step(learn, world)
    assert set(metrics) == {"loss", "accuracy", "progress"}
    success.eval()
    config = replace(CONFIG, every=1, most=5000, auroc=0.8)
    exact = try_out(world, held, config, success)
    assert exact["passed"] and exact["gates"]["auroc_last"]["value"] > 0.8
    first = exact["depths"][0]
    assert first["successes"] > 10 < first["failures"] and first["auroc_real"] > 0.85
    still = try_out(Deterministic("copy"), held, config, success)
    assert still["depths"][0]["auroc_real"] == first["auroc_real"]
    last = [found["depths"][-1]["auroc_dreamt"] for found in (still, exact)]
    assert last[0] < last[1] - 0.1, "nothing happened in its dreams"


def test_success_learning_needs_both_kinds():
    learner = SuccessLearner(new_success_model(K), SuccessLearnConfig(steps=1), seed=0)
    with pytest.raises(ValueError, match="0 chunks that achieve the task"):
        learner.step(dots(3), Deterministic("exact"))


def test_half_of_a_batch_are_successes():
    learner = SuccessLearner(new_success_model(K), SuccessLearnConfig(steps=1, batch=10), seed=0)
    episodes = with_successes(dots(20, seed=1))
    drawn_ = learner._draw(episodes, K)
    hits = [
        episodes[p.episode].success_at - K < p.frame <= episodes[p.episode].success_at
        and episodes[p.episode].success
        for p in drawn_
    ]
    assert hits == [True] * 5 + [False] * 5


@pytest.mark.parametrize("name", ["depth", "every", "most"])
def test_bad_values_name_their_field(name: str):
    with pytest.raises(InputError, match=f"^world_model.trial.{name}=0"):
        TrialConfig(**{name: 0})
