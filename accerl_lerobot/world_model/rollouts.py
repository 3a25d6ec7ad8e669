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
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from accerl_lerobot.checkpoint.snapshot import kind
from accerl_lerobot.checkpoint.tensors import copied
from accerl_lerobot.envs.base import EnvironmentSpec
from accerl_lerobot.experience import (
    IMAGINED,
    TASK,
    Decision,
    Observation,
    Request,
    Segment,
    SegmentStart,
    task_codes,
)
from accerl_lerobot.rollout.runner import SegmentBuilder
from accerl_lerobot.world_model.config import IMAGINATION, ImaginationConfig
from accerl_lerobot.world_model.contract import (
    Context,
    Reset,
    State,
    WorldModel,
    WorldModelSpec,
    replace_rows,
)
from accerl_lerobot.world_model.data import model_arrays, resize
from accerl_lerobot.world_model.reference import OracleModel, ShuffledModel, learned_part
from accerl_lerobot.world_model.store import note_failed, save_world_model
from accerl_lerobot.world_model.success_model import SuccessPairsRewardModel

if TYPE_CHECKING:
    from accerl_lerobot.world_model.online import Promotion


@kind
class Start(NamedTuple):
    """The first observation of a real episode."""

    frames: np.ndarray  # uint8 (V, H, W, 3), of the model's size
    robot: np.ndarray  # float32 (S,)
    task: str  # the instruction
    origin: SegmentStart


def start_of(segment: Segment, spec: WorldModelSpec) -> Start:
    """The start of a rollout, from the first segment of a real episode."""
    first = {name: rows[:1] for name, rows in segment.observations.items()}
    frames, robot = model_arrays(first, spec)
    return Start(frames[0], robot[0], segment.task, segment.origin)


def context_at(starts: Sequence[Start], spec: WorldModelSpec) -> Context:
    """A world model's context: nothing has moved before a reset, and no action was executed."""
    frames = torch.from_numpy(np.stack([start.frames for start in starts]))
    robot = torch.from_numpy(np.stack([start.robot for start in starts]))
    return Context(
        frames=frames[:, None].repeat(1, spec.context, 1, 1, 1, 1),
        robot=robot[:, None].repeat(1, spec.context, 1),
        actions=torch.zeros(len(starts), spec.context - 1, spec.chunk, spec.action_dim),
        commanded_sum=torch.zeros(len(starts), spec.action_dim),
        initial_state=robot,
    )


@kind
@dataclass
class KillSwitch:
    """Trips when imagined rollouts succeed too much more often than real episodes.

    Each real outcome is compared with the success rate of imagined rollouts at that time. As both are of
    nearly the same policy, a policy that improves does not trip the switch. Lists are replaced and never
    changed, as another thread reads the rates.
    """

    max_gap: float  # largest difference of the two success rates
    window: int  # newest imagined rollouts whose rate is taken; until there are so many, nothing is compared
    min_real: int  # newest real outcomes over which the difference is taken; the same holds for them
    rollouts: list[bool] = field(default_factory=list)
    pairs: list[tuple[float, float]] = field(default_factory=list)  # rate of imagined ones, real outcome
    tripped: bool = False

    @property
    def share(self) -> float:
        """Success rate of the newest imagined rollouts; NaN before there are any."""
        rollouts = self.rollouts
        return sum(rollouts) / len(rollouts) if rollouts else math.nan

    @property
    def shares(self) -> tuple[float, float]:
        """Success rates, imagined and real, at the same times; NaN before there are any."""
        pairs = self.pairs or [(math.nan, math.nan)]
        imagined, real = (sum(column) / len(pairs) for column in zip(*pairs, strict=True))
        return imagined, real

    def add_imagined(self, success: bool) -> None:
        """Takes the outcome of an imagined rollout."""
        self.rollouts = [*self.rollouts, success][-self.window :]

    def add_real(self, success: bool) -> None:
        """Takes a real outcome; it does not count before the window is full."""
        if len(self.rollouts) < self.window:
            return
        self.pairs = [*self.pairs, (self.share, success)][-self.min_real :]
        imagined, real = self.shares
        self.tripped |= len(self.pairs) == self.min_real and imagined - real > self.max_gap

    def reset(self) -> None:
        """Starts again for another world model; unless it has tripped, pairs of the last one still count."""
        self.rollouts = []
        if self.tripped:
            self.pairs = []
        self.tripped = False


