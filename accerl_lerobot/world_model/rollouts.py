# SPDX-License-Identifier: Apache-2.0
"""Imagined rollouts: the policy acts, and a world model predicts what it observes.

A rollout starts at a real observation. Its segment is like any other, but for its source: a success ends it,
the environment's time limit ends it, and where the model becomes too uncertain, V of its last observation
stands for the rest. Nothing that follows a success is imagined.

No process is known here: the caller asks for `requests`, has them decided, and hands the decisions to
`advance`.

Start states of imagined rollouts: real observations, drawn at resets or anywhere.

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
    ActionHistory,
    Context,
    Prediction,
    State,
    WorldModel,
    WorldModelSpec,
    replace_rows,
)
from accerl_lerobot.world_model.data import executed_actions, model_arrays, policy_observation
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


EpisodeName = tuple[str, int]
"""Task and seed."""
MAX_UNFINISHED = 1024
"""Episodes that may go on in another segment; of more, such as those of a worker that died, the oldest are
dropped."""


@kind
@dataclass(frozen=True, kw_only=True)
class Start:
    """A real observation, and what led there."""

    frames: np.ndarray
    """uint8 (L, V, H, W, 3), of the model's size, the newest last."""
    robot: np.ndarray
    """float32 (L, S)."""
    actions: np.ndarray
    """float32 (L − 1, K, A), executed between these."""
    commanded_sum: np.ndarray
    """float32 (A,), see `Context`."""
    initial_state: np.ndarray
    """float32 (S,), see `Context`."""
    task: str
    """The instruction."""
    origin: Origin
    history: ActionHistory | None
    """None: the segment began in mid-episode, and what came before is not known."""
    achieved: bool | None
    """True if the real episode achieved the task; None: not known, or not yet."""


@kind
class _Lead(NamedTuple):
    """Summary of the observations before a segment, which may begin in mid-episode."""

    decision: int
    """The segment's first."""
    commanded_sum: np.ndarray
    initial_state: np.ndarray


class StartPool:
    """The newest real decisions; `ImaginationConfig` says how many, and where rollouts start."""

    def __init__(self, spec: WorldModelSpec, config: ImaginationConfig) -> None:
        self.spec, self.config = spec, config
        self._held: deque[_Held] = deque()
        self._leads: dict[EpisodeName, _Lead] = {}
        """Leads to the next segment of episodes that have not ended; the oldest first."""
        self._outcomes: dict[EpisodeName, bool] = {}
        """Outcomes of episodes that have ended, and of which something is held."""
        self._count = 0

    def __len__(self) -> int:
        """Decisions to start at."""
        return self._count

    def add(self, segment: Segment) -> None:
        """Takes a real segment; the oldest ones leave."""
        held = _Held(segment, self.spec)
        self._link(held)
        usable = not self.config.kind.needs_history and len(segment) >= self.spec.context
        if not segment.origin.decision or usable:
            self._held.append(held)
            self._count += len(segment)
        names = [held.name for held in self._held]
        if (segment.terminated or segment.truncated) and held.name in names:
            self._outcomes[held.name] = segment.terminated and segment.success
        while self._held and self._count - len(self._held[0].segment) >= self.config.memory:
            gone = self._held.popleft()
            self._count -= len(gone.segment)
            names.pop(0)
            if gone.name not in names:
                self._outcomes.pop(gone.name, None)

    def state(self) -> dict[str, Any]:
        """All that `restore` needs; see `snapshot`."""
        held = [(held.segment, held.lead) for held in self._held]
        return {"held": held, "leads": dict(self._leads), "outcomes": dict(self._outcomes)}

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from a `state`."""
        self._held.extend(_Held(segment, self.spec, lead) for segment, lead in state["held"])
        self._leads.update(state["leads"])
        self._count = sum(len(held.segment) for held in self._held)
        self._outcomes = state["outcomes"]

    def _link(self, held: _Held) -> None:
        """Sets the segment's lead, and keeps the lead to the next one."""
        segment, name = held.segment, held.name
        lead = self._leads.pop(name, None)
        if lead is not None and lead.decision == segment.origin.decision:
            held.lead = lead
        if segment.terminated or segment.truncated:
            return
        total = held.lead.commanded_sum + executed_actions(segment.actions, segment.steps).sum(0)
        self._leads[name] = _Lead(segment.origin.decision + len(segment), total, held.lead.initial_state)
        if len(self._leads) > MAX_UNFINISHED:
            self._leads.pop(next(iter(self._leads)))

    def draw(self, count: int, rng: np.random.Generator) -> list[Start]:
        """Draws starts, with repetition.

        Raises:
            ValueError: there are none yet.
        """
        if not self._count:
            raise ValueError("no real experience to start from yet")
        lengths = np.array([len(h.segment) for h in self._held])
        allowed = np.concatenate([h.allowed for h in self._held])
        weights = allowed / max(1, allowed.sum())
        first = np.concatenate([h.first for h in self._held])
        if first.any():
            reset = self.config.start_at_reset_prob
            weights = reset * first / first.sum() + (1 - reset) * weights
        drawn = rng.choice(self._count, size=count, p=weights / weights.sum())
        ends = np.cumsum(lengths)
        of = np.searchsorted(ends, drawn, side="right")
        return [
            self._start(self._held[s], int(i - ends[s] + lengths[s])) for s, i in zip(of, drawn, strict=True)
        ]

    def _start(self, held: _Held, t: int) -> Start:
        segment, spec = held.segment, self.spec
        context = [max(0, t - back) for back in range(spec.context - 1, -1, -1)]
        history, actions = None, executed_actions(segment.actions[:t], segment.steps[:t])
        if not segment.origin.decision:
            history = ActionHistory(segment.origin.task, segment.origin.seed, actions)
        return Start(
            frames=held.frames[context],
            robot=held.robot[context],
            actions=_chunks_before(segment, t, spec.context),
            commanded_sum=held.lead.commanded_sum + actions.sum(0),
            initial_state=held.lead.initial_state,
            task=segment.task,
            origin=segment.origin._replace(decision=segment.origin.decision + t),
            history=history,
            achieved=self._outcomes.get(held.name),
        )


