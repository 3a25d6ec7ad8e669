# SPDX-License-Identifier: Apache-2.0
"""Learning which frames show a success.

Of every batch half are successes, which are rare otherwise. Pairs of frames are up to a chunk apart, whatever
they show: how soon an episode ended must not give away how. The second frames are partly the world model's
dreams: what it will be asked to judge has that look. A dream is of a whole chunk, but what succeeded was cut
short by that; its last action is held then, and in dreams of failures just so.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from accerl_lerobot.checkpoint.snapshot import kind
from accerl_lerobot.checkpoint.tensors import copied, optimizer_state, restore_optimizer
from accerl_lerobot.world_model.config import SuccessLearnConfig
from accerl_lerobot.world_model.contract import WorldModel
from accerl_lerobot.world_model.episodes import Episode, Place
from accerl_lerobot.world_model.replayed import replay
from accerl_lerobot.world_model.stand_in import SuccessModel, device_of
from accerl_lerobot.world_model.success_plugin import SuccessPairsConfig
from accerl_lerobot.world_model.success_plugin.modeling_success_pairs import SuccessPairsRewardModel

EASY = 0.1
"""How often a failure is drawn that nobody takes for a success, beside one that everybody does."""
VALIDATED = 64
"""Held-out pairs of frames, see `validated`."""


class Examples:
    """Examples for a success model: frames of successes and of failures, and chunks that led to them.

    Args:
        episodes: to draw from.
        chunk: K.

    Raises:
        ValueError: there is no frame, or no chunk, of either kind.
    """

    def __init__(self, episodes: Sequence[Episode], chunk: int) -> None:
        self.episodes, self.chunk = episodes, chunk
        self._frames: dict[bool, list[Place]] = {True: [], False: []}
        self._chunks: dict[bool, list[Place]] = {True: [], False: []}
        self._near: list[Place] = []
        for e, episode in enumerate(episodes):
            for f, achieved in enumerate(episode.achieved):
                self._frames[bool(achieved)].append(Place(e, f))
                if not achieved and episode.success and episode.success_at - episode.times[f] < 2 * chunk:
                    self._near.append(Place(e, f))
        for e, episode in enumerate(episodes):
            for f in range(episode.starts):
                start = int(episode.times[f])
                self._chunks[start <= episode.success_at < start + chunk].append(Place(e, f))
        for name, of in (("frames", self._frames), ("chunks", self._chunks)):
            if not of[True] or not of[False]:
                raise ValueError(f"{len(of[True])} {name} show a success and {len(of[False])} do not")

    def seen(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
        """Pairs of frames: half successes, then as many failures, as near to each other; of these, half
        are of the last two chunks before a success, if there are any.

        Returns:
            The frames before and after, uint8 (count, V, H, W, 3) each; whether the latter shows a success,
            bool (count,); and the progress by then, float (count,).
        """
        later = self._halves(self._frames, count, rng)
        near = count // 4 if self._near else 0
        if near:
            later[-near:] = [self._near[i] for i in rng.integers(len(self._near), size=near)]
        earlier = []
        for place in later:
            times = self.episodes[place.episode].times
            then = times[place.frame] - rng.integers(self.chunk + 1)
            earlier.append(Place(place.episode, max(0, int(np.searchsorted(times, then, "right")) - 1)))
        before, after = (
            np.stack([self.episodes[p.episode].frames[p.frame] for p in at]) for at in (earlier, later)
        )
        success = np.array([self.episodes[p.episode].achieved[p.frame] for p in later])
        return before, after, success, np.array([self.progress(p) for p in later])

    def chunks(self, count: int, rng: np.random.Generator) -> list[Place]:
        """Half places whose chunk achieved the task, then as many others."""
        return self._halves(self._chunks, count, rng)

    def progress(self, place: Place, ahead: int = 0) -> float:
        """How far towards its success an episode is `ahead` env steps on; NaN if there is none."""
        episode = self.episodes[place.episode]
        if not episode.success:
            return float("nan")
        return min(1.0, (int(episode.times[place.frame]) + ahead) / max(1, episode.success_at))

    def _halves(self, of: dict[bool, list[Place]], count: int, rng: np.random.Generator) -> list[Place]:
        sizes = {True: count // 2, False: count - count // 2}
        return [of[k][i] for k, n in sizes.items() for i in rng.integers(len(of[k]), size=n)]


@kind
@dataclass(frozen=True, kw_only=True)
class Dreamt:
    """Frames of dreams of episodes to their ends, and what had come of them: so looks what a success model
    will judge.
    """

    before: np.ndarray
    """uint8 (M, V, H, W, 3),"""
    after: np.ndarray
    """and a chunk later."""
    success: np.ndarray
    """bool (M,), whether it had been achieved by then in truth."""
    progress: np.ndarray
    """float (M,), see `Examples.progress`."""
    chances: np.ndarray
    """float (M,), how much each is drawn."""

    @classmethod
    def of(
        cls,
        examples: Examples,
        world: WorldModel,
        judge: SuccessPairsRewardModel,
        count: int,
        depth: int,
        rng: np.random.Generator,
    ) -> Dreamt:
        """Dreams them.

        Args:
            examples: whose episodes are dreamt.
            world: dreams them.
            judge: of failures, those are drawn most that it takes for successes.
            count: how many, half of them successes where there are enough.
            depth: chunks of a dream at most.
            rng: of which, and of where they begin: half of them where the episode did.
        """
        at = [Place(e, 0 if rng.random() < 0.5 else f) for e, f in examples.chunks(count, rng)]
        replayed = replay(world, examples.episodes, at, depth, rng)
        windows = replayed.windows
        rows, depths = np.nonzero(replayed.made)
        success = windows.success[rows, depths]
        before = np.stack([replayed.before(d)[m] for m, d in zip(rows, depths, strict=True)])
        after = replayed.dreams.ends[rows, depths]
        progress = np.array(
            [examples.progress(at[m], (d + 1) * world.spec.chunk) for m, d in zip(rows, depths, strict=True)]
        )
        chances = np.where(success, 1.0, EASY + probabilities(judge, before, after))
        return cls(before=before, after=after, success=success, progress=progress, chances=chances)

    def seen(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
        """As `Examples.seen`, but dreamt."""
        chosen = []
        for which, size in ((self.success, count // 2), (~self.success, count - count // 2)):
            if which.any():
                chances = self.chances * which
                chosen += rng.choice(len(which), size=size, p=chances / chances.sum()).tolist()
        return self.before[chosen], self.after[chosen], self.success[chosen], self.progress[chosen]


class SuccessLearner:
    """The optimiser around a success model.

    Args:
        model: to train.
        config: how.
        seed: of what is drawn.
    """

    def __init__(self, model: SuccessPairsRewardModel, config: SuccessLearnConfig, seed: int) -> None:
        self.model, self.config = model.train(), config
        self.rng = np.random.default_rng((seed, 2))
        self._generator = torch.Generator().manual_seed(seed)
        self._dreamt: Dreamt | None = None
        self._count = 0
        self._optimizer = torch.optim.AdamW(
            model.parameters(), lr=config.lr, weight_decay=config.weight_decay
        )

    def step(self, examples: Examples, world: WorldModel) -> dict[str, float]:
        """Learns once from a batch of these; the world dreams its share of it.

        Raises:
            FloatingPointError: it has diverged.
        """
        dreamt = round(self.config.dreamt * self.config.batch)
        parts = []
        if dreamt < self.config.batch:
            parts.append(examples.seen(self.config.batch - dreamt, self.rng))
        if dreamt:
            if self._dreamt is None or self._count % self.config.every == 0:
                config = self.config
                self._dreamt = Dreamt.of(examples, world, self.model, config.episodes, config.depth, self.rng)
            parts.append(self._dreamt.seen(dreamt, self.rng))
        self._count += 1
        pairs = [np.concatenate(x) for x in zip(*parts, strict=True)]
        loss, metrics = _loss(self.model, pairs, self._generator)
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self.model.parameters(), 1.0)
        if not bool(torch.isfinite(norm)):
            raise FloatingPointError(
                f"the success model's loss or gradient is not finite at step {self._count}; "
                "lower world_model.success.lr, or imagination.learn.lr in a run"
            )
        self._optimizer.step()
        return metrics

    def state(self) -> dict[str, Any]:
        """A copy of all that `restore` needs; see `snapshot`."""
        return {
            "model": copied(self.model),
            "count": self._count,
            "rng": copy.deepcopy(self.rng),
            "generator": self._generator.get_state(),
            "optimizer": optimizer_state(self._optimizer),
            "dreamt": self._dreamt,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Goes on from what `state` gave."""
        self.model.load_state_dict(state["model"])
        self._count, self.rng, self._dreamt = state["count"], state["rng"], state["dreamt"]
        self._generator.set_state(state["generator"])
        restore_optimizer(self._optimizer, state["optimizer"])


