# SPDX-License-Identifier: Apache-2.0
"""Environments between decisions: what becomes a segment, what becomes a result."""

import pickle
from collections import deque
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from accerl_lerobot.errors import InputError
from accerl_lerobot.evaluation import summarise
from accerl_lerobot.experience import REAL
from accerl_lerobot.rollout.runner import EpisodePlan, EpisodePlans, RolloutConfig, incarnation_after
from accerl_lerobot.seeds import train_seed
from tests.rollout.environments import CHUNK, Recorder, ScriptedEnvironment, decide, evaluate, explore

CONFIG = RolloutConfig(environments=1, segment_length=3, decision_cost=0.0)


def played(*plans: EpisodePlan, config: RolloutConfig = CONFIG, **environment: Any) -> Recorder:
    """Episodes of one scripted environment, by default one that explores."""
    recorder = Recorder([ScriptedEnvironment(**environment)], list(plans) or [explore()], config)
    recorder.play()
    return recorder


def steps_seen(segment) -> list[float]:
    return segment.observations["observation.state"][:, 1].tolist()


def test_an_episode_is_cut_into_segments_without_a_gap():
    segments = played(steps=14, end="limit").segments
    assert [(len(s), s.origin.decision) for s in segments] == [(3, 0), (3, 3), (1, 6)]
    assert [steps_seen(s) for s in segments] == [[0, 2, 4, 6], [6, 8, 10, 12], [12, 14]]
    # A decision's latent names the step it was made at: it must stand beside that observation.
    assert all(s.latent["x"][:, 0].tolist() == steps_seen(s)[:-1] for s in segments)


def test_a_result_has_the_totals_of_its_episode_and_the_oldest_and_newest_weights():
    recorder = Recorder([ScriptedEnvironment(steps=2 * CHUNK + 1)], [explore()], CONFIG)
    request = recorder.runner.begin_episode(0)
    for version in (4, 3, 5):
        request = recorder.runner.advance(0, decide(request, version))
    (result,), (segment,), counters = recorder.results, recorder.segments, recorder.runner.counters
    assert (result.success, result.episode_return, result.steps, result.decisions) == (True, 5.0, 5, 3)
    assert result.versions == (3, 5) and segment.version.tolist() == [4, 3, 5]
    assert segment.steps.tolist() == segment.reward.tolist() == [2, 2, 1], "it ended within a chunk"
    assert (counters.env_steps, counters.decisions, counters.episodes) == (5, 3, 1)


@pytest.mark.parametrize(("end", "success"), [("success", True), ("failure", False), ("limit", False)])
def test_the_last_segment_says_how_the_episode_ended(end, success):
    recorder = played(steps=8, end=end)
    ends = [(segment.terminated, segment.success) for segment in recorder.segments]
    assert ends == [(False, False), (True, success)]
    assert recorder.results[0].decisions == 4 and recorder.results[0].success is success


def test_every_decision_costs():
    config = replace(CONFIG, decision_cost=0.25)
    recorder = played(steps=8, config=config)
    assert np.concatenate([s.reward for s in recorder.segments]).tolist() == [1.75] * 4
    assert recorder.results[0].episode_return == pytest.approx(4 * 1.75)
    evaluation = played(evaluate(), steps=8, config=config)
    assert evaluation.results[0].episode_return == 8.0, "the environment's own"


def test_a_world_that_does_not_show_the_same_again_cannot_be_resumed_in_an_episode():
    begun = Recorder([ScriptedEnvironment(steps=9)], [explore()], CONFIG).runner
    begun.advance(0, decide(begun.begin_episode(0)))
    state = begun.state()
    environment = ScriptedEnvironment(steps=9)
    resumed = Recorder([environment], [], CONFIG).runner
    resumed.restore(state)
    assert environment.now == CHUNK and resumed.counters.decisions == 1
    environment.render = lambda height, width: np.full((height, width, 3), 99, np.uint8)
    with pytest.raises(RuntimeError, match="does not show again .*begin a new run from its"):
        resumed.restore(state)


@pytest.mark.parametrize("nan_in", ["reward", "state", "simulator"])
def test_a_nan_is_counted_and_the_next_episode_goes_on(nan_in: str):
    environment = ScriptedEnvironment(steps=20, nan_at=9, nan_in=nan_in)
    recorder = Recorder([environment], [explore(1)], CONFIG)
    recorder.play()
    # Decisions 1 to 3 had become a segment; the 4th and 5th had not when the 5th met the NaN.
    assert recorder.runner.counters.dropped_nonfinite == 2 and not recorder.results
    environment.nan_at = 0
    recorder.plans.queue([explore(2)])
    recorder.play()
    assert [result.plan.seed for result in recorder.results] == [2]
    seeds = [s.observations["observation.state"][0, 0] for s in recorder.segments]
    assert seeds == [1, 2, 2, 2, 2], "nothing of the dropped episode may follow"


def test_an_evaluation_that_meets_a_nan_still_has_a_result():
    recorder = played(evaluate(1, 0), evaluate(2, 1), steps=20, nan_at=5)
    assert [(r.plan.index, r.success) for r in recorder.results] == [(0, False), (1, False)]
    assert not recorder.segments
    assert all(r.note == "an episode is dropped: the reward is not finite" for r in recorder.results)
    assert recorder.runner.counters.dropped_episodes == 2
    assert summarise(recorder.results)["notes"] == [f"2 of 2 episodes: {recorder.results[0].note}"]


