# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.engine.imagination import check_fit
from accerl_lerobot.envs import make_environment
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import IMAGINED, REAL, Decision, Request, Segment
from accerl_lerobot.world_model.config import ImaginationConfig, OnlineLearnConfig
from accerl_lerobot.world_model.contract import Context, Prediction, Reset, State, WorldModel
from accerl_lerobot.world_model.online import Promotion
from accerl_lerobot.world_model.reference import OracleModel, ShuffledModel
from accerl_lerobot.world_model.rollouts import Imagination, KillSwitch
from tests.runs import adjusted
from tests.world_model.real_segments import SPEC, WORLD, K, decided, real_episode

WORLD_SPEC = make_environment(WORLD).spec
ENDLESS, SHORT = (replace(WORLD_SPEC, max_steps=steps) for steps in (400, 2 * K))
CAMERA = "observation.images.front"


class Counting(WorldModel):
    """Frames grow brighter by 40 a chunk, as far as the actions say; doubtful where told so."""

    spec = SPEC

    def __init__(self, uncertainty: float = float("nan")) -> None:
        self.uncertainty = uncertainty
        self.seeds: list[list[int]] = []

    def to(self, device: object) -> Counting:
        return self

    def begin(self, context: Context, tasks: Sequence[str], resets: Sequence[Reset] | None = None) -> State:
        return {"frames": torch.zeros_like(context.frames[:, -1]), "robot": context.robot[:, -1]}

    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Prediction:
        self.seeds.append(list(seeds))
        brighter = (40 * actions[:, 0, 0]).round().byte()[:, None, None, None, None]
        frames = state["frames"] + brighter
        robot = state["robot"] + 1
        doubt = torch.full((len(actions),), self.uncertainty)
        doubt[1:] = torch.nan
        return Prediction(
            state={"frames": frames, "robot": robot}, frames=frames, robot=robot, uncertainty=doubt
        )


class Bright(torch.nn.Module):
    """A success model that looks at how bright it is: from 0.55, three chunks of full action, it succeeds."""

    def __init__(self) -> None:
        super().__init__()
        self.out, self.config = torch.nn.Linear(1, 1), SimpleNamespace(threshold=0.55)

    def probabilities(self, before: np.ndarray, after: np.ndarray, task: np.ndarray) -> np.ndarray:
        return after.max((1, 2, 3, 4)) / 200


@pytest.fixture
def bright() -> Any:
    return Bright()


CONSTANTS = ("rollouts", "window", "min_real_episodes", "max_gap", "max_uncertainty")


def imagination(
    model: WorldModel, success: Any = None, *, environment: Any = WORLD_SPEC, **config: Any
) -> tuple[Imagination, list[Segment]]:
    kind = "oracle" if isinstance(model, OracleModel) else "learned"
    fields: dict[str, Any] = {
        "share": 0.5, "path": "x", "model": kind,
        "learn": OnlineLearnConfig(steps_per_episode=0),
    }  # fmt: skip
    constants = {"rollouts": 4} | {name: config.pop(name) for name in CONSTANTS if name in config}
    made: list[Segment] = []
    given = adjusted(ImaginationConfig, **constants)(**(fields | config))
    settings: dict[str, Any] = {"decision_cost": 0.01, "seed": 0}
    batch = Imagination(model, success, environment, given, made.append, **settings)
    return batch, made


def promotion(model: Any, success: Any, version: int) -> Promotion:
    return Promotion(model, success, version, {})


def act(requests: Sequence[Request], size: float = 1.0) -> list[Decision]:
    return [decided(np.full((K, 2), size), version=5) for _ in requests]


def play(batch: Imagination, rounds: int, size: float = 1.0) -> None:
    for _ in range(rounds):
        batch.advance(act(batch.requests(), size))