def _chunks_before(segment: Segment, t: int, context: int) -> np.ndarray:
    """Chunks of the decisions before the t-th, zero before the segment began."""
    chunks = np.zeros((context - 1, *segment.actions.shape[1:]), np.float32)
    known = min(t, context - 1)
    if known:
        chunks[-known:] = segment.actions[t - known : t]
    return chunks


class _Held:
    """A segment as arrays of the model; without a `lead` its episode begins with it, as far as is known."""

    def __init__(self, segment: Segment, spec: WorldModelSpec, lead: _Lead | None = None) -> None:
        self.segment, self.name = segment, segment.origin[:2]
        self.first = segment.origin.decision + np.arange(len(segment)) == 0
        self.frames, self.robot = model_arrays(segment.observations, spec)
        nothing = np.zeros(spec.action_dim, np.float32)
        self.lead = lead or _Lead(segment.origin.decision, nothing, self.robot[0])
        # In mid-episode, the context of the first decisions of a segment is not known.
        self.allowed = np.ones(len(segment), bool)
        if segment.origin.decision:
            self.allowed[: spec.context - 1] = False


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
    ends_at: int
    """Decisions after which the time limit ends it."""
    depth: int = 0


class Imagination:
    """A batch of imagined rollouts, each of which starts anew when it has ended.

    Example:
        >>> imagination.remember(real_segment)
        >>> requests = imagination.requests()
        >>> imagination.advance(adapter.decide(requests, version))

    Args:
        models: in eval mode.
        world: spec of the policy's environment.
        config: of imagination.
        run: settings of the run.
        on_segment: receives the imagined segments.
        sources: datasets that a promoted model was trained on, beside the run's own episodes.
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
        # True if some rollouts are whole episodes, which can be compared with real ones of the same time.
        self._compares_whole = config.start_at_reset_prob > 0
        outcomes = config.min_real_episodes if self._compares_whole else config.window
        self.switch = KillSwitch(config.max_gap, config.window, outcomes)
        self.version = 0
        self.awaits_model = config.learns
        """True if no model has passed validation yet."""
        self._model, self._world = models.model, world
        self._success = None if "success" in models.model.spec.provides else models.success
        self._sources = tuple(sources)
        self._run, self._on_segment = run, on_segment
        self._starts = StartPool(models.model.spec, config)
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
        if self._compares_whole and self.on and (segment.terminated or segment.truncated):
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
            "starts": self._starts.state(),
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
        self._starts.restore(state["starts"])
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
        late = row.depth >= row.ends_at
        done = done and not late
        if achieved or late or done:
            self.counters.successes += achieved
            self._compare(row.start, achieved)
            terminated = achieved or done or (late and self._run.time_limit_fails)
            self._end(i, row, terminated=terminated, truncated=late, success=achieved)

    def _compare(self, start: Start, achieved: bool) -> None:
        """Reports an ended rollout to the kill switch; `remember` reports real episodes."""
        if self._compares_whole:
            if not start.origin.decision:
                self.switch.add_imagined(achieved)
        elif start.achieved is not None:
            self.switch.add_imagined(achieved)
            self.switch.add_real(start.achieved)

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
        parts = [np.stack([getattr(s, part) for s in starts]) for part in Context._fields]
        state = self._model.begin(
            Context(*(torch.from_numpy(part) for part in parts)),
            [s.task for s in starts],
            [s.history for s in starts],
        )
        self._state = state if self._state is None else replace_rows(self._state, rows, state)
        for i, start in zip(rows, starts, strict=True):
            frames = start.frames[-1]
            observation = self._observation(frames, start.robot[-1], start.task)
            self._rows[i] = _Row(
                builder=SegmentBuilder(observation, self._limit, start.origin, IMAGINED),
                start=start,
                frames=frames,
                ends_at=max(1, self._limit - start.origin.decision),
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
