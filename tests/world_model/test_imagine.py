# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.envs import make_world
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import IMAGINED, REAL, Decision, Request, Segment
from accerl_lerobot.world_model import imagine
from accerl_lerobot.world_model.baselines import OracleModel, ShuffledModel
from accerl_lerobot.world_model.contract import Context, Dream, History, State, WorldModel
from accerl_lerobot.world_model.fit import check_fit
from accerl_lerobot.world_model.imagination_config import ImaginationConfig, OnlineLearnConfig
from accerl_lerobot.world_model.imagine import Imagination
from accerl_lerobot.world_model.online import Promotion
from tests.rounding import assert_close
from tests.world_model.lived import SPEC, WORLD, K, decided, lived

WORLD_SPEC = make_world(WORLD).spec
ENDLESS = replace(WORLD_SPEC, max_steps=400)
CAMERA = "observation.images.front"


class Counting(WorldModel):
    """Frames grow brighter by 40 a chunk, as far as the actions say; doubtful where told so."""

    spec = SPEC

    def __init__(self, doubt: float = float("nan")) -> None:
        self.doubt = doubt
        self.seeds: list[list[int]] = []

    def to(self, device: object) -> Counting:
        return self

    def begin(
        self, context: Context, tasks: Sequence[str], histories: Sequence[History | None] | None = None
    ) -> State:
        return {"frames": torch.zeros_like(context.frames[:, -1]), "robot": context.robot[:, -1]}

    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Dream:
        self.seeds.append(list(seeds))
        brighter = (40 * actions[:, 0, 0]).round().byte()[:, None, None, None, None]
        frames = state["frames"] + brighter
        robot = state["robot"] + 1
        doubt = torch.full((len(actions),), self.doubt)
        doubt[1:] = torch.nan
        return Dream(state={"frames": frames, "robot": robot}, frames=frames, robot=robot, uncertainty=doubt)


