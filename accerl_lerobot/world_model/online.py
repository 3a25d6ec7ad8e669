# SPDX-License-Identifier: Apache-2.0
"""Training of a world model on the policy's episodes during a run.

The loss is that of the pre-training with its defaults. Batches are of real windows only: some from the
pre-training data, the others from the policy's episodes, the newest and the failed ones more often, as
demonstrations do not show how the policy fails. Some episodes are held out, and a model is used only once it
has passed validation on them.
"""

from __future__ import annotations

import contextlib
import copy
import time
from collections import OrderedDict, deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np

from accerl_lerobot.experience import REAL, Segment
from accerl_lerobot.world_model.config import (
    LearnConfig,
    OnlineLearnConfig,
    SuccessLearnConfig,
    WorldModelConfig,
)
from accerl_lerobot.world_model.contract import LearnableWorldModel, WorldModelSpec
from accerl_lerobot.world_model.data import Episode, WindowStart, model_arrays
from accerl_lerobot.world_model.learners import Examples, Learner, SuccessLearner
from accerl_lerobot.world_model.rollout_eval import Scores, choose_threshold, score_episodes
from accerl_lerobot.world_model.store import HELD_OUT, LEARNT, THRESHOLD
from accerl_lerobot.world_model.success_model import SuccessPairsRewardModel
from accerl_lerobot.world_model.validation import fit_uncertainty_scale, validate

BATCH, LEARNING_RATE = 16, 3e-4  # windows per gradient step, and the learning rate after the first steps
OFFLINE, RECENT, FAILURES = 0.5, 0.7, 0.6
"""Share of windows from the pre-training data; of the others, from the newest quarter of episodes; and of
those, from failures."""
MEMORY = 400  # real episodes kept for training
MOST_UNFINISHED = 1024
"""Incomplete episodes; of more the oldest are dropped, such as those of a worker that died."""
FINAL_VALIDATIONS = 5  # validations after the last real episode, at most
MAX_VALIDATION_S = 3600.0  # a validation in progress counts as progress of the run for so long, see `launch`
ENDLESS = 10**9  # steps of a learning rate that never falls
_COUNTS = ("pending_steps", "promoted", "rejected", "result", "_ended", "_since", "_final_validations")


def episode_from_segments(segments: Sequence[Segment], spec: WorldModelSpec) -> Episode:
    """Joins the segments of a whole episode, in order; it has a frame per decision."""
    # A segment's first observation is the last one of the segment before.
    parts = [{k: v[:-1] for k, v in segment.observations.items()} for segment in segments[:-1]]
    parts.append(segments[-1].observations)
    frames, robot = model_arrays({k: np.concatenate([part[k] for part in parts]) for k in parts[0]}, spec)
    steps = np.concatenate([segment.steps for segment in segments])
    chunks = np.concatenate([segment.actions for segment in segments])
    actions = chunks[np.arange(chunks.shape[1]) < steps[:, None]]
    return Episode(
        frames=frames,
        times=np.concatenate([[0], np.cumsum(steps)]).astype(np.int64),
        state=robot.astype(np.float32),
        actions=actions,
        success_at=len(actions) - 1 if segments[-1].success else -1,
        task=segments[-1].task,
        own=True,
    )


class Promotion(NamedTuple):
    """A model that has passed validation, on the CPU."""

    model: LearnableWorldModel
    success: SuccessPairsRewardModel
    version: int  # gradient steps in the run
    roles: dict[str, str]  # of episodes, by their keys, see `store`


