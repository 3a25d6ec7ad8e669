# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Learning which frames show a success.

Of every batch half are successes, which are rare otherwise. Pairs of frames are up to a chunk apart, whatever
they show: how soon an episode ended must not give away how. The second frames are partly the world model's
dreams: what it will be asked to judge has that look. A dream is of a whole chunk, but what succeeded was cut
short by that; its last action is held then, and in dreams of failures just so.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from accerl_lerobot.world_model.config import SuccessLearnConfig
from accerl_lerobot.world_model.contract import Context, WorldModel
from accerl_lerobot.world_model.episodes import Episode, Place, Windows, cut, held, places
from accerl_lerobot.world_model.success_plugin import SuccessPairsConfig
from accerl_lerobot.world_model.success_plugin.modeling_success_pairs import SuccessPairsRewardModel


class Examples:
    """What episodes have to show: frames of successes and of failures, and chunks that led to them.

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
        for e, episode in enumerate(episodes):
            for f, achieved in enumerate(episode.achieved):
                self._frames[bool(achieved)].append(Place(e, f))
        for place in places(episodes):
            episode = episodes[place.episode]
            start = int(episode.times[place.frame])
            self._chunks[start <= episode.success_at < start + chunk].append(place)
        for name, of in (("frames", self._frames), ("chunks", self._chunks)):
            if not of[True] or not of[False]:
                raise ValueError(f"{len(of[True])} {name} show a success and {len(of[False])} do not")

    def seen(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
        """Pairs of frames: half successes, then as many failures, as near to each other.

        Returns:
            The frames before and after, uint8 (count, V, H, W, 3) each; whether the latter shows a success,
            bool (count,); and the progress by then, float (count,).
        """
        later = self._halves(self._frames, count, rng)
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
        self._optimizer = torch.optim.AdamW(
            model.parameters(), lr=config.lr, weight_decay=config.weight_decay
        )

    def step(self, examples: Examples, world: WorldModel) -> dict[str, float]:
        """Learns once from a batch of these; the world dreams its share of it."""
        dreamt = round(self.config.dreamt * self.config.batch)
        parts = []
        if dreamt < self.config.batch:
            parts.append(examples.seen(self.config.batch - dreamt, self.rng))
        if dreamt:
            parts.append(self._dreamt(examples, world, dreamt))
        before, after, success, progress = (np.concatenate(x) for x in zip(*parts, strict=True))
        device = self.model.out.weight.device
        loss, metrics = self.model.loss(
            as_floats(before, device),
            as_floats(after, device),
            torch.from_numpy(success.astype(np.float32)).to(device),
            torch.from_numpy(progress.astype(np.float32)).to(device),
            self._generator,
        )
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.model.parameters(), 1.0)
        self._optimizer.step()
        return metrics

    def _dreamt(self, examples: Examples, world: WorldModel, count: int) -> tuple[np.ndarray, ...]:
        spec = world.spec
        at = examples.chunks(count, self.rng)
        windows = cut(examples.episodes, at, chunk=spec.chunk, context=spec.context, chunks=1)
        success = windows.success[:, 0]
        steps = cut_alike(windows.steps[:, :1], success[:, None], self.rng)
        state = world.begin(context_of(windows), windows.task)
        actions = torch.from_numpy(held(windows.actions, steps)[:, 0])
        after = world.step(state, actions, self.rng.integers(2**31, size=count).tolist()).frames
        progress = np.array([examples.progress(p, spec.chunk) for p in at])
        return windows.frames[:, -2], after.cpu().numpy(), success, progress


def cut_alike(steps: np.ndarray, success: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """How many actions of a chunk to believe in, so that successes and failures are cut short equally often.

    Args:
        steps: (M, D) actions that were executed.
        success: bool (M, D), whether that achieved the task.
        rng: draws, for each failure of a column, the steps of one of its successes.

    Returns:
        (M, D), never more than were executed.
    """
    cut_ = steps.copy()
    for d in range(steps.shape[1]):
        of = steps[success[:, d], d]
        if len(of):
            failed = ~success[:, d]
            cut_[failed, d] = np.minimum(steps[failed, d], rng.choice(of, int(failed.sum())))
    return cut_


def context_of(windows: Windows, rows: slice = slice(None)) -> Context:
    """What a world model is shown of some windows before they begin."""
    known = windows.context
    parts = (windows.frames[rows, :known], windows.state[rows, :known], windows.before[rows])
    return Context(*(torch.from_numpy(part) for part in parts))


def new_success_model(chunk: int) -> SuccessPairsRewardModel:
    """One of the default size, for the CPU."""
    return SuccessPairsRewardModel(SuccessPairsConfig(chunk=chunk, device="cpu"))


def as_floats(frames: np.ndarray, device: torch.device) -> torch.Tensor:
    """uint8 (B, V, H, W, 3) to float (B, V, 3, H, W) in [0, 1], what a success model looks at."""
    return torch.from_numpy(frames).movedim(-1, 2).to(device).float() / 255


@torch.no_grad()
def probabilities(
    success: SuccessPairsRewardModel, before: np.ndarray, after: np.ndarray, batch: int = 64
) -> np.ndarray:
    """float32 (M,): P that the second frames show a success; frames uint8 (M, V, H, W, 3)."""
    device = success.out.weight.device
    parts = [
        torch.sigmoid(
            success.logits(as_floats(before[i : i + batch], device), as_floats(after[i : i + batch], device))[
                0
            ]
        )
        for i in range(0, len(before), batch)
    ]
    return torch.cat(parts).cpu().numpy() if parts else np.zeros(0, np.float32)