class Imagination:
    """A batch of imagined rollouts, each of which starts anew when it has ended.

    Without `success`, the model classifies successes itself. `decision_cost` is subtracted from every reward,
    and the time limit ends a rollout as a failure.
    """

    def __init__(
        self,
        model: WorldModel,
        success: SuccessPairsRewardModel | None,
        environment: EnvironmentSpec,
        config: ImaginationConfig,
        on_segment: Callable[[Segment], object],
        *,
        decision_cost: float,
        seed: int,
    ) -> None:
        self.config = config
        self.counters = {"rollouts": 0, "decisions": 0, "successes": 0, "uncertain": 0}
        self.switch = KillSwitch(config.max_gap, config.window, config.min_real_episodes)
        self.version, self.awaits_model = 0, config.learns  # true until a model has passed validation
        self._model, self._success, self._environment = model, success, environment
        self._roles: dict[str, str] = {}  # of episodes, see `Promotion`
        self._on_segment = on_segment
        self._decision_cost = decision_cost
        self._starts: deque[Start] = deque(maxlen=config.memory)
        self._rng = np.random.default_rng((seed, 3))
        self._rows: list[SegmentBuilder | None] = [None] * config.rollouts
        self._state: State | None = None
        frames = (config.rollouts, len(model.spec.cameras), *model.spec.image_size, 3)
        self._frames = np.zeros(frames, np.uint8)  # the newest of each row
        self._sequence = self._uncertain_in_a_row = 0
        self._max_steps = environment.max_steps
        self._limit = math.ceil(environment.max_steps / model.spec.chunk)

    def remember(self, segment: Segment) -> None:
        """Lets rollouts start where a real segment does, if its episode begins with it."""
        if not segment.origin.decision:
            self._starts.append(start_of(segment, self._model.spec))
        if self.on and segment.terminated:
            self.switch.add_real(segment.success)

    def swap(self, promotion: Promotion) -> None:
        """Replaces the models; unfinished rollouts are dropped. A placebo stays one."""
        assert self._success is not None  # or there would be nothing to promote
        self._rows, self._state, self._uncertain_in_a_row = [None] * len(self._rows), None, 0
        device = self._success.out.weight.device
        model = promotion.model.to(device)
        self._model = ShuffledModel(model) if isinstance(self._model, ShuffledModel) else model
        self._success = promotion.success.to(device)
        self.version, self.awaits_model, self._roles = promotion.version, False, promotion.roles
        self.switch.reset()

    def state(self) -> dict[str, Any]:
        """All that `restore` needs; see `snapshot`."""
        promoted = None
        if self.version and self._success is not None:
            models = (copied(learned_part(self._model)), copied(self._success))
            promoted = (*models, self._success.config.threshold, self._roles)
        return {
            "counters": dict(self.counters),
            "switch": replace(self.switch),
            "version": (self.version, self.awaits_model),
            "starts": list(self._starts),
            "rng": self._rng,
            "rows": list(self._rows),
            "frames": self._frames,
            "model_state": self._state,
            "sequence": (self._sequence, self._uncertain_in_a_row),
            "promoted": promoted,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from a `state`, with the models of then."""
        self.counters, self.switch, self._rng = state["counters"], state["switch"], state["rng"]
        self.version, self.awaits_model = state["version"]
        self._starts.extend(state["starts"])
        self._sequence, self._uncertain_in_a_row = state["sequence"]
        if state["promoted"] is not None and self._success is not None:
            model, success, self._success.config.threshold, self._roles = state["promoted"]
            learned_part(self._model).load_state_dict(model)
            self._success.load_state_dict(success)
        if state["model_state"] is not None:
            device = "cpu" if self._success is None else self._success.out.weight.device
            self._state = {name: tensor.to(device) for name, tensor in state["model_state"].items()}
        self._frames = state["frames"]
        self._rows = state["rows"]

    def save_promoted(self, directory: Path) -> None:
        """Saves the models that were promoted last; nothing if none were."""
        if self.version and self._success is not None:
            save_world_model(directory, learned_part(self._model), self._success, self._roles)
            note_failed(directory, ())  # or it would not have been promoted

    @property
    def on(self) -> bool:
        """True if anything is to be imagined now."""
        uncertain = self._uncertain_in_a_row >= self.config.window
        return not (self.awaits_model or self.switch.tripped or uncertain)

    def requests(self) -> list[Request]:
        """Requests for decisions, one per rollout; none before there is a real segment, or switched off."""
        if not self._starts or not self.on:
            return []
        self._begin([i for i, row in enumerate(self._rows) if row is None])
        return [
            Request(observation=row.latest, noise_seed=int(self._rng.integers(2**62)))
            for row in self._rows
            if row is not None
        ]

    def advance(self, decisions: list[Decision]) -> None:
        """Imagines one chunk in every rollout, with decisions in the order of `requests`."""
        assert self._state is not None
        low, high = self._environment.action_low, self._environment.action_high
        actions = np.stack([np.clip(d.chunk, low, high) for d in decisions]).astype(np.float32)
        seeds = self._rng.integers(2**31, size=len(actions)).tolist()
        prediction = self._model.step(self._state, torch.from_numpy(actions), seeds)
        self._state = prediction.state
        frames, robot = prediction.frames.cpu().numpy(), prediction.robot.cpu().numpy()
        if self._success is None:
            assert prediction.success is not None  # an oracle's
            success = prediction.success.cpu().numpy()
        else:
            tasks = task_codes([str(row.latest[TASK]) for row in self._rows if row is not None])
            success = self._success.probabilities(self._frames, frames, tasks)
        uncertainty, self._frames = prediction.uncertainty.cpu().numpy(), frames.copy()
        for i, decision in enumerate(decisions):
            row = self._rows[i]
            assert row is not None
            # NaN: of the uncertainty, there is none; of all else, the model has diverged.
            broken = not (np.isfinite(robot[i]).all() and np.isfinite(success[i]))
            if uncertainty[i] > self.config.max_uncertainty or broken:
                self.counters["uncertain"] += 1
                self._uncertain_in_a_row = 0 if row.taken else self._uncertain_in_a_row + 1
                self._end(i)
                continue
            self._uncertain_in_a_row = 0
            observation = self._observation(frames[i], robot[i], str(row.latest[TASK]))
            achieved = float(success[i]) > self._threshold
            reward = float(achieved) - self._decision_cost
            row.add(decision, actions[i], reward, len(actions[i]), observation)
            self.counters["decisions"] += 1
            late = row.full
            done = not late and prediction.done is not None and bool(prediction.done[i])
            if achieved or late or done:
                self.counters["successes"] += achieved
                self.switch.add_imagined(achieved)
                self._end(i, True, achieved)

    def close(self) -> None:
        """Closes simulators, if the model has any."""
        if isinstance(self._model, OracleModel):
            self._model.close()

    def metrics(self) -> dict[str, float]:
        """Counters, the model's version, and the success rates that the kill switch compares."""
        imagined, real = self.switch.shares
        return {name: float(count) for name, count in self.counters.items()} | {
            "version": float(self.version),
            "threshold": self._threshold,
            "success": self.switch.share,
            "success_imagined": imagined,
            "success_real": real,
            "on": float(self.on),
        }

    def _end(self, i: int, terminated: bool = False, success: bool = False) -> None:
        row, self._rows[i] = self._rows[i], None
        self.counters["rollouts"] += 1
        if row is None or not row.taken:
            return
        self._sequence += 1
        segment = row.cut(f"{IMAGINATION}.{self._sequence}", terminated, success)
        segment.world_version = self.version
        self._on_segment(segment)

    def _begin(self, rows: list[int]) -> None:
        if not rows:
            return
        starts = [self._starts[i] for i in self._rng.integers(len(self._starts), size=len(rows))]
        resets = [Reset(*start.origin[:2]) for start in starts]
        context = context_at(starts, self._model.spec)
        state = self._model.begin(context, [start.task for start in starts], resets)
        self._state = state if self._state is None else replace_rows(self._state, rows, state)
        for i, start in zip(rows, starts, strict=True):
            observation = self._observation(start.frames, start.robot, start.task)
            self._rows[i] = SegmentBuilder(
                [observation], self._limit, start.origin, self._max_steps, IMAGINED
            )
            self._frames[i] = start.frames

    @property
    def _threshold(self) -> float:
        return 0.5 if self._success is None else self._success.config.threshold

    def _observation(self, frames: np.ndarray, robot: np.ndarray, task: str) -> Observation:
        """Observation of frames (V, H, W, 3) and a state (S,), in the sizes of the policy's environment."""
        observation: Observation = {TASK: task}
        for v, camera in enumerate(self._model.spec.cameras):
            if camera in self._environment.images:
                observation[camera] = resize(frames[v : v + 1], self._environment.images[camera][:2])[0]
        if self._environment.state_dim:
            observation["observation.state"] = robot
        return observation
