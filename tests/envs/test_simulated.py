# SPDX-License-Identifier: Apache-2.0
"""The simulated world: solvable, as slow as asked, and broken on request."""

from __future__ import annotations

import numpy as np
import pytest

from accerl_lerobot.envs import SimulatedConfig, SimulatedWorld, simulated
from accerl_lerobot.envs.simulated import read_trace
from accerl_lerobot.errors import InputError


def held(world: SimulatedWorld, count: int = 10) -> np.ndarray:
    return np.repeat(world.solution[None], count, 0)


@pytest.mark.parametrize("task", ["match", "mirror"])
def test_holding_the_solution_succeeds_at_once(task: str):
    world = SimulatedWorld(SimulatedConfig(task="match,mirror", hold=4))
    state = world.reset(0, task)["observation.state"]
    assert np.array_equal(world.solution, state[:2] if task == "match" else -state[:2])
    result = world.step_chunk(held(world))
    assert result.terminated and result.success and result.steps == 4
    assert result.rewards.tolist() == [0, 0, 0, 1]
    assert np.array_equal(result.observation["observation.state"][2:4], world.solution)


def test_success_counts_once_when_it_does_not_end_the_episode():
    world = SimulatedWorld(SimulatedConfig(terminate_on_success=False, max_steps=20))
    world.reset(0, "match")
    results = [world.step_chunk(held(world)) for _ in range(2)]
    assert results[-1].truncated and results[-1].success
    assert sum(r.rewards.sum() for r in results) == 1


def test_the_picture_shows_the_target_and_the_actions():
    world = SimulatedWorld(SimulatedConfig(tolerance=0.01))
    pictures = [world.reset(seed, "match")["observation.images.front"] for seed in (0, 1)]
    assert not np.array_equal(*pictures)
    moved = world.step_chunk(np.full((2, 2), 0.9, np.float32)).observation["observation.images.front"]
    assert not np.array_equal(pictures[1], moved)


def test_no_picture_is_drawn_inside_a_chunk(monkeypatch: pytest.MonkeyPatch):
    drawn = []
    render = SimulatedWorld.render
    monkeypatch.setattr(SimulatedWorld, "render", lambda *args: drawn.append(1) or render(*args))
    world = SimulatedWorld(SimulatedConfig())
    world.reset(0, "match")
    world.step_chunk(np.zeros((10, 2), np.float32))
    world.step_chunk(held(world))
    assert len(drawn) == 3


def test_latency_is_slept_and_has_the_mean_asked_for(monkeypatch: pytest.MonkeyPatch):
    slept: list[float] = []
    monkeypatch.setattr("accerl_lerobot.envs.simulated._wait", slept.append)
    world = SimulatedWorld(SimulatedConfig(step_ms=2.0, frame_ms=10.0, tolerance=1e-6, max_steps=100))
    world.reset(0, "match")
    slept.clear()
    world.step_chunk(np.zeros((10, 2), np.float32))
    assert sum(slept) == pytest.approx(0.030)
    world = SimulatedWorld(SimulatedConfig(latency="lognormal", latency_cv=1.0))
    world.reset(0, "match")
    draws = [world._delay(3.0) for _ in range(20_000)]
    assert np.mean(draws) == pytest.approx(0.003, rel=0.05)
    assert np.std(draws) / np.mean(draws) == pytest.approx(1.0, rel=0.15)


def test_a_trace_is_gone_through_from_some_moment_on_and_scaled(tmp_path):
    path = tmp_path / "trace.txt"
    path.write_text("# of a world\n1.0\n\n2.0  # milliseconds\nreset 30\n6.0\nreset 60\n")
    trace = read_trace(str(path))
    assert trace.decisions.tolist() == [1 / 3, 2 / 3, 2.0] and trace.resets.tolist() == [10.0, 20.0]
    config = SimulatedConfig(latency="trace", latency_trace=str(path), frame_ms=0.3)
    starts = set()
    for seed in range(20):
        world = SimulatedWorld(config)
        world.reset(seed, "match")
        draws = [round(world._delay(3.0) * 1000, 9) for _ in range(6)]
        assert draws[:3] == draws[3:] and sorted(draws[:3]) == [1.0, 2.0, 6.0]
        assert draws[(draws.index(1.0) + 1) % 3] == 2.0
        starts.add(draws[0])
        world.reset(seed, "match")
        assert round(world._delay(3.0) * 1000, 9) == draws[0]
    assert starts == {1.0, 2.0, 6.0}
    assert world._delay(0.0) == 0.0


def test_resets_take_what_they_took(tmp_path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "trace.txt"
    waited: list[float] = []
    monkeypatch.setattr(simulated, "_wait", lambda delay: waited.append(round(1000 * delay, 9)))
    for text, resets in (("1\nreset 30\n1\nreset 60\n", {90.0, 180.0}), ("1\n1\n", {3.0})):
        path.write_text(text)
        world = SimulatedWorld(SimulatedConfig(latency="trace", latency_trace=str(path), frame_ms=3.0))
        waited.clear()
        for seed in range(20):
            world.reset(seed, "match")
        assert set(waited) == resets
        waited.clear()
        world.step_chunk(np.zeros((10, 2), np.float32))
        assert waited == [3.0]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (None, "cannot be read"),
        ("1.0\nfast\n", "line 2, 'fast', is no duration"),
        ("1.0\nafter 1.0\n", "line 2, 'after 1.0'"),
        ("nan\n", "line 1"),
        ("# nothing\n", "no time passes"),
        ("0\n0\n", "no time passes"),
    ],
)
def test_a_trace_that_is_none_is_refused(tmp_path, text: str | None, why: str):
    trace = tmp_path / "trace.txt"
    if text is not None:
        trace.write_text(text)
    with pytest.raises(InputError, match=f"^env.latency_trace=.*{why}"):
        SimulatedWorld(SimulatedConfig(latency="trace", latency_trace=str(trace)))


def test_it_crashes_on_request_and_counts_over_episodes():
    world = SimulatedWorld(SimulatedConfig(crash_after=12, tolerance=1e-6))
    for seed in (0, 1):
        world.reset(seed, "match")
        if seed == 0:
            world.step_chunk(np.zeros((10, 2), np.float32))
    with pytest.raises(RuntimeError, match="simulated crash after 12"):
        world.step_chunk(np.zeros((10, 2), np.float32))


def test_one_nan_ends_the_episode_and_the_next_is_healthy():
    world = SimulatedWorld(SimulatedConfig(nan_after=3))
    world.reset(0, "match")
    result = world.step_chunk(held(world))
    assert result.info == {"nonfinite": 1.0} and result.truncated and result.steps == 3
    assert np.isnan(result.observation["observation.state"]).all()
    assert np.isfinite(world.reset(1, "match")["observation.state"]).all()
    assert world.step_chunk(held(world)).success


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"state_dim": 3}, "env.state_dim"),
        ({"hold": 41}, "env.hold"),
        ({"latency": "trace"}, "env.latency_trace"),
        ({"latency_trace": "trace.txt"}, "env.latency_trace"),
        ({"latency": "trace", "latency_trace": "trace.txt", "step_ms": 1.0}, "env.step_ms"),
    ],
)
def test_bad_values_name_their_field(values: dict, field: str):
    with pytest.raises(InputError, match=f"^{field}="):
        SimulatedWorld(SimulatedConfig(**values))
