# SPDX-License-Identifier: Apache-2.0
"""Experience that is imagined: the policy acts, and a world model says what is seen then.

A dream begins at a real observation, where an episode began if it is to be whole. What comes of it is a
segment like any other, but for its source: a success ends it, the world's time limit ends it, and where it is
to be short, or the model becomes too uncertain, V of its last observation stands for the rest. Nothing that
follows a success is imagined.

Knows no process: whoever drives it asks for `requests`, has them decided, and hands that to `advance`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from accerl_lerobot.checkpoint.tensors import copied
from accerl_lerobot.envs.base import WorldSpec
from accerl_lerobot.experience import IMAGINED, Decision, Observation, Request, Segment
from accerl_lerobot.rollout.segments import SegmentBuilder
from accerl_lerobot.world_model.baselines import OracleModel, ShuffledModel, learnt_within
from accerl_lerobot.world_model.calibration import Calibration
from accerl_lerobot.world_model.contract import Context, Dream, State, WorldModel, replaced
from accerl_lerobot.world_model.frames import observed
from accerl_lerobot.world_model.guard import DreamCounters, KillSwitch
from accerl_lerobot.world_model.imagination_config import ImaginationConfig
from accerl_lerobot.world_model.stand_in import SuccessModel, device_of
from accerl_lerobot.world_model.starts import Start, StartPool
from accerl_lerobot.world_model.store import Source, save_world_model
from accerl_lerobot.world_model.success import probabilities

if TYPE_CHECKING:
    from accerl_lerobot.world_model.online import Promotion


@dataclass(kw_only=True)
class _Row:
    builder: SegmentBuilder
    start: Start
    frames: np.ndarray
    """uint8 (V, H, W, 3), the newest."""
    potential: float
    """P(success) there."""
    ends_at: int
    """Decisions after which the world's time limit ends it."""
    depth: int = 0
    calibrates: bool = False
    """True if nothing is to be learnt from it, see `Calibration`;"""
    highest: float = 0.0
    """then, P(success) so far."""


class Dreamer(NamedTuple):
    """The model that dreams, and the one that tells successes, where that is another."""

    model: WorldModel
    success: SuccessModel | None


