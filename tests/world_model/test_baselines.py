# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

import numpy as np
import pytest
import torch

from accerl_lerobot.envs import SimulatedWorld, World, make_world
from accerl_lerobot.world_model.baselines import CopyModel, OracleModel, ShuffledModel
from accerl_lerobot.world_model.contract import Context, State, WorldModel
from accerl_lerobot.world_model.frames import seen
from accerl_lerobot.world_model.starts import Start, StartPool
from tests.world_model.lived import SPEC, WORLD, lived


def begun(model: WorldModel, starts: list[Start]) -> State:
    parts = [np.stack([getattr(s, part) for s in starts]) for part in Context._fields]
    return model.begin(
        Context(*(torch.from_numpy(part) for part in parts)),
        [s.task for s in starts],
        [s.history for s in starts],
    )


def starts_of(*seeds: int, solve_at: int = 99) -> tuple[list[Start], dict[int, object]]:
    pool = StartPool(SPEC, memory=1000, horizon=2, beginnings=0.0, keyframes=0.0)
    segments = {seed: lived(seed, solve_at=solve_at)[0] for seed in seeds}
    for segment in segments.values():
        pool.add(segment)
    return pool.draw(12, np.random.default_rng(0)), segments  # type: ignore[return-value]


@pytest.mark.parametrize("simulators", [1, 3, 12])
def test_the_oracle_lives_through_what_happened(simulators: int):
    made: list[World] = []

    def make() -> World:
        made.append(make_world(WORLD))
        return made[-1]

    oracle = OracleModel(SPEC, make, simulators)
    assert oracle.spec.provides == {"pixels", "state", "success"}
    starts, segments = starts_of(1, 2, solve_at=2)
    state = begun(oracle, starts)
    for depth in range(2):
        at = [s.origin.decision + depth for s in starts]
        of = [segments[s.origin.seed] for s in starts]
        rows = [i for i in range(len(starts)) if at[i] < len(of[i])]  # until the episode had ended
        starts = [starts[i] for i in rows]
        state = {k: v[rows] for k, v in state.items()}
        actions = np.stack([of[i].actions[at[i]] for i in rows])
        dream = oracle.step(state, torch.from_numpy(actions), list(range(len(rows))))
        for n, i in enumerate(rows):
            frames, robot = seen(of[i].observations, SPEC)
            assert np.array_equal(dream.frames[n].numpy(), frames[at[i] + 1])
            assert np.array_equal(dream.robot[n].numpy(), robot[at[i] + 1])
            assert bool(dream.success[n]) is (at[i] + 1 == len(of[i]) and of[i].success)
        state = dream.state
    assert 1 <= len(made) <= simulators
    oracle.close()


def test_a_simulator_that_is_there_goes_on(monkeypatch: pytest.MonkeyPatch):
    resets: list[int] = []
    reset = SimulatedWorld.reset
    monkeypatch.setattr(SimulatedWorld, "reset", lambda *a: resets.append(1) or reset(*a))
    oracle = OracleModel(SPEC, lambda: make_world(WORLD), 4)
    starts, _ = starts_of(1)
    start = next(s for s in starts if s.origin.decision == 0)
    resets.clear()
    state = begun(oracle, [start])
    actions = torch.zeros(1, 4, 2)
    first = oracle.step(state, actions, [0])
    oracle.step(first.state, actions, [0])
    assert len(resets) == 1
    again = oracle.step(state, actions, [0])  # the state of before is still good
    assert len(resets) == 2 and torch.equal(again.frames, first.frames)


def test_an_oracle_must_know_what_led_to_a_start():
    starts, _ = starts_of(1)
    oracle = OracleModel(SPEC, lambda: make_world(WORLD), 1)
    with pytest.raises(ValueError, match="history of every start"):
        oracle.begin(Context(*torch.zeros(5, 1)), ["go"], [None])


def test_a_copy_shows_the_last_frame_for_ever():
    starts, _ = starts_of(1, 2)
    copy = CopyModel(SPEC)
    state = begun(copy, starts)
    for _ in range(2):
        dream = copy.step(state, torch.randn(12, 4, 2), [0] * 12)
        assert np.array_equal(dream.frames.numpy(), np.stack([s.frames[-1] for s in starts]))
        assert np.array_equal(dream.robot.numpy(), np.stack([s.robot[-1] for s in starts]))
        assert dream.uncertainty.isnan().all() and dream.success is None
        state = dream.state


def test_shuffled_actions_are_the_next_dream_s():
    starts, _ = starts_of(1, 2)
    oracle = OracleModel(SPEC, lambda: make_world(WORLD), 12)
    shuffled = ShuffledModel(oracle)
    actions = torch.rand(12, 4, 2) / 5
    got = shuffled.step(begun(shuffled, starts), actions, [0] * 12)
    wanted = oracle.step(begun(oracle, starts), actions[[11, *range(11)]], [0] * 12)
    assert torch.equal(got.robot, wanted.robot) and shuffled.spec == oracle.spec
