# SPDX-License-Identifier: Apache-2.0
"""Imagined rollouts: the policy acts, and a world model predicts what it observes.

A rollout starts where a real episode began. Its segment is like any other, but for its source: a success ends
it, the environment's time limit ends it, and where the model becomes too uncertain, V of its last observation
stands for the rest. Nothing that follows a success is imagined.

No process is known here: the caller asks for `requests`, has them decided, and hands the decisions to
`advance`.

Shapes: see `contract.py`; T decisions of a segment.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from accerl_lerobot.checkpoint.snapshot import kind
from accerl_lerobot.checkpoint.tensors import copied
from accerl_lerobot.envs.base import WorldSpec
from accerl_lerobot.experience import IMAGINED, Decision, Observation, Origin, Request, Segment
from accerl_lerobot.rollout.segments import SegmentBuilder
from accerl_lerobot.world_model.config import IMAGINATION, ImaginationConfig
from accerl_lerobot.world_model.contract import (
    Context,
    Prediction,
    Reset,
    State,
    WorldModel,
    WorldModelSpec,
    replace_rows,
)
from accerl_lerobot.world_model.data import model_arrays, policy_observation
from accerl_lerobot.world_model.registry import (
    ImaginationModels,
    OracleModel,
    ShuffledModel,
    learned_part,
)
from accerl_lerobot.world_model.store import Source, save_world_model
from accerl_lerobot.world_model.success_plugin.modeling_success_pairs import probabilities

if TYPE_CHECKING:
    from accerl_lerobot.world_model.online import Promotion


@kind
@dataclass(frozen=True, kw_only=True)
class Start:
    """The first observation of a real episode."""

    frames: np.ndarray
    """uint8 (V, H, W, 3), of the model's size."""
    robot: np.ndarray
    """float32 (S,)."""
    task: str
    """The instruction."""
    origin: Origin


class StartPool:
    """Resets of the newest real episodes."""

    def __init__(self, spec: WorldModelSpec, memory: int) -> None:
        self._spec = spec
        self.held: deque[Start] = deque(maxlen=memory)

    def __len__(self) -> int:
        return len(self.held)

    def add(self, segment: Segment) -> None:
        """Takes a real segment, if its episode begins with it; the oldest ones leave."""
        if segment.origin.decision:
            return
        first = {name: rows[:1] for name, rows in segment.observations.items()}
        frames, robot = model_arrays(first, self._spec)
        self.held.append(Start(frames=frames[0], robot=robot[0], task=segment.task, origin=segment.origin))

    def draw(self, count: int, rng: np.random.Generator) -> list[Start]:
        """Draws starts, with repetition; there must be some."""
        return [self.held[i] for i in rng.integers(len(self.held), size=count)]

    def context(self, starts: Sequence[Start]) -> Context:
        """A world model's context: nothing has moved before a reset, and no action was executed."""
        b, spec = len(starts), self._spec
        frames, robot = (np.stack([getattr(start, name) for start in starts]) for name in ("frames", "robot"))
        return Context(
            frames=torch.from_numpy(np.repeat(frames[:, None], spec.context, 1)),
            robot=torch.from_numpy(np.repeat(robot[:, None], spec.context, 1)),
            actions=torch.zeros(b, spec.context - 1, spec.chunk, spec.action_dim),
            commanded_sum=torch.zeros(b, spec.action_dim),
            initial_state=torch.from_numpy(robot),
        )


@kind
@dataclass
class ImaginationCounters:
    """Counters of imagined rollouts so far."""

    rollouts: int = 0
    """Ended rollouts."""
    decisions: int = 0
    successes: int = 0
    uncertain: int = 0
    """Rollouts that ended before a prediction that was too uncertain."""


