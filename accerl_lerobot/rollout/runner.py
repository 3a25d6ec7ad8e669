# SPDX-License-Identifier: Apache-2.0
"""Several worlds, each somewhere between a decision and the next: the rollout worker without its process.

A slot is one world. `start` resets it and `advance` executes a decision in it; both return the request for
the next decision. The Ray worker goes on with other slots meanwhile, the local engine answers at once.

`EpisodePlans` says which episode a free world runs next: planned evaluations first, then exploring ones, of
each task in turn, with seeds of this worker's own (`seeds.py`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

import numpy as np

from accerl_lerobot.checkpoint.snapshot import kind
from accerl_lerobot.config.ranges import NonNegative, Range, Section, Steps
from accerl_lerobot.envs.base import ChunkResult, World
from accerl_lerobot.experience import Decision, Observation, Origin, Request, Segment
from accerl_lerobot.rollout.segments import SegmentBuilder
from accerl_lerobot.seeds import noise_seed, train_seed

STARTS_PER_INCARNATION = 1000
"""By how much a restarted worker skips ahead in its training seeds, so as not to repeat its episodes."""
_STATE = ("plan", "episode_return", "steps", "decisions", "versions", "frames", "chunks")


@dataclass
class Slot:
    """State of one episode under way in `RolloutRunner`."""

    world: World
    plan: EpisodePlan | None = None
    builder: SegmentBuilder | None = None
    episode_return: float = 0.0
    steps: int = 0
    decisions: int = 0
    versions: list[int] = field(default_factory=list)
    frames: list[np.ndarray] = field(default_factory=list)
    chunks: list[np.ndarray] = field(default_factory=list)
    """All that was executed, by which `restore` brings the world back to where it was."""

    def state(self) -> dict[str, Any]:
        """All that `restore` needs; see `snapshot`."""
        builder = None if self.plan is None or self.builder is None else self.builder.state()
        return {name: getattr(self, name) for name in _STATE} | {"builder": builder}

    def restore(self, state: dict[str, Any], segment_length: int) -> None:
        """Goes on from what `state` gave: the world is brought back by doing again what was done in it."""
        plan: EpisodePlan | None = state["plan"]
        if plan is None:
            return
        observation = self.world.reset(plan.seed, plan.task)
        for chunk in state["chunks"]:
            observation = self.world.step_chunk(chunk).observation
        self.builder = SegmentBuilder(observation, segment_length, Origin(plan.task, plan.seed, decision=0))
        self.builder.restore(state["builder"])
        latest = self.builder.latest
        if observation.keys() != latest.keys() or not all(
            np.array_equal(observation[key], latest[key]) for key in latest
        ):
            raise RuntimeError(
                f"{plan.task} with seed {plan.seed} does not show again what it had shown after "
                f"{len(state['chunks'])} decisions, so its episodes cannot be gone on with in the middle; "
                "use launch.engine=ray, which begins them anew"
            )
        for name in _STATE:
            setattr(self, name, state[name])


@dataclass(frozen=True, kw_only=True)
class RolloutConfig(Section, section="rollout"):
    """How experience is collected."""

    workers: Annotated[int, Range("[1, 1000]")] = 1
    """Rollout processes."""
    worlds: Annotated[int, Range("[1, 1000]")] = 8
    """Worlds per process; while some wait for a decision the others step."""
    segment_length: Annotated[int, Range("[1, 10000]")] = 16
    """Largest number of decisions in a segment."""
    decision_cost: NonNegative = 0.01
    """Subtracted from the reward of every decision, so that faster is better."""
    time_limit: Literal["truncate", "fail"] = "fail"
    """How the learner treats the end of an episode by its time limit. fail: like a termination, the return
    ends there. truncate: V of the last observation stands for what would have followed, as in tasks without
    an end; where success is counted within a limit, failures then go unpunished."""
    episodes: Steps = 0
    """Exploring episodes in all; 0: as many as the updates need. Once they are played, learning goes on while
    replay has something to give, which is little unless more is imagined, and then ends.
    """


@kind
@dataclass(frozen=True, kw_only=True)
class EpisodePlan:
    """One episode to run."""

    task: str
    seed: int
    explore: bool
    """True: sample and learn from it. False: LeRobot's stock sampler, for evaluation; no segment is made."""
    index: int = 0
    """Position in the evaluation it belongs to."""
    group: str = "train"
    """Which evaluation it belongs to."""
    film: tuple[int, int] | None = None
    """Side in pixels and env steps per frame of a video for people; None: none. It executes a chunk in parts,
    which changes nothing else."""


