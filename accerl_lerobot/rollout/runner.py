# SPDX-License-Identifier: Apache-2.0
"""Steps several environments at once, each at its own decision: the rollout worker without its process.

A slot is one environment. `begin_episode` resets it and `advance` executes a decision in it; both return the
request for the next decision. The Ray worker goes on with other slots meanwhile, the local engine answers at
once.

`EpisodePlans` says which episode a free environment runs next: planned evaluations first, then exploring
ones, of each task in turn and of failing ones more often, with seeds of this worker's own (`seeds.py`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np

from accerl_lerobot.checkpoint.snapshot import kind
from accerl_lerobot.config.ranges import NonNegative, Range, Section, Steps
from accerl_lerobot.envs import JudgedEnvironment, RewardModelConfig
from accerl_lerobot.envs.base import ChunkResult, Environment
from accerl_lerobot.errors import InputError, for_viewing, warn_once
from accerl_lerobot.experience import (
    IMAGINED,
    REAL,
    TASK,
    Decision,
    Observation,
    Request,
    Segment,
    SegmentStart,
    nonfinite,
    stacked,
)
from accerl_lerobot.seeds import noise_seed, train_seed
from accerl_lerobot.timeline import COMPUTE, Clock, NoClock

SEEDS_PER_INCARNATION = 1000
"""By how much a restarted worker skips ahead in its training seeds, so as not to repeat its episodes."""
LEAST_SHARE = 0.1  # how often a task that never fails is explored, compared with one that always does
RECENT = 20  # episodes of a task that tell how often it fails now
MOST_STARTS = 256  # newest real episodes at whose first observation imagined ones start
FirstObservations = deque[tuple[str, Observation]]  # of real episodes, with their tasks, the newest last
MOST_DROPPED = 20  # episodes in a row that may be dropped before the environment counts as broken


@dataclass(frozen=True, kw_only=True)
class RolloutConfig(Section, section="rollout"):
    """How experience is collected."""

    workers: Annotated[int, Range("[1, 1000]")] = 1
    """Rollout processes."""
    environments: Annotated[int, Range("[1, 1000]")] = 8
    """Environments per process; while some wait for a decision the others step."""
    segment_length: Annotated[int, Range("[1, 10000]")] = 16
    """Largest number of decisions in a segment."""
    decision_cost: NonNegative = 0.01
    """Subtracted from the reward of every decision, so that faster is better."""
    episodes: Steps = 0
    """Real exploring episodes in all; 0: as many as the updates need. Once they are played, learning goes on
    while replay has something to give, which is little unless more is imagined, and then ends."""
    reward_model: RewardModelConfig = field(default_factory=RewardModelConfig)
    """The model that tells success, where the environment does not."""


@kind
@dataclass(frozen=True, kw_only=True)
class EpisodePlan:
    """One episode to run."""

    task: str
    seed: int
    explore: bool
    """True: sample and learn from it. False: LeRobot's stock sampler, for evaluation; no segment is made."""
    index: int = 0  # position in the evaluation it belongs to
    group: str = "train"  # which evaluation it belongs to
    source: str = REAL  # ``imagined``: it is run in an `Environment` of that source, and not counted
    film: tuple[int, int] | None = None
    """Side in pixels and env steps per frame of a video for people; None: none. It executes a chunk in parts,
    which changes nothing else."""


def start_of(first: FirstObservations, seed: int) -> tuple[str, Observation]:
    """Task and first observation of the imagined episode with this seed."""
    return first[seed % len(first)]


def budgets(config: RolloutConfig) -> list[int | None]:
    """How many exploring episodes each worker plays; None: no end."""
    if not config.episodes:
        return [None] * config.workers
    each, more = divmod(config.episodes, config.workers)
    return [each + int(worker < more) for worker in range(config.workers)]