def brightness(success: object, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    return after.max((1, 2, 3, 4)) / 200


class Bright(torch.nn.Module):
    """Stands where a success model does; from 0.55, three chunks of full action, it is a success."""

    def __init__(self) -> None:
        super().__init__()
        self.out, self.config = torch.nn.Linear(1, 1), SimpleNamespace(threshold=0.55)


@pytest.fixture
def bright(monkeypatch: pytest.MonkeyPatch) -> Any:
    """A success model that looks at how bright it is."""
    monkeypatch.setattr(imagine, "probabilities", brightness)
    return Bright()


def imagination(
    model: WorldModel, success: Any = None, *, fails: bool = True, world: Any = WORLD_SPEC, **config: Any
) -> tuple[Imagination, list[Segment]]:
    kind = "oracle" if isinstance(model, OracleModel) else "learned"
    ended = config.pop("ended", 1)
    fields: dict[str, Any] = {
        "share": 0.5, "path": "x", "dreams": 4, "horizon": 3, "beginnings": 0.0, "model": kind,
        "learn": OnlineLearnConfig(steps_per_episode=0),
    }  # fmt: skip
    made: list[Segment] = []
    dreams = Imagination(
        model, success, world, ImaginationConfig(**(fields | config)),
        decision_cost=0.01, fails=fails, seed=0, name="dream", on_segment=made.append,
        ended=ended,
    )  # fmt: skip
    return dreams, made


def promotion(model: Any, success: Any, version: int) -> Promotion:
    return Promotion(model, success, version, {})


def act(requests: Sequence[Request], size: float = 1.0) -> list[Decision]:
    return [decided(np.full((K, 2), size), value=7.0, version=5) for _ in requests]


def play(dreams: Imagination, rounds: int, size: float = 1.0) -> None:
    for _ in range(rounds):
        dreams.advance(act(dreams.requests(), size))


def test_a_dream_is_a_segment_like_any_other(bright: Any):
    dreams, made = imagination(Counting(), bright, horizon=2, world=ENDLESS)
    [real] = lived(3)
    assert dreams.requests() == [], "nothing to begin from"
    dreams.remember(real)
    dreams.version = 9
    play(dreams, 2)
    assert len(made) == 4 and len({s.key for s in made}) == 4
    for segment in made:
        t = segment.origin.decision
        assert (segment.source, segment.world_version) == (IMAGINED, 9) and segment.origin[:2] == ("match", 3)
        assert segment.task == real.task and real.source == REAL
        assert np.array_equal(segment.observations[CAMERA][0], real.observations[CAMERA][t])
        state = real.observations["observation.state"][t]
        assert np.allclose(segment.observations["observation.state"][0], state)
        assert np.allclose(segment.observations["observation.state"][1], state + 1)
        assert (segment.observations[CAMERA][1] == 40).all()
        assert set(segment.version.tolist()) == {5} and set(segment.steps.tolist()) == {K}
        assert np.array_equal(segment.actions, np.ones((len(segment), K, 2)))


def test_the_reward_is_what_the_probability_of_success_gained(bright: Any):
    dreams, made = imagination(Counting(), bright, horizon=2, keyframes=0.0, reward="potential")
    [real] = lived(3)
    dreams.remember(real)
    play(dreams, 2)
    for segment in made:
        first = real.observations[CAMERA][segment.origin.decision].max() / 200
        gains = np.diff([first, 0.2, 0.4])[: len(segment)] - 0.01
        assert_close(segment.reward, gains, largest=1.0)


def test_a_success_ends_a_dream_and_nothing_follows_it(bright: Any):
    dreams, made = imagination(Counting(), bright, horizon=8, reward="success", dreams=1, world=ENDLESS)
    dreams.remember(lived(3)[0])
    play(dreams, 4)
    assert len(made) == 1 and len(made[0]) == 3
    assert made[0].terminated and made[0].success and not made[0].truncated
    assert made[0].reward == pytest.approx([-0.01, -0.01, 0.99])
    assert dreams.counters.successes == 1 and dreams.metrics()["dreams"] == 1


@pytest.mark.parametrize("fails", [True, False])
def test_a_dream_ends_where_the_world_s_time_does(bright: Any, fails: bool):
    dreams, made = imagination(Counting(), bright, fails=fails, dreams=16)
    dreams.remember(lived(3)[0])  # 4 decisions of 4 steps are all there is time for
    play(dreams, 3, size=0.5)
    by_start = {s.origin.decision: s for s in made}
    assert {t: len(s) for t, s in by_start.items()} == {0: 3, 1: 3, 2: 2, 3: 1}
    assert not by_start[0].terminated and not by_start[0].truncated, "its horizon: V stands for the rest"
    for t in (1, 2, 3):
        assert (by_start[t].terminated, by_start[t].truncated) == (fails, not fails)
        assert not by_start[t].success


def test_what_is_too_uncertain_is_not_kept(bright: Any):
    model = Counting(doubt=1.9)
    dreams, made = imagination(model, bright, dreams=2, doubt=2.0, world=ENDLESS)
    dreams.remember(lived(3)[0])
    play(dreams, 1, 0.1)
    model.doubt = 2.1
    play(dreams, 1, 0.1)
    doubted = [s for s in made if len(s) == 1 and not s.terminated and not s.truncated]
    assert dreams.counters.doubted == 1 and len(doubted) == 1, "what came before stays"
    play(dreams, 1, 0.1)  # the first decision of a new dream is doubted at once
    assert dreams.counters.doubted == 2 and dreams.counters.dreams == len(made) + 1


def test_what_is_no_number_ends_a_dream_and_is_not_kept(bright: Any):
    """A model that diverges says NaN of the robot, which nothing is larger than."""
    model = Counting()
    dreams, made = imagination(model, bright, dreams=2, world=ENDLESS)
    dreams.remember(lived(3)[0])
    play(dreams, 1, 0.1)
    assert dreams._state is not None
    dreams._state["robot"] = dreams._state["robot"] + torch.tensor([[0.0], [torch.nan]])
    play(dreams, 1, 0.1)
    assert dreams.counters.doubted == 1 and [len(s) for s in made] == [1]
    assert np.isfinite(made[0].observations["observation.state"]).all()
    play(dreams, 4, 0.1)
    assert dreams.counters.doubted == 1, "its row has begun anew"


def test_dreams_begin_anew_beside_those_that_go_on():
    oracle = OracleModel(SPEC, lambda: make_world(WORLD), 8)
    dreams, made = imagination(oracle, dreams=8, horizon=3)
    for seed in range(3):
        dreams.remember(lived(seed, solve_at=2)[0])
    rng = np.random.default_rng(0)
    for _ in range(12):
        requests = dreams.requests()
        assert len(requests) == 8 == len({r.noise_seed for r in requests}) and all(
            r.explore for r in requests
        )
        dreams.advance([decided(chunk) for chunk in rng.uniform(-1.2, 1.2, (8, K, 2))])
    assert len(made) > 20 and {len(s) for s in made} >= {1, 2, 3}
    for segment in made:
        # The very same actions after the very same beginning, in the real world.
        world = make_world(WORLD)
        start = segment.origin
        [real] = lived(start.seed, solve_at=2)
        world.reset(start.seed, "match")
        for t in range(start.decision):
            world.step_chunk(real.actions[t])
        assert (np.abs(segment.actions) <= 1).all()
        for t, actions in enumerate(segment.actions):
            result = world.step_chunk(actions)
            assert np.array_equal(segment.observations[CAMERA][t + 1], result.observation[CAMERA])
            state = segment.observations["observation.state"][t + 1]
            assert np.array_equal(state, result.observation["observation.state"])
            assert segment.reward[t] == pytest.approx(float(result.success) - 0.01)
        assert segment.success is result.success


def test_dreams_that_are_too_good_are_switched_off_until_another_model_dreams(bright: Any):
    dreams, _ = imagination(
        Counting(), bright, dreams=4, window=4, witnesses=4, gap=0.5, horizon=4, keyframes=0.0, world=ENDLESS
    )
    for seed in range(8):
        dreams.remember(lived(seed)[0])  # failures, all of them
    rounds = 0
    while dreams.requests():
        play(dreams, 1)
        rounds += 1
        assert rounds < 50
    assert dreams.switch.tripped and dreams.metrics()["on"] == 0 and dreams.metrics()["success"] > 0.5
    dreams.swap(promotion(Counting(), bright, 12))
    assert len(dreams.requests()) == 4 and dreams.version == 12 and dreams.metrics()["on"] == 1


def test_whole_dreams_are_held_against_real_episodes(bright: Any):
    dreams, made = imagination(
        Counting(),
        bright,
        dreams=4,
        window=4,
        witnesses=3,
        gap=0.5,
        horizon=None,
        beginnings=1.0,
        world=ENDLESS,
    )
    for seed in range(4):
        dreams.remember(lived(seed)[0])
    play(dreams, 3)
    assert {(s.origin.decision, len(s), s.success, s.terminated) for s in made} == {(0, 3, True, True)}
    for seed in range(3):
        assert dreams.requests(), "what happened before anything was dreamt does not count"
        dreams.remember(lived(seed)[0])
    assert dreams.switch.shares == (1.0, 0.0) and not dreams.on and not dreams.requests()
    dreams.swap(promotion(Counting(), bright, 12))
    assert dreams.requests()


@pytest.mark.parametrize("fails", [True, False])
def test_a_whole_dream_lasts_as_long_as_the_world_lets_it(bright: Any, fails: bool):
    dreams, made = imagination(Counting(), bright, horizon=None, beginnings=1.0, fails=fails)
    dreams.remember(lived(3)[0])
    play(dreams, 4, size=0.0)
    assert {(len(s), s.terminated, s.truncated, s.success) for s in made} == {(4, fails, not fails, False)}


def test_a_model_that_learns_dreams_once_it_has_passed(bright: Any):
    dreams, _ = imagination(Counting(), bright, learn=OnlineLearnConfig(steps_per_episode=1))
    dreams.remember(lived(3)[0])
    assert dreams.requests() == [] and not dreams.on
    dreams.swap(promotion(Counting(), bright, 3))
    assert dreams.on and len(dreams.requests()) == 4


def test_dreams_under_way_are_dropped_when_another_model_dreams(bright: Any):
    dreams, made = imagination(Counting(), bright, horizon=2, world=ENDLESS)
    dreams.remember(lived(3)[0])
    play(dreams, 1, 0.1)
    dreams.swap(promotion(Counting(), bright, 12))
    play(dreams, 1, 0.1)
    assert not made, "the second decision was the first of new dreams"
    play(dreams, 1, 0.1)
    assert {s.world_version for s in made} == {12} and all(len(s) == 2 for s in made)


def test_a_model_that_doubts_everything_is_not_asked_for_ever(bright: Any):
    model = Counting(doubt=9.0)
    dreams, made = imagination(model, bright, dreams=1, doubt=2.0, window=5, world=ENDLESS)
    dreams.remember(lived(3)[0])
    play(dreams, 5)
    assert dreams.requests() == [] and not dreams.on and not made and dreams.counters.doubted == 5
    dreams.swap(promotion(Counting(), bright, 12))
    assert dreams.on and dreams.requests()


def test_an_episode_that_fails_ends_its_dream(bright: Any, monkeypatch: pytest.MonkeyPatch):
    step = Counting.step

    def broken(self: Any, state: State, actions: Tensor, seeds: Sequence[int]) -> Dream:
        return replace(step(self, state, actions, seeds), done=torch.tensor([True, False]))

    monkeypatch.setattr(Counting, "step", broken)
    dreams, made = imagination(Counting(), bright, dreams=2, world=ENDLESS)
    dreams.remember(lived(3)[0])
    play(dreams, 1, 0.1)
    assert len(made) == 1 and made[0].terminated and not made[0].success


def test_a_placebo_stays_one_when_its_model_is_promoted(bright: Any):
    dreams, _ = imagination(ShuffledModel(Counting()), bright)
    promoted = Counting()
    dreams.swap(promotion(promoted, bright, 3))
    assert isinstance(dreams.dreamer[0], ShuffledModel) and dreams.dreamer[0].model is promoted


def test_pictures_have_the_world_s_size(bright: Any):
    world = replace(WORLD_SPEC, images={CAMERA: (32, 24, 3)})
    dreams, _ = imagination(Counting(), bright, world=world)
    dreams.remember(lived(3)[0])
    [*requests] = dreams.requests()
    assert {np.asarray(r.observation[CAMERA]).shape for r in requests} == {(32, 24, 3)}


@pytest.mark.parametrize(
    ("change", "executed", "history", "judged", "message"),
    [
        ({"cameras": ("observation.images.wrist",)}, K, 1, True, "front.*model observation.images.wrist"),
        ({"state_dim": 7}, K, 1, True, "=7: is the world model's state_dim, and the world's is 4"),
        ({"action_dim": 7}, K, 1, True, "action_dim"),
        ({"fps": 30}, K, 1, True, "imagination.path=30: is the world model's fps"),
        ({}, 5, 1, True, "executes 5 actions per decision; learn one with world_model.chunk=5"),
        ({}, K, 2, True, "policy.n_obs_steps=2: the policy looks back"),
        ({}, K, 1, False, "no success model beside the world model"),
        ({"provides": frozenset({"pixels"})}, K, 1, True, "'state': the policy reads it"),
    ],
)  # fmt: skip
def test_a_world_model_of_something_else_is_refused(
    change: dict[str, Any], executed: int, history: int, judged: bool, message: str
):
    check_fit(SPEC, WORLD_SPEC, K, 1, True)
    with pytest.raises(InputError, match=message):
        check_fit(replace(SPEC, **change), WORLD_SPEC, executed, history, judged)


def test_a_world_model_of_another_task_is_refused():
    known = (*WORLD_SPEC.tasks, "another")
    check_fit(replace(SPEC, tasks=known), WORLD_SPEC, K, 1, True)
    message = f"^env.task='unheard of': the world model is of {', '.join(known)}; name these, or"
    with pytest.raises(InputError, match=message):
        tasks = (*WORLD_SPEC.tasks, "unheard of")
        check_fit(replace(SPEC, tasks=known), replace(WORLD_SPEC, tasks=tasks), K, 1, True)


@pytest.mark.parametrize(
    ("known", "played", "fits"),
    [
        ("suite/3", "suite", True), ("suite", "suite/3", True), ("suite/3", "suite/3", True),
        ("suite/3", "suite/4", False), ("suite/3", "suit", False), ("suit/3", "suite", False),
    ],
)  # fmt: skip
def test_a_task_that_is_played_alone_bears_the_name_of_its_suite(known: str, played: str, fits: bool):
    spec, world = replace(SPEC, tasks=(known,)), replace(WORLD_SPEC, tasks=(played,))
    with contextlib.nullcontext() if fits else pytest.raises(InputError, match="^env.task="):
        check_fit(spec, world, K, 1, True)


def test_one_that_tells_successes_needs_no_success_model():
    check_fit(replace(SPEC, provides=SPEC.provides | {"success"}), WORLD_SPEC, K, 1, False)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("share", 1.0), ("share", -0.1), ("model", "magic"), ("reward", "magic"), ("dreams", 0),
        ("horizon", 0), ("memory", 0), ("window", 0), ("doubt", 0.0), ("gap", 0.0), ("keyframes", 1.1),
    ],
)  # fmt: skip
def test_bad_values_name_their_field(name: str, value: object):
    with pytest.raises(InputError, match=f"^imagination.{name}="):
        ImaginationConfig(**{"path": "x", name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("steps_per_episode", -1.0), ("batch", 1), ("try_every", 0), ("memory", 1), ("offline", 1.1),
        ("recent", -0.1), ("failures", 2.0), ("held_out", 0.0), ("lr", 0.0),
    ],
)  # fmt: skip
def test_bad_values_of_learning_name_their_field(name: str, value: float):
    with pytest.raises(InputError, match=f"^imagination.learn.{name}="):
        OnlineLearnConfig(**{name: value})  # type: ignore[arg-type]


def test_what_does_not_go_together():
    with pytest.raises(InputError, match="^imagination.path=None"):
        ImaginationConfig(share=0.5)
    ImaginationConfig(share=0.5, model="oracle")
    assert ImaginationConfig(share=0.5, path="x").learns
    assert not ImaginationConfig(share=0.5, path="x", model="copy").learns
    assert not ImaginationConfig(path="x").learns