def budgets(config: RolloutConfig) -> list[int | None]:
    """How many exploring episodes each worker plays; None: no end."""
    if not config.episodes:
        return [None] * config.workers
    return [len(range(w, config.episodes, config.workers)) for w in range(config.workers)]


def incarnation_after(incarnation: int, starts: int) -> int:
    """Number of the process that takes a worker's place, such that it meets none of its seeds again.

    Args:
        incarnation: of the one before.
        starts: where that one was in its seeds when it last said so; it may have gone on since.
    """
    return max(incarnation, (starts + STARTS_PER_INCARNATION // 2) // STARTS_PER_INCARNATION) + 1


class EpisodePlans:
    """The episodes of one worker, in order."""

    def __init__(
        self,
        tasks: tuple[str, ...],
        *,
        seed: int,
        worker: int = 0,
        incarnation: int = 0,
        budget: int | None = None,
    ) -> None:
        self._tasks, self._seed, self._worker, self._budget = tasks, seed, worker, budget
        self.starts = incarnation * STARTS_PER_INCARNATION
        """Where it is in the worker's seeds."""
        # Filled and emptied on different threads: appending to and popping from a deque is atomic.
        self._queued: deque[EpisodePlan] = deque()

    def queue(self, plans: Iterable[EpisodePlan]) -> None:
        """Plans evaluation episodes."""
        self._queued.extend(plans)

    def next(self, exploring: bool) -> EpisodePlan | None:
        """The episode that a free world is to run; None: it has to wait."""
        if self._queued:
            return self._queued.popleft()
        if not exploring or self.spent:
            return None
        if self._budget is not None:
            self._budget -= 1
        number, self.starts = self.starts, self.starts + 1
        task = self._tasks[(number + self._worker) % len(self._tasks)]
        return EpisodePlan(task=task, seed=train_seed(self._seed, self._worker, number), explore=True)

    @property
    def spent(self) -> bool:
        """True if every exploring episode has been handed out."""
        return self._budget is not None and self._budget <= 0

    def state(self) -> dict[str, Any]:
        """All that `restore` needs; see `snapshot`."""
        return {"budget": self._budget, "starts": self.starts, "queued": list(self._queued)}

    def restore(self, state: dict[str, Any]) -> None:
        """Goes on from what `state` gave."""
        self._budget, self.starts = state["budget"], state["starts"]
        self._queued.extend(state["queued"])


@kind
@dataclass(frozen=True, kw_only=True)
class EpisodeResult:
    """How an episode went."""

    plan: EpisodePlan
    success: bool
    episode_return: float
    steps: int
    decisions: int
    versions: tuple[int, int]
    """Oldest and newest weights that decided in it."""
    frames: list[np.ndarray] = field(default_factory=list)
    """uint8 (H, W, 3) each, when the plan asked for a film."""


@kind
@dataclass
class Counters:
    """Counters of a runner so far."""

    env_steps: int = 0
    decisions: int = 0
    episodes: int = 0
    dropped_nonfinite: int = 0
    """Decisions thrown away because the world returned NaN or infinity."""


class RolloutRunner:
    """Drives a set of worlds, one per slot, through planned episodes.

    `next_plan` is called for each new episode; None leaves the slot idle until `start` is called again.
    `name`, unique per incarnation of a worker, is the prefix of its segments' keys. `on_segment` receives
    finished segments of exploring episodes, `on_episode` every finished episode.
    """

    def __init__(
        self,
        worlds: Sequence[World],
        next_plan: Callable[[], EpisodePlan | None],
        config: RolloutConfig,
        name: str,
        on_segment: Callable[[Segment], object],
        on_episode: Callable[[EpisodeResult], object],
    ) -> None:
        self.config, self.name = config, name
        self.counters = Counters()
        self._slots = [Slot(world) for world in worlds]
        self._next_plan, self._on_segment, self._on_episode = next_plan, on_segment, on_episode
        self._sequence = 0

    def __len__(self) -> int:
        return len(self._slots)

    @property
    def exploring(self) -> bool:
        """True if an exploring episode is under way."""
        return any(slot.plan is not None and slot.plan.explore for slot in self._slots)

    def start(self, slot: int) -> Request | None:
        """Begins the next planned episode in `slot`; None when nothing is planned."""
        state, plan = self._slots[slot], self._next_plan()
        if plan is None:
            state.plan = None
            return None
        observation = state.world.reset(plan.seed, plan.task)
        if not _finite(observation):
            raise RuntimeError(f"{plan.task} with seed {plan.seed}: the first observation is not finite")
        origin = Origin(plan.task, plan.seed, decision=0)
        builder = SegmentBuilder(observation, self.config.segment_length, origin)
        self._slots[slot] = Slot(state.world, plan, builder)
        return self._request(self._slots[slot])

    def advance(self, slot: int, decision: Decision) -> Request | None:
        """Executes `decision`; the request is about the same episode, or the first of the next one."""
        state = self._slots[slot]
        plan, builder = state.plan, state.builder
        assert plan is not None and builder is not None
        result = self._execute(state, plan, decision.chunk)
        state.chunks.append(decision.chunk)
        self.counters.env_steps += result.steps
        self.counters.decisions += 1
        sound = np.isfinite(result.rewards).all() and _finite(result.observation)
        if result.info.get("nonfinite") or not sound:
            self.counters.dropped_nonfinite += len(builder.decisions) + 1
            if not plan.explore:  # an evaluation counts every episode it planned
                self._finish(state, plan, success=False)
            return self.start(slot)
        reward = float(result.rewards.sum())
        if (
            plan.explore
        ):  # what the learner is to maximise; an evaluation reports the environment's own return
            reward -= self.config.decision_cost
        state.episode_return += reward
        state.steps += result.steps
        state.decisions += 1
        state.versions.append(decision.version)
        spec = state.world.spec
        actions = np.clip(decision.chunk, spec.action_low, spec.action_high)
        builder.add(decision, actions, reward, result.steps, result.observation)
        if result.done or builder.full:
            self._emit(state, result)
        if result.done:
            self._finish(state, plan, result.success)
            return self.start(slot)
        return self._request(state)

    def request(self, slot: int) -> Request | None:
        """Request of the episode in `slot`; None if it waits for nothing."""
        state = self._slots[slot]
        return None if state.plan is None else self._request(state)

    def state(self) -> dict[str, Any]:
        """All that `restore` needs; see `snapshot`."""
        slots = [slot.state() for slot in self._slots]
        return {"counters": replace(self.counters), "sequence": self._sequence, "slots": slots}

    def restore(self, state: dict[str, Any]) -> None:
        """Goes on from what `state` gave: worlds are brought back by doing again what was done in them."""
        self.counters, self._sequence = state["counters"], state["sequence"]
        for slot, saved in zip(self._slots, state["slots"], strict=True):
            slot.restore(saved, self.config.segment_length)

    def close(self) -> None:
        """Closes the worlds."""
        for state in self._slots:
            state.world.close()

    def _execute(self, state: Slot, plan: EpisodePlan, actions: np.ndarray) -> ChunkResult:
        """Executes a chunk; if it is filmed, part by part, with a frame of each."""
        if plan.film is None:
            return state.world.step_chunk(actions)
        side, every = plan.film
        rewards = []
        for i in range(0, len(actions), every):
            result = state.world.step_chunk(actions[i : i + every])
            rewards.append(result.rewards)
            state.frames.append(state.world.render(side, side))
            if result.done:
                break
        return replace(result, rewards=np.concatenate(rewards))

    def _request(self, state: Slot) -> Request:
        plan, builder = state.plan, state.builder
        assert plan is not None and builder is not None
        seed = noise_seed(plan.seed, state.decisions)
        return Request(observation=builder.latest, noise_seed=seed, explore=plan.explore)

    def _emit(self, state: Slot, result: ChunkResult) -> None:
        plan, builder = state.plan, state.builder
        assert plan is not None and builder is not None
        failed = result.truncated and self.config.time_limit == "fail"
        terminated, truncated = result.terminated or failed, result.truncated and not failed
        episode: dict[str, float] = {}
        if terminated or truncated:
            episode = {name: getattr(state, name) for name in ("steps", "decisions")}
            episode = {"return": state.episode_return} | episode | {"success": float(result.success)}
        self._sequence += 1
        key = f"{self.name}.{self._sequence}"
        segment = builder.cut(key, terminated, truncated, result.success, episode)
        if plan.explore:
            self._on_segment(segment)

    def _finish(self, state: Slot, plan: EpisodePlan, success: bool) -> None:
        self.counters.episodes += 1
        versions = state.versions or [0]
        result = EpisodeResult(
            plan=plan,
            success=success,
            episode_return=state.episode_return,
            steps=state.steps,
            decisions=state.decisions,
            versions=(min(versions), max(versions)),
            frames=state.frames,
        )
        self._on_episode(result)


def _finite(observation: Observation) -> bool:
    arrays = [v for v in observation.values() if isinstance(v, np.ndarray) and v.dtype.kind == "f"]
    return all(np.isfinite(v).all() for v in arrays)