def incarnation_after(incarnation: int, seeds_used: int) -> int:
    """Number of the process that takes a worker's place, such that it meets none of its seeds again.

    `seeds_used` is of the last report of the process before, which may have used more since.
    """
    reached = (seeds_used + SEEDS_PER_INCARNATION // 2) // SEEDS_PER_INCARNATION
    return max(incarnation, reached) + 1


class EpisodePlans:
    """The episodes of one worker, in order.

    `incarnation` is how often the worker has been restarted, part of the seeds and of its segments' keys;
    `budget` limits the exploring ones, which are planned while `exploring`.
    """

    def __init__(
        self, tasks: tuple[str, ...], seed: int, budget: int | None, worker: int = 0, incarnation: int = 0
    ) -> None:
        self.worker = worker
        self.incarnation = incarnation
        self.exploring = False
        self._tasks = tasks
        self._seed = seed
        self._budget = budget
        self.seeds_used = incarnation * SEEDS_PER_INCARNATION  # of the worker's, for real episodes
        self.imagined_seeds_used = self.seeds_used
        # Filled and emptied on different threads: appending to and popping from a deque is atomic.
        self._queued: deque[EpisodePlan] = deque()
        self._failing = dict.fromkeys(tasks, 1.0)
        # Episodes that each task is still to get. Each worker begins with another task; equals take turns.
        self._due: dict[str, float] = {}
        for place, task in enumerate(tasks):
            turn = (place - worker) % len(tasks)
            self._due[task] = -1e-6 * turn

    def queue(self, plans: Iterable[EpisodePlan]) -> None:
        self._queued.extend(plans)

    def next(self, source: str, first: FirstObservations) -> EpisodePlan | None:
        """The episode that a free environment of this source is to run; None: it has to wait.

        An imagined one begins at one of the `first` observations.
        """
        if source != REAL:
            return self._next_imagined(first)
        if self._queued:
            return self._queued.popleft()
        if not self.exploring or self.spent:
            return None
        if self._budget is not None:
            self._budget -= 1
        seed = train_seed(self._seed, self.worker, self.seeds_used)
        self.seeds_used += 1
        shares = {task: max(failing, LEAST_SHARE) for task, failing in self._failing.items()}
        total = sum(shares.values())
        for task, share in shares.items():
            self._due[task] += share / total
        task = max(self._tasks, key=self._due.__getitem__)
        self._due[task] -= 1
        return EpisodePlan(task=task, seed=seed, explore=True)

    def _next_imagined(self, first: FirstObservations) -> EpisodePlan | None:
        if not self.exploring or not first:
            return None
        seed = train_seed(self._seed, self.worker, self.imagined_seeds_used)
        self.imagined_seeds_used += 1
        task, _ = start_of(first, seed)
        return EpisodePlan(task=task, seed=seed, explore=True, source=IMAGINED)

    def ended(self, result: EpisodeResult) -> None:
        """Note the outcome of an episode: tasks that fail more often are explored more often."""
        if result.plan.explore and result.plan.source == REAL:
            task = result.plan.task
            failed = not result.success
            self._failing[task] += (failed - self._failing[task]) / RECENT

    @property
    def spent(self) -> bool:
        """True if every exploring episode has been handed out."""
        return self._budget is not None and self._budget <= 0

    def state(self) -> dict[str, Any]:
        return {
            "budget": self._budget,
            "seeds_used": self.seeds_used,
            "imagined_seeds_used": self.imagined_seeds_used,
            "queued": list(self._queued),
            "failing": dict(self._failing),
            "due": dict(self._due),
        }

    def restore(self, state: dict[str, Any]) -> None:
        self._budget = state["budget"]
        self.seeds_used = state["seeds_used"]
        self.imagined_seeds_used = state["imagined_seeds_used"]
        self._queued.extend(state["queued"])
        self._failing = state["failing"]
        self._due = state["due"]


@kind
@dataclass(frozen=True, kw_only=True)
class EpisodeResult:
    """Outcome of an episode."""

    plan: EpisodePlan
    success: bool
    episode_return: float  # less `RolloutConfig.decision_cost` a decision, if it explored
    steps: int
    decisions: int
    versions: tuple[int, int]  # oldest and newest weights that decided in it
    frames: list[np.ndarray] = field(default_factory=list)
    """uint8 (H, W, 3) each, when the plan asked for a film."""
    note: str = ""
    """Why its success may not be what happened; empty: nothing is known to be wrong."""


@kind
@dataclass
class Counters:
    """Counters of a runner so far."""

    env_steps: int = 0
    decisions: int = 0
    episodes: int = 0
    dropped_nonfinite: int = 0  # decisions thrown away because the environment returned NaN or infinity
    dropped_episodes: int = 0  # episodes that ended so
    imagined_decisions: int = 0  # those and the next are in no other counter
    imagined_episodes: int = 0


@kind
@dataclass(eq=False, kw_only=True)
class ActiveEpisode:
    """An episode under way in `RolloutRunner`, and the segment that is collected of it."""

    # Of the segment:
    observations: list[Observation]  # the next decision is about the last one
    taken: list[tuple[Decision, np.ndarray, float, int]] = field(default_factory=list)
    """Decisions, each with its actions, reward and env steps."""
    # Of the episode:
    plan: EpisodePlan
    time_limit: int  # env steps of an episode at most
    episode_return: float = 0.0  # less the decision costs, if it explores
    steps: int = 0
    versions: list[int] = field(default_factory=list)  # of the weights of each decision
    frames: list[np.ndarray] = field(default_factory=list)
    chunks: list[np.ndarray] = field(default_factory=list)
    """All that was executed, by which `RolloutRunner.restore` brings the environment back to where it was."""

    def request(self) -> Request:
        return Request(
            observation=self.observations[-1],
            noise_seed=noise_seed(self.plan.seed, len(self.versions)),
            elapsed=self.steps / self.time_limit,
            explore=self.plan.explore,
            task=self.plan.task,
        )

    def add(
        self, decision: Decision, actions: np.ndarray, reward: float, steps: int, following: Observation
    ) -> None:
        """Note a decision, of which so many steps were executed, and the observation after them."""
        self.taken.append((decision, actions, reward, steps))
        self.observations.append(following)
        self.episode_return += reward
        self.steps += steps
        self.versions.append(decision.version)

    def cut(self, key: str, terminated: bool = False, success: bool = False) -> Segment:
        """Returns the decisions so far as one segment; the next segment begins at its last observation."""
        observations = self.observations
        self.observations = self.observations[-1:]
        decisions, actions, rewards, steps = zip(*self.taken, strict=True)
        self.taken = []
        return Segment(
            observations=stacked(observations),
            task=str(observations[0][TASK]),
            latent=stacked([d.latent for d in decisions]),
            log_prob=np.stack([d.log_prob for d in decisions]).astype(np.float32),
            actions=np.stack(actions).astype(np.float32),
            reward=np.array(rewards, np.float32),
            version=np.array([d.version for d in decisions], np.int64),
            steps=np.array(steps, np.int64),
            before=self.steps - sum(steps),
            time_limit=self.time_limit,
            terminated=terminated,
            success=success,
            key=key,
            source=self.plan.source,
            origin=SegmentStart(self.plan.task, self.plan.seed, len(self.versions) - len(decisions)),
        )


@dataclass(eq=False)
class RolloutRunner:
    """Drives a set of environments, one per slot, through the episodes of `plans`.

    A slot for which none is planned stays idle until `begin_episode` is called again. `segments`, of
    exploring episodes, and `results`, of all episodes, are there to be taken. `first_observations` is filled
    from real exploring episodes. `clock` enters `COMPUTE` when an episode begins.
    """

    environments: Sequence[Environment]
    plans: EpisodePlans
    config: RolloutConfig
    first_observations: FirstObservations = field(default_factory=lambda: deque(maxlen=MOST_STARTS))
    clock: Clock = field(default_factory=NoClock)

    def __post_init__(self) -> None:
        # Filled and emptied on different threads: appending to and popping from a deque is atomic.
        self.segments: deque[Segment] = deque()
        self.results: deque[EpisodeResult] = deque()
        self.counters = Counters()
        self._episodes: list[ActiveEpisode | None] = [None] * len(self.environments)
        self._sequence = 0
        self._dropped = 0  # episodes in a row

    def __len__(self) -> int:
        return len(self.environments)

    @property
    def exploring(self) -> bool:
        """True while a real exploring episode is under way."""
        for episode in self._episodes:
            if episode is not None and episode.plan.explore and episode.plan.source == REAL:
                return True
        return False

    def begin_episode(self, slot: int) -> Request | None:
        """Begins the next planned episode in `slot`; None when nothing is planned."""
        environment = self.environments[slot]
        plan = self.plans.next(environment.source, self.first_observations)
        if plan is None:
            self._episodes[slot] = None
            return None
        self.clock.enter(COMPUTE)
        observation = environment.reset(plan.seed, plan.task)
        episode = ActiveEpisode(plan=plan, time_limit=environment.spec.max_steps, observations=[observation])
        self._episodes[slot] = episode
        bad = nonfinite(observation)
        if bad:
            return self._drop(slot, episode, f"{bad} of the first observation")
        if plan.explore and plan.source == REAL:
            self.first_observations.append((plan.task, observation))
        return episode.request()

    def advance(self, slot: int, decision: Decision) -> Request | None:
        """Executes `decision`, and cuts a segment if one is full or the episode has ended.

        Returns the next request: of the same episode, or the first of the next one, if one is planned.
        """
        environment = self.environments[slot]
        episode = self._episodes[slot]
        assert episode is not None
        result = _execute(environment, episode, decision.chunk)
        episode.chunks.append(decision.chunk)
        if environment.source == REAL:
            self.counters.env_steps += result.steps
            self.counters.decisions += 1
        else:
            self.counters.imagined_decisions += 1
        bad = nonfinite({"the reward": result.rewards, **result.observation})
        if bad or not result.finite:
            self.counters.dropped_nonfinite += len(episode.taken) + 1
            return self._drop(slot, episode, bad or "the state of the simulator")
        reward = float(result.rewards.sum())
        if episode.plan.explore:  # what is to be maximised; evaluation reports the environment's own return
            reward -= self.config.decision_cost
        actions = np.clip(decision.chunk, environment.spec.action_low, environment.spec.action_high)
        episode.add(decision, actions, reward, result.steps, result.observation)
        if result.done or len(episode.taken) >= self.config.segment_length:
            self._sequence += 1
            key = f"rollout{self.plans.worker}.{self.plans.incarnation}.{self._sequence}"
            # Of an evaluation too, so that its observations are freed.
            segment = episode.cut(key, result.done, result.success)
            if episode.plan.explore:
                self.segments.append(segment)
        if result.done:
            self._dropped = 0
            self._finish(episode, result.success, result.note)
            return self.begin_episode(slot)
        return episode.request()

    def _drop(self, slot: int, episode: ActiveEpisode, bad: str) -> Request | None:
        """Throws away the rest of an episode; returns the request of the next episode."""
        plan = episode.plan
        note = f"an episode is dropped: {bad} is not finite"
        self.counters.dropped_episodes += 1
        self._dropped += 1
        if self._dropped >= MOST_DROPPED:
            hint = f"{self._dropped} episodes in a row had to be dropped, as {bad} is not finite"
            raise InputError("env", plan.task, f"{hint}; mend the environment")
        if plan.explore:
            warn_once(note)
        else:  # an evaluation counts every episode it planned
            self._finish(episode, success=False, note=note)
        return self.begin_episode(slot)

    def request(self, slot: int) -> Request | None:
        """Request of the episode in `slot`; None if it waits for nothing."""
        episode = self._episodes[slot]
        return None if episode is None else episode.request()

    def state(self) -> dict[str, Any]:
        return {
            "counters": replace(self.counters),
            "sequence": self._sequence,
            "episodes": list(self._episodes),
            "environments": [environment.state() for environment in self.environments],
            "first_observations": list(self.first_observations),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Resumes from `state`. Environments without a state of their own repeat their episode so far."""
        self.counters = state["counters"]
        self._sequence = state["sequence"]
        self._episodes = state["episodes"]
        self.first_observations.extend(state["first_observations"])
        slots = zip(self.environments, self._episodes, state["environments"], strict=True)
        for environment, episode, kept in slots:
            if episode is None:
                continue
            if kept is not None:
                environment.restore(kept)
                continue
            plan = episode.plan
            latest = episode.observations[-1]
            observation = environment.reset(plan.seed, plan.task)
            for chunk in episode.chunks:
                observation = environment.step_chunk(chunk).observation
            if not all(np.array_equal(observation[key], latest[key]) for key in latest):
                why = "does not show again what it had shown, so its episodes cannot be resumed in the middle"
                hint = "begin a new run from its last checkpoint, with --policy.path"
                raise RuntimeError(f"{plan.task} with seed {plan.seed} {why}; {hint}")

    def close(self) -> None:
        for environment in self.environments:
            environment.close()

    def _finish(self, episode: ActiveEpisode, success: bool, note: str) -> None:
        if episode.plan.source == REAL:
            self.counters.episodes += 1
        else:
            self.counters.imagined_episodes += 1
        if note:
            warn_once(note)
        versions = episode.versions or [0]
        result = EpisodeResult(
            plan=episode.plan,
            success=success,
            episode_return=episode.episode_return,
            steps=episode.steps,
            decisions=len(episode.versions),
            versions=(min(versions), max(versions)),
            frames=episode.frames,
            note=note,
        )
        self.plans.ended(result)
        self.results.append(result)


def _execute(environment: Environment, episode: ActiveEpisode, actions: np.ndarray) -> ChunkResult:
    """Executes a chunk; if it is filmed, part by part, with a frame of each."""
    if episode.plan.film is None:
        return environment.step_chunk(actions)
    side, every = episode.plan.film
    if isinstance(environment, JudgedEnvironment):
        every = len(actions)  # or filmed episodes would be judged more often than others
    rewards = []
    for i in range(0, len(actions), every):
        result = environment.step_chunk(actions[i : i + every])
        rewards.append(result.rewards)
        with for_viewing("film"):
            episode.frames.append(np.asarray(environment.render(side, side)))
        if result.done:
            break
    return replace(result, rewards=np.concatenate(rewards))