class Imagination:
    """A batch of dreams, each of which begins anew when it has ended.

    Example:
        >>> imagination.remember(real_segment)
        >>> requests = imagination.requests()
        >>> imagination.advance(adapter.decide(requests, version))

    Args:
        model: what dreams; in inference.
        success: what tells successes; None if `model` does.
        world: whose pictures the policy is to see.
        config: how.
        decision_cost: subtracted from every reward.
        fails: whether the world's time limit is a failure, see `RolloutConfig.time_limit`; else a truncation.
        seed: of starts and dreams.
        name: prefix of the segments' keys.
        on_segment: receives what was imagined.
        index: of several that dream beside each other with the same seed.
        ended: real episodes that must have ended before anything is calibrated: those that end first succeed.
        sources: what a model that is promoted has learnt from beside the run's own episodes.
    """

    def __init__(
        self,
        model: WorldModel,
        success: SuccessModel | None,
        world: WorldSpec,
        config: ImaginationConfig,
        *,
        decision_cost: float,
        fails: bool,
        seed: int,
        name: str,
        on_segment: Callable[[Segment], object],
        index: int = 0,
        ended: int = 1,
        sources: Sequence[Source] = (),
    ) -> None:
        self.config, self.counters = config, DreamCounters()
        # Whether there are dreams of whole episodes, which real ones can be held against.
        self._beside = config.horizon is None and config.beginnings > 0
        outcomes = config.witnesses if self._beside else config.window
        self.switch = KillSwitch(config.gap, config.window, outcomes)
        self.version = 0
        self.waits = config.learns
        """True if no model has passed its trial yet."""
        self._model, self._world = model, world
        self._success = None if "success" in model.spec.provides else success
        self._calibration = Calibration(config.calibrate if self._success is not None else 0, ended)
        self._sources = tuple(sources)
        self._cost, self._fails, self._name = decision_cost, fails, name
        self._on_segment = on_segment
        self._starts = StartPool(
            model.spec,
            memory=config.memory,
            horizon=config.horizon,
            beginnings=config.beginnings,
            keyframes=config.keyframes,
            whole=config.kind.whole,
        )
        self._rng = np.random.default_rng((seed, 3, index))
        self._rows: list[_Row | None] = [None] * config.dreams
        self._state: State | None = None
        self._sequence = self._doubted_in_a_row = 0
        self._limit = math.ceil(world.max_steps / model.spec.chunk)
        self._longest = config.horizon or self._limit

    @property
    def dreamer(self) -> Dreamer:
        """The model that dreams now, and the one that tells successes."""
        return Dreamer(self._model, self._success)

    def remember(self, segment: Segment) -> None:
        """Dreams may begin in a real segment from now on."""
        self._starts.add(segment)
        if self._beside and self.on and (segment.terminated or segment.truncated):
            self.switch.lived(segment.terminated and segment.success)

    def end_real(self) -> None:
        """No real segment will come any more: what waits for one waits no longer."""
        self._calibration.end_real()

    def swap(self, promotion: Promotion) -> None:
        """Another world model of the same world dreams from now on; dreams under way are dropped.

        A placebo goes on telling it the wrong actions.
        """
        self._rows, self._state = [None] * len(self._rows), None
        self._doubted_in_a_row = 0
        assert self._success is not None  # or there would be nothing to promote
        device = device_of(self._success)
        model: WorldModel = promotion.model.to(device)
        self._model = ShuffledModel(model) if isinstance(self._model, ShuffledModel) else model
        self._success = promotion.success.to(device)
        self.version, self.waits = promotion.version, False
        self.switch.reset()
        self._calibration.reset()

    def state(self) -> dict[str, Any]:
        """All that `restore` needs; see `snapshot`."""
        rows = [None if row is None else vars(row) | {"builder": row.builder.state()} for row in self._rows]
        promoted = None
        if self.version and self._success is not None:
            models = (copied(learnt_within(self._model)), copied(self._success))
            promoted = (*models, self._success.config.threshold)
        return {
            "counters": replace(self.counters),
            "switch": self.switch.state(),
            "calibration": self._calibration.state(),
            "version": (self.version, self.waits),
            "starts": self._starts.state(),
            "rng": self._rng,
            "rows": rows,
            "dreams": self._state,
            "sequence": (self._sequence, self._doubted_in_a_row),
            "promoted": promoted,
            "tasks": self._model.tasks if isinstance(self._model, OracleModel) else [],
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Goes on from what `state` gave, with the model that dreamt then."""
        self.counters, self._rng = state["counters"], state["rng"]
        self.switch.restore(state["switch"])
        self.version, self.waits = state["version"]
        self._starts.restore(state["starts"])
        self._sequence, self._doubted_in_a_row = state["sequence"]
        if state["promoted"] is not None and self._success is not None:
            model, success, self._success.config.threshold = state["promoted"]
            learnt_within(self._model).load_state_dict(model)
            self._success.load_state_dict(success)
        self._calibration.restore(state["calibration"])
        self._take_over()
        if isinstance(self._model, OracleModel):
            self._model.tasks = state["tasks"]
        if state["dreams"] is not None:
            device = "cpu" if self._success is None else device_of(self._success)
            self._state = {name: tensor.to(device) for name, tensor in state["dreams"].items()}
        for i, row in enumerate(state["rows"]):
            if row is not None:
                start: Start = row["start"]
                builder = SegmentBuilder({}, self._longest, start.origin, IMAGINED)
                builder.restore(row["builder"])
                self._rows[i] = _Row(**row | {"builder": builder})

    def save_promoted(self, directory: Path) -> None:
        """Writes the world model that has passed last, and its success model; nothing if none has."""
        if self.version and self._success is not None:
            save_world_model(directory, learnt_within(self._model), self._success, self._sources)

    @property
    def on(self) -> bool:
        """True if anything is to be imagined now."""
        off = self.waits or self.prepares or self.switch.tripped
        return not off and self._doubted_in_a_row < self.config.window

    @property
    def prepares(self) -> bool:
        """True if it waits for real episodes to end, by which it is to be calibrated."""
        return self._calibration.waits(self._starts.ended, self._starts.told)

    def requests(self) -> list[Request]:
        """Requests for decisions, one for each dream; none before anything real was seen, or switched off."""
        if not len(self._starts) or not self.on:
            return []
        self._begin([i for i, row in enumerate(self._rows) if row is None])
        return [
            Request(observation=row.builder.latest, noise_seed=int(self._rng.integers(2**62)))
            for row in self._rows
            if row is not None
        ]

    def advance(self, decisions: list[Decision]) -> None:
        """Dreams a chunk on in every row, with decisions in the order of `requests`."""
        assert self._state is not None
        low, high = self._world.action_low, self._world.action_high
        actions = np.stack([np.clip(d.chunk, low, high) for d in decisions]).astype(np.float32)
        seeds = self._rng.integers(2**31, size=len(actions)).tolist()
        dream = self._model.step(self._state, torch.from_numpy(actions), seeds)
        self._state = dream.state
        frames, robot = dream.frames.cpu().numpy(), dream.robot.cpu().numpy()
        said = self._said(dream, frames)
        doubt = dream.uncertainty.cpu().numpy()
        for i, decision in enumerate(decisions):
            row = self._rows[i]
            assert row is not None
            # A model without uncertainty says NaN of it, one that diverges of all else.
            broken = not (np.isfinite(robot[i]).all() and np.isfinite(said[i]))
            if doubt[i] > self.config.doubt or broken:
                self.counters.doubted += 1
                self._doubted_in_a_row = 0 if row.depth else self._doubted_in_a_row + 1
                self._end(i, row, terminated=False)
                continue
            self._doubted_in_a_row = 0
            observation = self._observation(frames[i], robot[i], row.start.task)
            over = dream.done is not None and bool(dream.done[i])
            self._step(i, row, decision, actions[i], float(said[i]), observation, over)
            row.frames = frames[i]
        if self._calibration.complete():
            self._take_over()
            self._rows = [None] * len(self._rows)

    def close(self) -> None:
        """Ends simulators, if it is they that dream."""
        if isinstance(self._model, OracleModel):
            self._model.close()

    def metrics(self) -> dict[str, float]:
        """Counters, the model's version, and the shares of successes that `guard` compares."""
        beside, real = self.switch.shares
        return {k: float(v) for k, v in asdict(self.counters).items()} | {
            "version": float(self.version),
            "threshold": self._threshold,
            "success": self.switch.share,
            "success_beside": beside,
            "success_real": real,
            "on": float(self.on),
        }

    def _step(
        self,
        i: int,
        row: _Row,
        decision: Decision,
        actions: np.ndarray,
        said: float,
        observation: Observation,
        over: bool,
    ) -> None:
        achieved = said > self._threshold and not row.calibrates
        gained = said - row.potential if self.config.reward == "potential" else float(achieved)
        row.builder.add(decision, actions, gained - self._cost, len(actions), observation)
        row.potential, row.depth = said, row.depth + 1
        row.highest = max(row.highest, said)
        self.counters.decisions += 1
        late = row.depth >= row.ends_at
        over = over and not late
        if achieved or late or over or row.depth == self.config.horizon:
            self.counters.successes += achieved
            if not row.calibrates:
                self._compare(row.start, achieved)
            terminated = achieved or over or (late and self._fails)
            self._end(i, row, terminated=terminated, truncated=late, success=achieved)

    def _compare(self, start: Start, achieved: bool) -> None:
        """Lets the kill switch know of a dream that has ended; `remember` lets it know of real episodes."""
        if self._beside:
            if not start.origin.decision:
                self.switch.dreamt(achieved)
        elif start.achieved is not None:
            self.switch.dreamt(achieved)
            self.switch.lived(start.achieved)

    def _end(
        self, i: int, row: _Row, *, terminated: bool, truncated: bool = False, success: bool = False
    ) -> None:
        self._rows[i] = None
        if row.calibrates:
            self._calibration.add(bool(row.start.achieved), row.highest)
            return
        self.counters.dreams += 1
        if not row.builder.decisions:
            return
        self._sequence += 1
        segment = row.builder.cut(
            f"{self._name}.{self._sequence}", terminated, truncated and not terminated, success
        )
        segment.world_version = self.version
        self._on_segment(segment)

    def _begin(self, rows: list[int]) -> None:
        """Fills the rows that are free."""
        if not rows:
            return
        calibrates = self._calibration.wants(self._starts.told)
        starts = self._starts.draw(len(rows), self._rng, told=calibrates)
        parts = [np.stack([getattr(s, part) for s in starts]) for part in Context._fields]
        state = self._model.begin(
            Context(*(torch.from_numpy(part) for part in parts)),
            [s.task for s in starts],
            [s.history for s in starts],
        )
        self._state = state if self._state is None else replaced(self._state, rows, state)
        newest = parts[0][:, -1]
        judge = self._success
        said = np.zeros(len(rows)) if judge is None else probabilities(judge, newest, newest)
        for i, start, frames, potential in zip(rows, starts, newest, said, strict=True):
            observation = self._observation(frames, start.robot[-1], start.task)
            self._rows[i] = _Row(
                builder=SegmentBuilder(observation, self._longest, start.origin, IMAGINED),
                start=start,
                frames=frames,
                potential=float(potential),
                ends_at=max(1, self._limit - start.origin.decision),
                calibrates=calibrates,
            )

    def _said(self, dream: Dream, frames: np.ndarray) -> np.ndarray:
        """P(success) of each row, (B,)."""
        if self._success is None:
            assert dream.success is not None  # as `check_fit` has found
            return dream.success.cpu().numpy()
        return probabilities(self._success, np.stack([r.frames for r in self._rows if r is not None]), frames)

    def _take_over(self) -> None:
        """Takes over calibration's threshold, if there is one."""
        if self._success is not None and self._calibration.threshold is not None:
            self._success.config.threshold = self._calibration.threshold

    @property
    def _threshold(self) -> float:
        return 0.5 if self._success is None else self._success.config.threshold

    def _observation(self, frames: np.ndarray, robot: np.ndarray, task: str) -> Observation:
        return observed(frames, robot, task, self._model.spec, self._world)