def test_a_rollout_is_a_segment_like_any_other(bright: Any):
    batch, made = imagination(Counting(), bright, environment=ENDLESS)
    [real] = real_episode(3)
    assert batch.requests() == [], "nothing to begin from"
    batch.remember(real)
    batch.version = 9
    play(batch, 3)
    assert len(made) == 4 and len({s.key for s in made}) == 4
    for segment in made:
        assert segment.origin.decision == 0
        assert (segment.source, segment.world_version) == (IMAGINED, 9) and segment.origin[:2] == ("match", 3)
        assert segment.task == real.task and real.source == REAL
        assert np.array_equal(segment.observations[CAMERA][0], real.observations[CAMERA][0])
        state = real.observations["observation.state"][0]
        assert np.allclose(segment.observations["observation.state"][0], state)
        assert np.allclose(segment.observations["observation.state"][1], state + 1)
        assert (segment.observations[CAMERA][1] == 40).all()
        assert set(segment.version.tolist()) == {5} and set(segment.steps.tolist()) == {K}
        assert np.array_equal(segment.actions, np.ones((len(segment), K, 2)))


def test_a_success_ends_a_rollout_and_nothing_follows_it(bright: Any):
    batch, made = imagination(Counting(), bright, rollouts=1, environment=ENDLESS)
    batch.remember(real_episode(3)[0])
    play(batch, 4)
    assert len(made) == 1 and len(made[0]) == 3
    assert made[0].terminated and made[0].success
    assert made[0].reward == pytest.approx([-0.01, -0.01, 0.99])
    assert batch.counters["successes"] == 1 and batch.metrics()["rollouts"] == 1


def test_a_rollout_ends_at_the_time_limit(bright: Any):
    batch, made = imagination(Counting(), bright, rollouts=16)
    batch.remember(real_episode(3)[0])  # 4 decisions of 4 steps are all there is time for
    play(batch, 4, size=0.5)
    assert {(s.origin.decision, len(s)) for s in made} == {(0, 4)}
    assert all(segment.terminated and not segment.success for segment in made)


def test_what_is_too_uncertain_is_not_kept(bright: Any):
    model = Counting(uncertainty=1.9)
    batch, made = imagination(model, bright, rollouts=2, max_uncertainty=2.0, environment=ENDLESS)
    batch.remember(real_episode(3)[0])
    play(batch, 1, 0.1)
    model.uncertainty = 2.1
    play(batch, 1, 0.1)
    doubted = [s for s in made if len(s) == 1 and not s.terminated]
    assert batch.counters["uncertain"] == 1 and len(doubted) == 1, "what came before stays"
    play(batch, 1, 0.1)  # the first decision of a new rollout is doubted at once
    assert batch.counters["uncertain"] == 2 and batch.counters["rollouts"] == len(made) + 1


def test_what_is_no_number_ends_a_rollout_and_is_not_kept(bright: Any):
    """A model that diverges says NaN of the robot, which nothing is larger than."""
    model = Counting()
    batch, made = imagination(model, bright, rollouts=2, environment=ENDLESS)
    batch.remember(real_episode(3)[0])
    play(batch, 1, 0.1)
    assert batch._state is not None
    batch._state["robot"] = batch._state["robot"] + torch.tensor([[0.0], [torch.nan]])
    play(batch, 1, 0.1)
    assert batch.counters["uncertain"] == 1 and [len(s) for s in made] == [1]
    assert np.isfinite(made[0].observations["observation.state"]).all()
    play(batch, 4, 0.1)
    assert batch.counters["uncertain"] == 1, "its row has begun anew"


def test_ended_rollouts_start_anew_beside_the_others():
    oracle = OracleModel(WORLD_SPEC, K, lambda: make_environment(WORLD))
    batch, made = imagination(oracle, rollouts=8)
    for seed in range(3):
        batch.remember(real_episode(seed, solve_at=2)[0])
    rng = np.random.default_rng(0)
    for _ in range(12):
        requests = batch.requests()
        assert len(requests) == 8 == len({r.noise_seed for r in requests}) and all(
            r.explore for r in requests
        )
        batch.advance([decided(chunk) for chunk in rng.uniform(-1.2, 1.2, (8, K, 2))])
    assert len(made) > 20 and {len(s) for s in made} == {3, 4}
    for segment in made:
        # The very same actions after the very same beginning, in the real environment.
        environment = make_environment(WORLD)
        environment.reset(segment.origin.seed, "match")
        assert (np.abs(segment.actions) <= 1).all()
        for t, actions in enumerate(segment.actions):
            result = environment.step_chunk(actions)
            assert np.array_equal(segment.observations[CAMERA][t + 1], result.observation[CAMERA])
            state = segment.observations["observation.state"][t + 1]
            assert np.array_equal(state, result.observation["observation.state"])
            assert segment.reward[t] == pytest.approx(float(result.success) - 0.01)
        assert segment.success is result.success