class OnlineLearner:
    """Trains as real segments come in: `add`, `step` while any is pending, `promote` when validation is due.

    It starts at a copy of both models. Of the `known` episodes it trains on those without another role in
    `roles`, those that it was trained and validated on before. A rollout has at most `longest` chunks.
    """

    def __init__(
        self,
        model: LearnableWorldModel,
        success: SuccessPairsRewardModel,
        config: OnlineLearnConfig,
        known: Sequence[Episode] = (),
        roles: Mapping[str, str] | None = None,
        longest: int = 15,
        seed: int = 0,
    ) -> None:
        self.config, self._seed = config, seed
        self.validation = replace(config.validation, depth=min(config.validation.depth, longest))
        self.pending_steps = 0.0  # gradient steps that are due
        self.promoted = self.rejected = 0
        self.result: dict[str, Any] = {}  # of the last validation
        training = WorldModelConfig(
            learn=LearnConfig(steps=ENDLESS, batch=BATCH, lr=LEARNING_RATE),
            success=SuccessLearnConfig(lr=LEARNING_RATE),
            longest=longest,
        )
        self._learner = Learner(copy.deepcopy(model).requires_grad_(True), training, seed)
        self._success = SuccessLearner(copy.deepcopy(success).requires_grad_(True), training, seed)
        self._roles = {key: LEARNT if role == LEARNT else HELD_OUT for key, role in (roles or {}).items()}
        usable = [e for e in known if len(e.frames) > 1]
        self._offline = [e for e in usable if self._roles.get(e.key, LEARNT) == LEARNT]
        self._held_offline = [e for e in usable if self._roles.get(e.key, LEARNT) != LEARNT]
        self._roles |= {episode.key: LEARNT for episode in self._offline}
        self._learnt: deque[Episode] = deque(maxlen=MEMORY)
        self._held: deque[Episode] = deque(maxlen=max(1, round(MEMORY * config.held_out)))
        self._rng = np.random.default_rng((seed, 4))
        self._unfinished: OrderedDict[tuple[str, int], dict[int, Segment]] = OrderedDict()
        self._examples: Examples | None = None
        self._examples_stale = True
        self._ended = self._since = self._final_validations = 0
        self._unserved: dict[str, Any] = {}  # counts before the validation whose outcome is not served yet
        self._validating: float | None = None  # when it began; read on another thread

    @property
    def version(self) -> int:
        """Gradient steps made."""
        return self._learner.count

    def validation_due(self, last: bool) -> bool:
        """True if the model is to be validated; `last`: no real episode will come any more."""
        if not self.version or (last and self.pending_steps >= 1):
            return False
        if not last:
            return self._since >= self.config.validate_every
        left = self._final_validations < FINAL_VALIDATIONS
        return (self._since > 0 or not self.promoted) and left

    def may_promote(self, last: bool) -> bool:
        """True if another version may be promoted; see `validation_due`."""
        return not last or self.pending_steps >= 1 or self.validation_due(last)

    def add(self, segment: Segment) -> None:
        """Takes a real segment; some of the episodes that it completes are held out."""
        if segment.source != REAL:
            raise ValueError(f"a world model trains on real segments, and {segment.key} is {segment.source}")
        parts = self._completed(segment)
        if parts is None or (parts[-1].success and not parts[-1].terminated):
            return  # incomplete, or the step of its success is unknown
        episode = episode_from_segments(parts, self._learner.model.spec)
        share, self._ended = self.config.held_out, self._ended + 1
        held = int(self._ended * share) > int((self._ended - 1) * share)
        (self._held if held else self._learnt).append(episode)
        self._roles[episode.key] = HELD_OUT if held else LEARNT
        self._examples, self._examples_stale = None, True
        self._since += 1
        # Bounded, where episodes come faster than it can train.
        most = max(1.0, self.config.validate_every * self.config.steps_per_episode)
        self.pending_steps = min(self.pending_steps + self.config.steps_per_episode, most)

    def _completed(self, segment: Segment) -> list[Segment] | None:
        """The whole episode, in order, if it is complete with this segment."""
        name = segment.origin[:2]
        parts = self._unfinished.setdefault(name, {})
        parts[segment.origin.decision] = segment
        if len(self._unfinished) > MOST_UNFINISHED:
            self._unfinished.popitem(last=False)
        ordered = [parts[decision] for decision in sorted(parts)]
        starts = accumulate(map(len, ordered[:-1]), initial=0)
        if sorted(parts) != [*starts] or not ordered[-1].terminated:
            return None
        self._unfinished.pop(name, None)
        return ordered

    def step(self) -> dict[str, float]:
        """Makes one gradient step of either model, if there are episodes."""
        self.pending_steps -= 1
        if not self._learnt and not self._offline:
            return {}
        episodes = self._offline + list(self._learnt)
        metrics = self._learner.step(self._learner.cut(episodes, self._draw()))
        if self._examples is None and self._examples_stale:
            self._examples_stale = False
            with contextlib.suppress(ValueError):  # so far there may be only one kind of outcome
                self._examples = Examples(episodes, self._learner.model.spec.chunk)
        if self._examples is not None:
            success = self._success.step(self._examples, self._learner.serving)
            metrics |= {f"success_{k}": v for k, v in success.items()}
        return metrics

    def promote(self, last: bool) -> Promotion | None:
        """Validates a copy of the present model; None if it fails, and the one before stays in use.

        If it fails when `last`, more gradient steps become due, for `FINAL_VALIDATIONS` times at most.
        """
        self._validating = time.monotonic()
        self._unserved = {name: getattr(self, name) for name in _COUNTS}
        self._since = 0
        self._final_validations += last
        try:
            promotion = self._validated()
        finally:
            self._validating = None
        if promotion is None:
            if last and self.result and self._final_validations < FINAL_VALIDATIONS:
                self.pending_steps += self.config.validate_every * self.config.steps_per_episode
            self._unserved = {}
        return promotion

    def mark_served(self) -> None:
        """Notes that the last promoted model is in use."""
        self._unserved = {}

    def _validated(self) -> Promotion | None:
        if not (held := [*self._held_offline, *self._held]):
            return None
        model = copy.deepcopy(self._learner.serving)
        success = copy.deepcopy(self._success.model).eval().requires_grad_(False)
        known = [*self._offline, *self._learnt][-100:]
        fit_uncertainty_scale(model, known, self.validation, self._seed)
        parts: list[Scores] = []

        def choose_also_on(episodes: list[Episode]) -> None:
            if not episodes:
                return
            parts.append(score_episodes(model, success, episodes, self.validation, self._seed))
            scores = Scores(*map(np.concatenate, zip(*parts, strict=True)))
            # Without a failure among them it stays.
            success.config.threshold = choose_threshold(scores, self.validation) or success.config.threshold

        # A dozen held-out episodes are too few to choose a threshold. It is chosen on training episodes,
        # validated on the others, and chosen again on both for use.
        choose_also_on(list(self._learnt)[-self.validation.max_windows :])
        threshold = success.config.threshold
        self.result = validate(model, held, self.validation, success, self._seed, threshold)
        if not self.result["passed"]:
            self.rejected += 1
            return None
        self.promoted += 1
        choose_also_on(list(self._held))
        roles = self._roles | {episode.key: THRESHOLD for episode in self._held}
        return Promotion(model.cpu(), success.cpu(), self.version, roles)

    def state(self) -> dict[str, Any]:
        """Copies all that `restore` needs. A validation whose outcome has not been served is repeated."""
        counts = {name: getattr(self, name) for name in _COUNTS} | self._unserved
        return counts | {
            "learner": self._learner.state(),
            "success": self._success.state(),
            "learnt": list(self._learnt),
            "held": list(self._held),
            "roles": dict(self._roles),
            "rng": copy.deepcopy(self._rng),
            "unfinished": {name: dict(parts) for name, parts in self._unfinished.items()},
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Continues from a `state`."""
        for name in _COUNTS:
            setattr(self, name, state[name])
        self._learner.restore(state["learner"])
        self._success.restore(state["success"])
        self._learnt.extend(state["learnt"])
        self._held.extend(state["held"])
        self._roles = state["roles"]
        self._rng = state["rng"]
        self._unfinished.update(state["unfinished"])

    def metrics(self) -> dict[str, float]:
        """Counts of training and validations, and the checks of the last one."""
        started = self._validating
        seconds = 0.0 if started is None else min(MAX_VALIDATION_S, time.monotonic() - started)
        return {
            "learn_steps": float(self.version),
            "learn_episodes": float(len(self._learnt)),
            "promoted": float(self.promoted),
            "rejected": float(self.rejected),
            "validation_s": seconds,
        } | {f"check_{name}": float(check["value"]) for name, check in self.result.get("checks", {}).items()}

    def _draw(self) -> list[WindowStart]:
        """Draws a batch from the pre-training episodes, which have the first indices, and the policy's."""
        known = len(self._offline)
        offline = (round(OFFLINE * BATCH) if self._learnt else BATCH) if known else 0
        chosen = self._rng.integers(known, size=offline).tolist() if offline else []
        if offline < BATCH:
            weights = episode_weights([e.success for e in self._learnt])
            chosen += (known + self._rng.choice(len(weights), size=BATCH - offline, p=weights)).tolist()
        episodes = self._offline + list(self._learnt)
        return [WindowStart(e, int(self._rng.integers(len(episodes[e].frames) - 1))) for e in chosen]


def episode_weights(successes: Sequence[bool]) -> np.ndarray:
    """Probability of drawing each of the policy's episodes, oldest first."""
    count = len(successes)
    newest = np.arange(count) >= count - max(1, count // 4)
    weights = np.where(newest, RECENT / newest.sum(), (1 - RECENT) / max(1, (~newest).sum()))
    failed = ~np.asarray(successes, bool)
    if failed.any() and not failed.all():
        for which, share in ((failed, FAILURES), (~failed, 1 - FAILURES)):
            weights[which] *= share / weights[which].sum()
    return np.asarray(weights / weights.sum())