class Unlucky(ScriptedEnvironment):
    """Its first observation is not finite where the seed is odd."""

    def reset(self, seed, task):
        return super().reset(seed, task) | {"observation.state": np.array([np.inf if seed % 2 else seed, 0])}


def test_nothing_but_dropped_episodes_ends_the_rollout_with_one_line():
    again_and_again = [explore(seed) for seed in (*[1] * 18, 2, *[1] * 18, 4)]
    recorder = Recorder([Unlucky()], again_and_again, CONFIG)
    recorder.play()
    assert [r.plan.seed for r in recorder.results] == [2, 4]
    assert recorder.runner.counters.dropped_episodes == 36
    recorder = Recorder([Unlucky()], [explore(1)] * 50, CONFIG)
    message = r"env='push': 20 episodes in a row .* observation\.state of the first observation is not finite"
    with pytest.raises(InputError, match=message):
        recorder.play()


def test_evaluation_asks_for_the_stock_sampler_and_makes_no_segment():
    recorder = Recorder([ScriptedEnvironment()], [evaluate(1), explore(2)], CONFIG)
    assert [r.explore for r in recorder.play()] == [False] * 3 + [True] * 3
    assert len(recorder.segments) == 1 and len(recorder.results) == 2


def test_noise_depends_on_episode_and_decision_and_on_nothing_else():
    plans = [explore(seed) for seed in (5, 6, 1_000_000_000, 2_000_000_000)]
    noise: list[dict[bytes, int]] = []
    for slots, order in ((1, plans), (3, plans[::-1])):
        asked = Recorder([ScriptedEnvironment(steps=6) for _ in range(slots)], order, CONFIG).play()
        noise.append({r.observation["observation.state"].tobytes(): r.noise_seed for r in asked})
    assert noise[0] == noise[1]
    assert len(set(noise[0].values())) == 4 * 3


@pytest.mark.parametrize("end", ["success", "limit"])
def test_filming_changes_nothing(end: str):
    plans = [replace(evaluate(), film=film) for film in (None, (8, 2))]
    plain, filmed = played(*plans, steps=9, end=end).results
    assert plain.frames == []
    assert len(filmed.frames) >= 9 // 2 and all(frame.shape == (8, 8, 3) for frame in filmed.frames)
    assert replace(filmed, plan=plain.plan, frames=[]) == plain


TASKS = ("push", "pull", "lift")


def make(worker: int = 0, incarnation: int = 0, budget: int | None = None) -> EpisodePlans:
    return EpisodePlans(TASKS, seed=3, worker=worker, incarnation=incarnation, budget=budget)


def take(plans: EpisodePlans, count: int) -> list[EpisodePlan]:
    plans.exploring = True
    found = [plans.next(REAL, deque()) for _ in range(count)]
    return [plan for plan in found if plan is not None]


def test_every_episode_has_its_own_seed_and_tasks_take_turns():
    plans = [(plan.task, plan.seed, plan.explore) for plan in take(make(worker=1), 5)]
    tasks = ["pull", "lift", "push", "pull", "lift"]
    assert plans == [(task, train_seed(3, 1, number), True) for number, task in enumerate(tasks)]


def test_a_task_that_fails_more_is_explored_more_and_goes_on_so_after_a_restart():
    buffers: list[pickle.PickleBuffer] = []
    handed_over = pickle.dumps(make(), 5, buffer_callback=buffers.append)
    plans = pickle.loads(handed_over, buffers=[bytes(b) for b in buffers])  # arrays read-only, as from Ray
    for plan in (found := take(plans, 300)):
        plans.ended(SimpleNamespace(plan=plan, success=plan.task == "pull"))
    assert [p.task for p in found] == list(TASKS) * 100, "until it is known how they ended, tasks take turns"
    resumed = make()
    resumed.restore(plans.state())
    found = take(plans, 210)
    assert [sum(p.task == task for p in found) for task in TASKS] == [100, 10, 100]
    assert found == take(resumed, 210)


def test_evaluations_go_first_and_nothing_is_explored_before_it_is_time():
    plans = make()
    plans.queue([evaluate(index=0), evaluate(index=1)])
    assert [p.index for p in take(plans, 1)] == [0]
    plans.exploring = False
    assert [plans.next(REAL, deque()) for _ in range(2)] == [evaluate(index=1), None]
    assert take(plans, 1)[0].explore


def test_not_even_where_the_one_before_has_played_thousands():
    incarnation, seen = 0, set()
    for count in (1, 400, 990, 1010, 0, 1499):
        plans = make(incarnation=incarnation)
        said = count - 30  # the last episodes were begun after it had been asked
        seeds = {plan.seed for plan in take(plans, max(0, said))}
        starts = plans.seeds_used
        seeds |= {plan.seed for plan in take(plans, min(count, 30))}
        assert len(seeds) == count and not seeds & seen
        seen |= seeds
        incarnation = incarnation_after(incarnation, starts)
    assert incarnation == 9


def test_no_more_episodes_than_were_paid_for():
    plans = make(budget=4)
    assert not plans.spent and len(take(plans, 9)) == 4 and plans.spent
    plans.queue([evaluate(index=0)])
    assert take(plans, 2) == [evaluate(index=0)], "evaluations are not counted"
    endless = make()
    assert len(take(endless, 9)) == 9 and not endless.spent
