# SPDX-License-Identifier: Apache-2.0
"""An environment that follows a script, and decisions made of nothing."""

from typing import Any

import numpy as np

from accerl_lerobot.envs import ChunkResult, Environment, EnvironmentSpec
from accerl_lerobot.experience import TASK, Decision, Observation, Request
from accerl_lerobot.rollout.runner import (
    EpisodePlan,
    EpisodePlans,
    EpisodeResult,
    RolloutConfig,
    RolloutRunner,
)

CHUNK = 2
CAMERA = "observation.images.front"


class ScriptedEnvironment(Environment):
    """Every step earns 1; an episode ends after `steps` steps in the way `end` says.

    ``observation.state`` is (seed, steps so far), which names every observation. The way is ``success``,
    ``failure`` (both terminate) or ``limit`` (truncates). At step `nan_at`, if it is not 0, the ``reward``,
    the ``state`` or that of the ``simulator`` is no number.
    """

    def __init__(self, steps: int = 5, end: str = "success", nan_at: int = 0, nan_in: str = "reward") -> None:
        self.steps, self.end, self.nan_at, self.nan_in = steps, end, nan_at, nan_in
        one = np.ones(1, np.float32)
        self.spec = EnvironmentSpec(
            images={CAMERA: (8, 8, 3)}, state_dim=2, action_dim=1, action_low=-one, action_high=one,
            fps=10, max_steps=steps, tasks=("push", "pull"),
        )  # fmt: skip

    def reset(self, seed: int, task: str) -> Observation:
        self.seed, self.task, self.now = seed, task, 0
        return self._observe()

    def step_chunk(self, actions: np.ndarray) -> ChunkResult:
        rewards = np.ones(min(len(actions), self.steps - self.now), np.float32)
        broken = self.nan_in if self.now < self.nan_at <= self.now + len(rewards) else ""
        self.now += len(rewards)
        over, observation = self.now == self.steps, self._observe()
        if broken == "reward":
            rewards[-1] = np.nan
        if broken == "state":
            observation["observation.state"] = np.full(2, np.nan, np.float32)
        return ChunkResult(
            observation=observation,
            rewards=rewards,
            terminated=over and self.end != "limit",
            truncated=over and self.end == "limit",
            success=over and self.end == "success",
            finite=broken != "simulator",
        )

    def render(self, height: int, width: int) -> np.ndarray:
        return np.full((height, width, 3), self.now, np.uint8)

    def _observe(self) -> Observation:
        state = np.array([self.seed, self.now], np.float32)
        return {CAMERA: self.render(8, 8), "observation.state": state, TASK: self.task}


def decide(request: Request, version: int = 0) -> Decision:
    """A decision whose latent and log-prob are the step it was made at."""
    step = float(np.asarray(request.observation["observation.state"])[1])
    return Decision(
        chunk=np.zeros((CHUNK, 1), np.float32),
        latent={"x": np.array([step, step], np.float32)},
        log_prob=np.array([-step], np.float32),
        version=version,
    )


class Recorder:
    """A runner of these environments, one per slot, whose plans, segments and results are at hand."""

    def __init__(
        self, environments: list[Environment], plans: list[EpisodePlan], config: RolloutConfig
    ) -> None:
        self.plans = EpisodePlans(("push", "pull", "match"), 0, None)
        self.plans.queue(plans)
        self.runner = RolloutRunner(environments, self.plans, config)
        self.segments, self.results = self.runner.segments, self.runner.results

    def play(self) -> list[Request]:
        """Runs all plans, slot by slot in turn; all requests that were made."""
        made: list[Request] = []
        due = {slot: self.runner.begin_episode(slot) for slot in range(len(self.runner))}
        while any(due.values()):
            for slot, request in due.items():
                if request is not None:
                    made.append(request)
                    due[slot] = self.runner.advance(slot, decide(request))
        return made


def explore(seed: int = 1, task: str = "push") -> EpisodePlan:
    return EpisodePlan(task=task, seed=seed, explore=True)


def evaluate(seed: int = 1, index: int = 0, task: str = "push") -> EpisodePlan:
    return EpisodePlan(task=task, seed=seed, explore=False, index=index, group="eval")


def ended(plan: EpisodePlan, **fields: Any) -> EpisodeResult:
    """The result of a short episode that succeeded, unless `fields` say otherwise."""
    defaults = {"success": True, "episode_return": 0.0, "steps": 3, "decisions": 1, "versions": (0, 0)}
    return EpisodeResult(plan=plan, **defaults | fields)