def test_rollouts_from_resets_are_compared_with_real_episodes(bright: Any):
    batch, made = imagination(
        Counting(), bright, rollouts=4, window=4, min_real_episodes=3, environment=ENDLESS
    )
    for seed in range(4):
        batch.remember(real_episode(seed)[0])
    play(batch, 3)
    assert {(s.origin.decision, len(s), s.success, s.terminated) for s in made} == {(0, 3, True, True)}
    for seed in range(3):
        assert batch.requests(), "what happened before anything was imagined does not count"
        batch.remember(real_episode(seed)[0])
    assert batch.switch.shares == (1.0, 0.0) and not batch.on and not batch.requests()
    batch.swap(promotion(Counting(), bright, 12))
    assert batch.requests()


def test_a_model_that_is_trained_is_used_once_it_has_passed(bright: Any):
    batch, _ = imagination(Counting(), bright, learn=OnlineLearnConfig(steps_per_episode=1))
    batch.remember(real_episode(3)[0])
    assert batch.requests() == [] and not batch.on
    batch.swap(promotion(Counting(), bright, 3))
    assert batch.on and len(batch.requests()) == 4


def test_unfinished_rollouts_are_dropped_when_a_model_is_promoted(bright: Any):
    batch, made = imagination(Counting(), bright, environment=SHORT)
    batch.remember(real_episode(3)[0])
    play(batch, 1, 0.1)
    batch.swap(promotion(Counting(), bright, 12))
    play(batch, 1, 0.1)
    assert not made, "the second decision was the first of new batch"
    play(batch, 1, 0.1)
    assert {s.world_version for s in made} == {12} and all(len(s) == 2 for s in made)


def test_a_model_that_is_uncertain_of_everything_is_switched_off(bright: Any):
    model = Counting(uncertainty=9.0)
    batch, made = imagination(model, bright, rollouts=1, max_uncertainty=2.0, window=5, environment=ENDLESS)
    batch.remember(real_episode(3)[0])
    play(batch, 5)
    assert batch.requests() == [] and not batch.on and not made and batch.counters["uncertain"] == 5
    batch.swap(promotion(Counting(), bright, 12))
    assert batch.on and batch.requests()


def test_an_episode_that_fails_ends_its_rollout(bright: Any, monkeypatch: pytest.MonkeyPatch):
    step = Counting.step

    def broken(self: Any, state: State, actions: Tensor, seeds: Sequence[int]) -> Prediction:
        return replace(step(self, state, actions, seeds), done=torch.tensor([True, False]))

    monkeypatch.setattr(Counting, "step", broken)
    batch, made = imagination(Counting(), bright, rollouts=2, environment=ENDLESS)
    batch.remember(real_episode(3)[0])
    play(batch, 1, 0.1)
    assert len(made) == 1 and made[0].terminated and not made[0].success


def test_a_placebo_stays_one_when_its_model_is_promoted(bright: Any):
    batch, _ = imagination(ShuffledModel(Counting()), bright)
    promoted = Counting()
    batch.swap(promotion(promoted, bright, 3))
    assert isinstance(batch._model, ShuffledModel) and batch._model.model is promoted


def test_pictures_have_the_world_s_size(bright: Any):
    environment = replace(WORLD_SPEC, images={CAMERA: (32, 24, 3)})
    batch, _ = imagination(Counting(), bright, environment=environment)
    batch.remember(real_episode(3)[0])
    [*requests] = batch.requests()
    assert {np.asarray(r.observation[CAMERA]).shape for r in requests} == {(32, 24, 3)}