def validated(model: SuccessPairsRewardModel, examples: Examples, seed: int) -> dict[str, float]:
    """``loss``, ``accuracy`` and ``progress`` on pairs that were seen, always the same ones, as they are.

    Nothing is drawn that learning draws from.

    Args:
        model: in training, or not; it stays so.
        examples: of episodes that are held out.
        seed: of which pairs.
    """
    pairs, training = examples.seen(VALIDATED, np.random.default_rng((seed, 9))), model.training
    model.eval()  # it shakes nothing then
    with torch.no_grad():
        _, metrics = _loss(model, pairs, None)
    model.train(training)
    return metrics


def new_success_model(chunk: int) -> SuccessPairsRewardModel:
    """One of the default size, on the CPU; wherever it is moved to, it is saved as one for the CPU."""
    return SuccessPairsRewardModel(SuccessPairsConfig(chunk=chunk, device="cpu"))


def _loss(
    model: SuccessPairsRewardModel, pairs: Sequence[np.ndarray], generator: torch.Generator | None
) -> tuple[torch.Tensor, dict[str, float]]:
    """Loss of the examples of `Examples.seen`."""
    before, after, success, progress = pairs
    device = model.out.weight.device
    return model.loss(
        as_floats(before, device),
        as_floats(after, device),
        torch.from_numpy(success.astype(np.float32)).to(device),
        torch.from_numpy(progress.astype(np.float32)).to(device),
        generator,
    )


def as_floats(frames: np.ndarray, device: torch.device) -> torch.Tensor:
    """uint8 (B, V, H, W, 3) to float (B, V, 3, H, W) in [0, 1], what a success model looks at."""
    return torch.from_numpy(frames).movedim(-1, 2).to(device).float() / 255


def probabilities(
    success: SuccessModel, before: np.ndarray, after: np.ndarray, batch: int = 64
) -> np.ndarray:
    """float32 (M,): P that the second frames show a success; frames uint8 (M, V, H, W, 3)."""
    device = device_of(success)
    parts = [
        success.said(as_floats(before[i : i + batch], device), as_floats(after[i : i + batch], device))
        for i in range(0, len(before), batch)
    ]
    return torch.cat(parts).cpu().numpy() if parts else np.zeros(0, np.float32)