class KillSwitch:
    """Trips when imagined rollouts succeed too much more often than real episodes.

    Each real outcome is compared with the success rate of imagined rollouts at that time. As both are of
    nearly the same policy, a policy that improves does not trip the switch.

    Args:
        max_gap: largest difference of the two success rates.
        window: imagined rollouts over which their rate is taken; until it is full, nothing is compared.
        outcomes: real outcomes over which the difference is taken; the same holds for them.
    """

    def __init__(self, max_gap: float, window: int, outcomes: int) -> None:
        self.max_gap, self.tripped = max_gap, False
        self._rollouts: deque[bool] = deque(maxlen=window)
        self._pairs: deque[tuple[float, bool]] = deque(maxlen=outcomes)
        # Kept as numbers, as they are read on another thread too.
        self._share = self._imagined = self._real = float("nan")

    def add_imagined(self, success: bool) -> None:
        """Takes the outcome of an imagined rollout."""
        self._rollouts.append(success)
        self._share = sum(self._rollouts) / len(self._rollouts)

    def add_real(self, success: bool) -> None:
        """Takes a real outcome; it does not count before the window is full."""
        if len(self._rollouts) < (self._rollouts.maxlen or 0):
            return
        self._pairs.append((self._share, success))
        count = len(self._pairs)
        self._imagined = sum(share for share, _ in self._pairs) / count
        self._real = sum(real for _, real in self._pairs) / count
        if count == self._pairs.maxlen and self._imagined - self._real > self.max_gap:
            self.tripped = True

    def reset(self) -> None:
        """Starts again for another world model; unless it has tripped, pairs of the last one still count."""
        self._rollouts.clear()
        self._share = float("nan")
        if self.tripped:
            self._pairs.clear()
            self._imagined = self._real = float("nan")
        self.tripped = False

    def state(self) -> dict[str, Any]:
        """All that `restore` needs; see `snapshot`."""
        shares = (self._share, self._imagined, self._real, self.tripped)
        return {"rollouts": list(self._rollouts), "pairs": list(self._pairs), "shares": shares}

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from a `state`."""
        self._rollouts.extend(state["rollouts"])
        self._pairs.extend(state["pairs"])
        self._share, self._imagined, self._real, self.tripped = state["shares"]

    @property
    def share(self) -> float:
        """Success rate of the newest imagined rollouts; NaN before there are any."""
        return self._share

    @property
    def shares(self) -> tuple[float, float]:
        """Success rates, imagined and real, at the same times; NaN before there are any."""
        return self._imagined, self._real


class RolloutSettings(NamedTuple):
    """Settings that imagined rollouts share with the real ones of their run."""

    decision_cost: float
    """Subtracted from every reward."""
    time_limit_fails: bool
    """True if the time limit is a failure, False if it truncates; see `RolloutConfig.time_limit`."""
    seed: int


@dataclass(kw_only=True)
class _Row:
    builder: SegmentBuilder
    start: Start
    frames: np.ndarray
    """uint8 (V, H, W, 3), the newest."""
    depth: int = 0


class Imagination:
    """A batch of imagined rollouts, each of which starts anew when it has ended.

    Example:
        >>> imagination.remember(real_segment)
        >>> requests = imagination.requests()
        >>> imagination.advance(adapter.decide(requests, version))

    `on_segment` receives the imagined segments; `sources` are saved with a model that is promoted.
    """

    def __init__(
        self,
        models: ImaginationModels,
        world: WorldSpec,
        config: ImaginationConfig,
        run: RolloutSettings,
        on_segment: Callable[[Segment], object],
        sources: Sequence[Source] = (),
    ) -> None:
        self.config, self.counters = config, ImaginationCounters()
        self.switch = KillSwitch(config.max_gap, config.window, config.min_real_episodes)
        self.version = 0
        self.awaits_model = config.learns
        """True if no model has passed validation yet."""
        self._model, self._world = models.model, world
        self._success = None if "success" in models.model.spec.provides else models.success
        self._sources = tuple(sources)
        self._run, self._on_segment = run, on_segment
        self._starts = StartPool(models.model.spec, config.memory)
        self._rng = np.random.default_rng((run.seed, 3))
        self._rows: list[_Row | None] = [None] * config.rollouts
        self._state: State | None = None
        self._sequence = self._uncertain_in_a_row = 0
        self._limit = math.ceil(world.max_steps / models.model.spec.chunk)

    @property
    def models(self) -> ImaginationModels:
        """The models in use."""
        return ImaginationModels(self._model, self._success)

    def remember(self, segment: Segment) -> None:
        """Lets rollouts start in a real segment."""
        self._starts.add(segment)
        if self.on and (segment.terminated or segment.truncated):
            self.switch.add_real(segment.terminated and segment.success)

    def swap(self, promotion: Promotion) -> None:
        """Replaces the models; unfinished rollouts are dropped. A placebo stays one."""
        self._rows, self._state = [None] * len(self._rows), None
        self._uncertain_in_a_row = 0
        assert self._success is not None  # or there would be nothing to promote
        device = self._success.out.weight.device
        model: WorldModel = promotion.model.to(device)
        self._model = ShuffledModel(model) if isinstance(self._model, ShuffledModel) else model
        self._success = promotion.success.to(device)
        self.version, self.awaits_model = promotion.version, False
        self.switch.reset()

    def state(self) -> dict[str, Any]:
        """All that `restore` needs; see `snapshot`."""
        rows = [None if row is None else vars(row) | {"builder": row.builder.state()} for row in self._rows]
        promoted = None
        if self.version and self._success is not None:
            models = (copied(learned_part(self._model)), copied(self._success))
            promoted = (*models, self._success.config.threshold)
        return {
            "counters": replace(self.counters),
            "switch": self.switch.state(),
            "version": (self.version, self.awaits_model),
            "starts": list(self._starts.held),
            "rng": self._rng,
            "rows": rows,
            "model_state": self._state,
            "sequence": (self._sequence, self._uncertain_in_a_row),
            "promoted": promoted,
            "tasks": self._model.tasks if isinstance(self._model, OracleModel) else [],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from a `state`, with the models of then."""
        self.counters, self._rng = state["counters"], state["rng"]
        self.switch.restore(state["switch"])
        self.version, self.awaits_model = state["version"]
        self._starts.held.extend(state["starts"])
        self._sequence, self._uncertain_in_a_row = state["sequence"]
        if state["promoted"] is not None and self._success is not None:
            model, success, self._success.config.threshold = state["promoted"]
            learned_part(self._model).load_state_dict(model)
            self._success.load_state_dict(success)
        if isinstance(self._model, OracleModel):
            self._model.tasks = state["tasks"]
        if state["model_state"] is not None:
            device = "cpu" if self._success is None else self._success.out.weight.device
            self._state = {name: tensor.to(device) for name, tensor in state["model_state"].items()}
        for i, row in enumerate(state["rows"]):
            if row is not None:
                start: Start = row["start"]
                builder = SegmentBuilder({}, self._limit, start.origin, IMAGINED)
                builder.restore(row["builder"])
                self._rows[i] = _Row(**row | {"builder": builder})

    def save_promoted(self, directory: Path) -> None:
        """Saves the models that were promoted last; nothing if none were."""
        if self.version and self._success is not None:
            save_world_model(directory, learned_part(self._model), self._success, self._sources)

    @property
    def on(self) -> bool:
        """True if anything is to be imagined now."""
        if self.awaits_model or self.switch.tripped:
            return False
        return self._uncertain_in_a_row < self.config.window

    def requests(self) -> list[Request]:
        """Requests for decisions, one per rollout; none before there is a real segment, or switched off."""
        if not len(self._starts) or not self.on:
            return []
        self._begin([i for i, row in enumerate(self._rows) if row is None])
        return [
            Request(observation=row.builder.latest, noise_seed=int(self._rng.integers(2**62)))
            for row in self._rows
            if row is not None
        ]

    def advance(self, decisions: list[Decision]) -> None:
        """Imagines one chunk in every rollout, with decisions in the order of `requests`."""
        assert self._state is not None
        low, high = self._world.action_low, self._world.action_high
        actions = np.stack([np.clip(d.chunk, low, high) for d in decisions]).astype(np.float32)
        seeds = self._rng.integers(2**31, size=len(actions)).tolist()
        prediction = self._model.step(self._state, torch.from_numpy(actions), seeds)
        self._state = prediction.state
        frames, robot = prediction.frames.cpu().numpy(), prediction.robot.cpu().numpy()
        success = self._success_probability(prediction, frames)
        uncertainty = prediction.uncertainty.cpu().numpy()
        for i, decision in enumerate(decisions):
            row = self._rows[i]
            assert row is not None
            # NaN: of the uncertainty, there is none; of all else, the model has diverged.
            broken = not (np.isfinite(robot[i]).all() and np.isfinite(success[i]))
            if uncertainty[i] > self.config.max_uncertainty or broken:
                self.counters.uncertain += 1
                self._uncertain_in_a_row = 0 if row.depth else self._uncertain_in_a_row + 1
                self._end(i, row, terminated=False)
                continue
            self._uncertain_in_a_row = 0
            observation = self._observation(frames[i], robot[i], row.start.task)
            achieved = float(success[i]) > self._threshold
            reward = float(achieved) - self._run.decision_cost
            row.builder.add(decision, actions[i], reward, len(actions[i]), observation)
            row.depth += 1
            row.frames = frames[i]
            self.counters.decisions += 1
            done = prediction.done is not None and bool(prediction.done[i])
            self._end_if_over(i, row, achieved, done)

    def close(self) -> None:
        """Closes simulators, if the model has any."""
        if isinstance(self._model, OracleModel):
            self._model.close()

    def metrics(self) -> dict[str, float]:
        """Counters, the model's version, and the success rates that the kill switch compares."""
        imagined, real = self.switch.shares
        return {k: float(v) for k, v in asdict(self.counters).items()} | {
            "version": float(self.version),
            "threshold": self._threshold,
            "success": self.switch.share,
            "success_imagined": imagined,
            "success_real": real,
            "on": float(self.on),
        }

    def _end_if_over(self, i: int, row: _Row, achieved: bool, done: bool) -> None:
        late = row.depth >= self._limit
        done = done and not late
        if achieved or late or done:
            self.counters.successes += achieved
            self.switch.add_imagined(achieved)
            terminated = achieved or done or (late and self._run.time_limit_fails)
            self._end(i, row, terminated=terminated, truncated=late, success=achieved)

    def _end(
        self, i: int, row: _Row, *, terminated: bool, truncated: bool = False, success: bool = False
    ) -> None:
        self._rows[i] = None
        self.counters.rollouts += 1
        if not row.builder.decisions:
            return
        self._sequence += 1
        segment = row.builder.cut(
            f"{IMAGINATION}.{self._sequence}", terminated, truncated and not terminated, success
        )
        segment.world_version = self.version
        self._on_segment(segment)

    def _begin(self, rows: list[int]) -> None:
        """Starts rollouts in free rows."""
        if not rows:
            return
        starts = self._starts.draw(len(rows), self._rng)
        resets = [Reset(*start.origin[:2]) for start in starts]
        state = self._model.begin(self._starts.context(starts), [start.task for start in starts], resets)
        self._state = state if self._state is None else replace_rows(self._state, rows, state)
        for i, start in zip(rows, starts, strict=True):
            observation = self._observation(start.frames, start.robot, start.task)
            self._rows[i] = _Row(
                builder=SegmentBuilder(observation, self._limit, start.origin, IMAGINED),
                start=start,
                frames=start.frames,
            )

    def _success_probability(self, prediction: Prediction, frames: np.ndarray) -> np.ndarray:
        """P(success) of each row, (B,)."""
        if self._success is None:
            assert prediction.success is not None  # as `check_fit` has found
            return prediction.success.cpu().numpy()
        before = np.stack([row.frames for row in self._rows if row is not None])
        return probabilities(self._success, before, frames)

    @property
    def _threshold(self) -> float:
        return 0.5 if self._success is None else self._success.config.threshold

    def _observation(self, frames: np.ndarray, robot: np.ndarray, task: str) -> Observation:
        return policy_observation(frames, robot, task, self._model.spec, self._world)