@pytest.mark.parametrize(
    ("change", "executed", "message"),
    [
        ({"cameras": ("observation.images.wrist",)}, K, "front.*the world model .*images.wrist"),
        ({"state_dim": 7}, K, "=7: is the world model's state_dim, and the environment's is 4"),
        ({"action_dim": 7}, K, "action_dim"),
        ({"fps": 30}, K, "imagination.path=30: is the world model's fps"),
        ({}, 5, "executes 5 actions per decision; train one with world_model.chunk=5"),
    ],
)
def test_a_world_model_of_something_else_is_refused(change: dict[str, Any], executed: int, message: str):
    check_fit(SPEC, WORLD_SPEC, K)
    with pytest.raises(InputError, match=message):
        check_fit(replace(SPEC, **change), WORLD_SPEC, executed)


@pytest.mark.parametrize(
    ("known", "played", "fits"),
    [
        ("suite/3", "suite", True),
        ("suite", "suite/3", True),
        ("suite/3", "suite/4", False),
        ("suite/3", "suit", False),
        ("match", "match", True),
    ],
)
def test_a_task_that_is_played_alone_bears_the_name_of_its_suite(known: str, played: str, fits: bool):
    spec, environment = replace(SPEC, tasks=(known,)), replace(WORLD_SPEC, tasks=(played,))
    with contextlib.nullcontext() if fits else pytest.raises(InputError, match="^env.task="):
        check_fit(spec, environment, K)


def test_what_does_not_go_together():
    with pytest.raises(InputError, match="^imagination.path=None"):
        ImaginationConfig(share=0.5)
    ImaginationConfig(share=0.5, model="oracle")
    assert ImaginationConfig(share=0.5, path="x").learns
    assert not ImaginationConfig(share=0.5, path="x", learn=OnlineLearnConfig(steps_per_episode=0)).learns
    assert not ImaginationConfig(path="x").learns


def told(switch: KillSwitch, imagined: Sequence[int] = (), real: Sequence[int] = ()) -> KillSwitch:
    for outcome in imagined:
        switch.add_imagined(bool(outcome))
    for outcome in real:
        switch.add_real(bool(outcome))
    return switch


def test_rollouts_that_succeed_too_often_trip_it():
    switch = KillSwitch(max_gap=0.3, window=4, min_real=5)
    assert math.isnan(switch.share) and all(math.isnan(share) for share in switch.shares)
    assert told(switch, [1, 0, 1, 0]).share == 0.5
    assert not told(switch, real=[0] * 4).tripped, "not before there are so many real outcomes"
    assert told(switch, real=[0]).shares == (0.5, 0.0) and switch.tripped
    switch.reset()
    assert not switch.tripped and math.isnan(switch.share) and all(math.isnan(x) for x in switch.shares)


def test_it_waits_for_the_window_and_for_more_than_the_gap():
    switch = told(KillSwitch(max_gap=0.5, window=4, min_real=2), [1, 1, 1], real=[0] * 5)
    assert math.isnan(switch.shares[0]) and not switch.tripped
    assert told(switch, [1], real=[0, 1]).shares == (1.0, 0.5) and not switch.tripped
    assert told(switch, real=[0, 0]).tripped
    better = told(KillSwitch(max_gap=0.1, window=1, min_real=1), [0], real=[1])
    assert not better.tripped, "reality may be as good as it likes"


def test_promotions_do_not_make_it_forget():
    """Else a model that flatters would not be found out where its successors come before enough outcomes."""
    switch = KillSwitch(max_gap=0.3, window=2, min_real=6)
    for _ in range(2):
        assert not told(switch, [1, 1], real=[0, 0]).tripped
        switch.reset()
    assert told(switch, [1, 1], real=[0, 0]).tripped


def test_a_policy_that_learns_is_not_taken_for_a_world_model_that_flatters():
    """Reality is held against what was imagined when it happened, not against what is imagined now."""
    switch = KillSwitch(max_gap=0.3, window=2, min_real=4)
    for outcome in (0, 0, 1, 1):
        told(switch, [outcome] * 2, real=[outcome])
    assert switch.share == 1.0 and switch.shares == (0.5, 0.5) and not switch.tripped
