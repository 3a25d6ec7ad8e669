# SPDX-License-Identifier: Apache-2.0
"""A world model that goes on learning from what the policy lives through.

The loss is that of the pre-training. Batches are of real windows only: some from the dataset it began with,
the others from the policy's episodes, the newest and the failed ones more often: there the policy is, and
demonstrations do not show what goes wrong there. Some episodes are held out, and what it has become serves
only once it has passed a trial on them.
"""

from __future__ import annotations

import contextlib
import copy
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from accerl_lerobot.experience import REAL, Segment
from accerl_lerobot.world_model.config import LearnConfig, SuccessLearnConfig, TrialConfig
from accerl_lerobot.world_model.contract import LearnableWorldModel, WorldModelSpec
from accerl_lerobot.world_model.episodes import Episode, Place
from accerl_lerobot.world_model.frames import executed, seen
from accerl_lerobot.world_model.imagination_config import OnlineLearnConfig
from accerl_lerobot.world_model.learn import Learner
from accerl_lerobot.world_model.outcomes import Scores, scores, threshold, together
from accerl_lerobot.world_model.success import Examples, SuccessLearner
from accerl_lerobot.world_model.success_plugin.modeling_success_pairs import SuccessPairsRewardModel
from accerl_lerobot.world_model.trial import calibrate, try_out

LONGEST_TRIAL_S = 3600.0
"""Until then a trial that is going on counts as something that moves, see `launch`."""
_STATE = ("owed", "promoted", "refused", "found", "_ended", "_since", "_last_tries")
ENDLESS = 10**9
"""Steps of a learning rate that never falls."""


OnTrial = Callable[[LearnableWorldModel, SuccessPairsRewardModel, Episode, int, bool], object]
"""Model, success model, the newest episode that was held out, the trial's number, and whether it passed."""


def episode_of(segments: Sequence[Segment], spec: WorldModelSpec) -> Episode:
    """The segments of a whole episode, in order, as it was looked at when decisions were due."""
    shown = [seen(segment.observations, spec) for segment in segments]
    # A segment begins with what the one before has ended with.
    frames, robot = (np.concatenate([part[i][:-1] for part in shown[:-1]] + [shown[-1][i]]) for i in range(2))
    steps = np.concatenate([segment.steps for segment in segments])
    chunks = np.concatenate([segment.actions for segment in segments])
    actions = executed(chunks, steps)
    return Episode(
        frames=frames,
        times=np.concatenate([[0], np.cumsum(steps)]).astype(np.int64),
        state=robot.astype(np.float32),
        actions=actions,
        success_at=len(actions) - 1 if segments[-1].success else -1,
        task=segments[-1].task,
        source="online",
    )


class Unfinished:
    """Segments of episodes that have not ended, or of which some are still on their way.

    What a worker that died has left behind is forgotten once there are `most` of them.
    """

    def __init__(self, most: int = 1024) -> None:
        self._most = most
        self.parts: OrderedDict[tuple[str, int], dict[int, Segment]] = OrderedDict()

    def add(self, segment: Segment) -> list[Segment] | None:
        """The whole episode, in order, if it is complete with this one."""
        name = segment.origin[:2]
        parts = self.parts.setdefault(name, {})
        parts[segment.origin.decision] = segment
        if len(self.parts) > self._most:
            self.parts.popitem(last=False)
        ordered = [parts[at] for at in sorted(parts)]
        expected = 0
        for part in ordered:
            if part.origin.decision != expected:
                return None
            expected += len(part)
        if not (ordered[-1].terminated or ordered[-1].truncated):
            return None
        self.parts.pop(name, None)
        return ordered


class Promotion(NamedTuple):
    """A model offered for promotion, on the CPU, and the outcome of its trial."""

    model: LearnableWorldModel
    success: SuccessPairsRewardModel
    version: int
    """Gradient steps behind it, those before the run not counted."""
    found: dict[str, Any]
    """See `try_out`."""


