# SPDX-License-Identifier: Apache-2.0
"""Several worlds, each somewhere between a decision and the next: the rollout worker without its process.

A slot is one world. `start` resets it and `advance` executes a decision in it; both return the request for
the next decision, and whoever drives the runner decides when that is answered: the Ray worker goes on with
other slots meanwhile, the single-process mode answers at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

import numpy as np

from accerl_lerobot.checkpoint.snapshot import kind
from accerl_lerobot.config.ranges import NonNegative, Range, Section, Steps
from accerl_lerobot.envs.base import ChunkResult, World
from accerl_lerobot.envs.reward_model import RewardModelConfig
from accerl_lerobot.experience import Decision, Observation, Origin, Request, Segment
from accerl_lerobot.rollout.segments import SegmentBuilder
from accerl_lerobot.seeds import noise_seed

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
        if not _equal(observation, self.builder.latest):
            raise RuntimeError(
                f"{plan.task} with seed {plan.seed} does not show again what it had shown after "
                f"{len(state['chunks'])} decisions, so its episodes cannot be gone on with in the middle; "
                "use launch.engine=ray, which begins them anew"
            )
        for name in _STATE:
            setattr(self, name, state[name])


def _equal(one: Observation, other: Observation) -> bool:
    return one.keys() == other.keys() and all(np.array_equal(one[key], other[key]) for key in one)


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
    an end.

    Where success is counted within a limit, a policy that gets stuck bootstraps from its own optimistic value
    with `truncate`, and failures go unpunished: on door-open, success at update 100 fell from 0.82 to 0.50
    (n = 20, one seed).
    """
    episodes: Steps = 0
    """Exploring episodes in all; 0: as many as the updates need. Once they are played, learning goes on while
    replay has something to give, which is little unless more is imagined, and then ends.
    """
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
    index: int = 0
    """Position in the evaluation it belongs to."""
    group: str = "train"
    """Which evaluation it belongs to."""
    film: tuple[int, int] | None = None
    """Side in pixels and env steps per frame of a video for people; None: none. It executes a chunk in parts,
    which changes nothing else."""


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
            failed = result.truncated and self.config.time_limit == "fail"
            ended = (result.terminated or failed, result.truncated and not failed)
            self._emit(state, plan, builder, *ended, result.success)
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
        seed = noise_seed(plan.seed, 0, state.decisions)
        return Request(observation=builder.latest, noise_seed=seed, explore=plan.explore)

    def _emit(
        self,
        state: Slot,
        plan: EpisodePlan,
        builder: SegmentBuilder,
        terminated: bool,
        truncated: bool,
        success: bool,
    ) -> None:
        self._sequence += 1
        episode = {}
        if terminated or truncated:
            episode = {
                "return": state.episode_return,
                "steps": state.steps,
                "decisions": state.decisions,
                "success": float(success),
            }
        key = f"{self.name}.{self._sequence}"
        segment = builder.cut(key, terminated, truncated, success, episode)
        if plan.explore:
            self._on_segment(segment)

    def _finish(self, state: Slot, plan: EpisodePlan, success: bool) -> None:
        self.counters.episodes += 1
        versions = state.versions or [0]
        self._on_episode(
            EpisodeResult(
                plan=plan,
                success=success,
                episode_return=state.episode_return,
                steps=state.steps,
                decisions=state.decisions,
                versions=(min(versions), max(versions)),
                frames=state.frames,
            )
        )


def _finite(observation: Observation) -> bool:
    arrays = [v for v in observation.values() if isinstance(v, np.ndarray) and v.dtype.kind == "f"]
    return all(np.isfinite(v).all() for v in arrays)