class OnlineLearner:
    """Learns as real segments come in.

    Example:
        >>> learner.add(segment)
        >>> while learner.owed >= 1:
        ...     learner.step()
        >>> if learner.due(last=False) and (promotion := learner.promote(last=False)):
        ...     imagination.swap(promotion)

    Args:
        model: where it begins; not changed.
        success: the same.
        config: how it goes on.
        trial: what it must pass.
        offline: episodes of the dataset that it has learnt from.
        held_out: others, which it is tried on beside the policy's.
        longest: chunks of a dream at most.
        fixed: threshold of the success model, whatever it becomes; None: it is set on the policy's episodes.
        seed: of everything random.
        on_trial: shown what was tried.
    """

    def __init__(
        self,
        model: LearnableWorldModel,
        success: SuccessPairsRewardModel,
        config: OnlineLearnConfig,
        trial: TrialConfig,
        *,
        offline: Sequence[Episode] = (),
        held_out: Sequence[Episode] = (),
        longest: int = 15,
        fixed: float | None = None,
        seed: int = 0,
        on_trial: OnTrial | None = None,
    ) -> None:
        self.config, self.trial, self._fixed = config, trial, fixed
        self._on_trial = on_trial
        self.owed = 0.0
        """Gradient steps that are due."""
        self.promoted = self.refused = 0
        self._seed = seed
        self.found: dict[str, Any] = {}
        """By the last trial."""
        learn = LearnConfig(steps=ENDLESS, batch=config.batch, lr=config.lr, anchors=longest)
        self._learner = Learner(_trainable(model), learn, seed)
        # The judge dreams in training, so it needs the model, and learns as fast as that.
        judged = SuccessLearnConfig(steps=ENDLESS, lr=config.lr, depth=longest)
        self._success = SuccessLearner(_trainable(success), judged, seed)
        self._offline, self._held_offline = list(offline), list(held_out)
        self._learnt: deque[Episode] = deque(maxlen=config.memory)
        self._held: deque[Episode] = deque(maxlen=max(1, round(config.memory * config.held_out)))
        self._rng = np.random.default_rng((seed, 4))
        self._unfinished = Unfinished()
        self._examples: Examples | None = None
        self._new = True
        """True if there are episodes that `_examples` does not know."""
        self._ended = self._since = self._last_tries = 0
        self._untried: dict[str, Any] = {}
        """Parts of the state as they were before the trial whose outcome nobody has yet."""
        self._trying: float | None = None
        """When the trial began that is going on; read on another thread."""

    @property
    def version(self) -> int:
        """Gradient steps made."""
        return self._learner.count

    def due(self, last: bool) -> bool:
        """True if it is to be tried.

        Args:
            last: no real episode will come any more.
        """
        if not self.version or (last and self.owed >= 1):
            return False
        if not last:
            return self._since >= self.config.try_every
        return (self._since > 0 or not self.promoted) and self._last_tries < self.config.last_tries

    def promising(self, last: bool) -> bool:
        """True if another version may be promoted; see `due`."""
        return not last or self.owed >= 1 or self.due(last)

    def add(self, segment: Segment) -> None:
        """Takes a real segment; of the episodes that it completes, some are held out.

        Raises:
            ValueError: it was imagined: from its own dreams a world model learns nothing about the world.
        """
        if segment.source != REAL:
            raise ValueError(
                f"a world model learns from real segments, and {segment.key} is {segment.source}"
            )
        parts = self._unfinished.add(segment)
        if parts is None:
            return
        episode = episode_of(parts, self._learner.model.spec)
        if parts[-1].success and not parts[-1].terminated:
            return  # when it succeeded is not known
        share = self.config.held_out
        before, self._ended = self._ended, self._ended + 1
        held = int(self._ended * share) > int(before * share)
        (self._held if held else self._learnt).append(episode)
        self._examples, self._new = None, True
        self._since += 1
        # Where episodes come faster than it can learn, what it owes is not to grow without end.
        most = max(1.0, self.config.try_every * self.config.steps_per_episode)
        self.owed = min(self.owed + self.config.steps_per_episode, most)

    def step(self) -> dict[str, float]:
        """One gradient step of either model, if there is anything to learn from."""
        self.owed -= 1
        if not self._learnt and not self._offline:
            return {}
        episodes = self._offline + list(self._learnt)
        metrics = self._learner.step(self._learner.windows(episodes, self._draw()))
        if self._examples is None and self._new:
            self._new = False
            with contextlib.suppress(ValueError):  # so far there may be only one kind of outcome
                self._examples = Examples(episodes, self._learner.model.spec.chunk)
        if self._examples is not None:
            judged = self._success.step(self._examples, self._learner.serving)
            metrics |= {f"success_{k}": v for k, v in judged.items()}
        return metrics

    def promote(self, last: bool) -> Promotion | None:
        """Tries what has become of it; None if it does not pass, and the old one goes on serving.

        Args:
            last: see `due`; if it does not pass then, it is to learn on all the same.
        """
        self._trying = time.monotonic()
        try:
            return self._promote(last)
        finally:
            self._trying = None

    def handed_over(self) -> None:
        """Notes that the last promoted model serves now."""
        self._untried = {}

    def _promote(self, last: bool) -> Promotion | None:
        self._untried = {name: getattr(self, name) for name in _STATE}
        self._since = 0
        self._last_tries += last
        held = [*self._held_offline, *self._held]
        if not held:
            self._untried = {}
            return None
        model = copy.deepcopy(self._learner.serving)
        success = copy.deepcopy(self._success.model).eval().requires_grad_(False)
        known = [*self._offline, *self._learnt][-100:]
        calibrate(model, known, self.trial, self._seed)
        # A dozen held-out episodes set no threshold. Those that were learnt from do, though they flatter; the
        # trial is on the others; and what serves knows both.
        learnt = self._scored(model, success, list(self._learnt)[-self.trial.most :])
        self._set_threshold(success, learnt)
        found = self.found = try_out(model, held, self.trial, success, self._seed)
        if self._on_trial is not None:
            self._on_trial(model, success, held[-1], self.promoted + self.refused + 1, found["passed"])
        if not found["passed"]:
            self.refused += 1
            if last and self._last_tries < self.config.last_tries:
                self.owed += self.config.try_every * self.config.steps_per_episode
            self._untried = {}
            return None
        self.promoted += 1
        self._set_threshold(success, learnt + self._scored(model, success, list(self._held)))
        return Promotion(model.cpu(), success.cpu(), self.version, found)

    def _scored(
        self, model: LearnableWorldModel, success: SuccessPairsRewardModel, episodes: list[Episode]
    ) -> list[Scores]:
        if not episodes or self._fixed is not None:
            return []
        return [scores(model, success, episodes, self.trial, self._seed)]

    def _set_threshold(self, success: SuccessPairsRewardModel, dreams: list[Scores]) -> None:
        """By dreams of the policy's own episodes; without a failure among them it stays."""
        if self._fixed is not None:
            success.config.threshold = self._fixed
        elif dreams:
            found = together(*dreams)
            least = threshold(found, np.ones(len(found.achieved), bool), self.trial)
            success.config.threshold = least or success.config.threshold

    def state(self) -> dict[str, Any]:
        """A copy of all that `restore` needs; see `snapshot`.

        A trial that is going on, or whose outcome has not been handed over, is to be made anew.
        """
        unfinished = {name: dict(parts) for name, parts in self._unfinished.parts.items()}
        return (
            {name: getattr(self, name) for name in _STATE}
            | self._untried
            | {
                "learner": self._learner.state(),
                "success": self._success.state(),
                "learnt": list(self._learnt),
                "held": list(self._held),
                "rng": copy.deepcopy(self._rng),
                "unfinished": unfinished,
            }
        )

    def restore(self, state: dict[str, Any]) -> None:
        """Goes on from what `state` gave."""
        for name in _STATE:
            setattr(self, name, state[name])
        self._learner.restore(state["learner"])
        self._success.restore(state["success"])
        self._learnt.extend(state["learnt"])
        self._held.extend(state["held"])
        self._rng = state["rng"]
        self._unfinished.parts.update(state["unfinished"])

    def metrics(self) -> dict[str, float]:
        """Counts of its learning and of its trials."""
        trying = self._trying
        return {
            "learn_steps": float(self.version),
            "learn_episodes": float(len(self._learnt)),
            "promoted": float(self.promoted),
            "refused": float(self.refused),
            "trial_s": min(LONGEST_TRIAL_S, time.monotonic() - trying) if trying is not None else 0.0,
        } | {f"gate_{name}": float(gate["value"]) for name, gate in self.found.get("gates", {}).items()}

    def _draw(self) -> list[Place]:
        """Places in the dataset's episodes, which come first, and in the policy's."""
        count, known = self.config.batch, len(self._offline)
        share = self.config.offline if self._learnt else 1.0
        offline = round(share * count) if known else 0
        chosen = self._rng.integers(known, size=offline).tolist() if offline else []
        if count > offline:
            weights = online_weights([e.success for e in self._learnt], self.config)
            chosen += (known + self._rng.choice(len(weights), size=count - offline, p=weights)).tolist()
        episodes = self._offline + list(self._learnt)
        return [Place(e, int(self._rng.integers(len(episodes[e].frames) - 1))) for e in chosen]


def online_weights(successes: Sequence[bool], config: OnlineLearnConfig) -> np.ndarray:
    """How likely each of the policy's episodes, oldest first, is drawn; sums to 1."""
    count = len(successes)
    newest = np.arange(count) >= count - max(1, count // 4)
    weights = np.where(newest, config.recent / newest.sum(), 0.0)
    old = ~newest
    weights[old] += (1 - config.recent) / max(1, old.sum())
    failed = ~np.asarray(successes, bool)
    if failed.any() and not failed.all():
        for kind, share in ((failed, config.failures), (~failed, 1 - config.failures)):
            weights[kind] *= share / weights[kind].sum() if weights[kind].sum() else 0.0
    total = weights.sum()
    return np.asarray(weights / total if total else np.full(count, 1 / count))


def _trainable(model: Any) -> Any:
    made = copy.deepcopy(model)
    return made.requires_grad_(True)
