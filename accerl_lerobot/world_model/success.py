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
"""Training the success model beside a world model, on the same windows.

Half of every batch are chunks that achieved the task, which are rare otherwise. The frames after a chunk are
partly the world model's dreams of it: what it will be asked to judge has that look.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from accerl_lerobot.world_model.config import SuccessLearnConfig
from accerl_lerobot.world_model.contract import WorldModel
from accerl_lerobot.world_model.episodes import Episode, Place, cut, places
from accerl_lerobot.world_model.success_plugin import SuccessPairsConfig
from accerl_lerobot.world_model.success_plugin.modeling_success_pairs import SuccessPairsRewardModel


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
        self._optimizer = torch.optim.AdamW(
            model.parameters(), lr=config.lr, weight_decay=config.weight_decay
        )

    def step(self, episodes: Sequence[Episode], world: WorldModel) -> dict[str, float]:
        """Learns once from windows of these episodes.

        Raises:
            ValueError: no chunk of them achieved the task, or every one did.
        """
        spec = world.spec
        at = self._draw(episodes, spec.chunk)
        windows = cut(episodes, at, chunk=spec.chunk, context=spec.context, chunks=1)
        before, after = windows.frames[:, -2], windows.frames[:, -1].copy()
        rows = np.flatnonzero(self.rng.random(len(at)) < self.config.dreamt)
        if len(rows):
            frames = torch.from_numpy(windows.frames[rows, : spec.context])
            state = world.begin(
                frames, torch.from_numpy(windows.state[rows, 0]), [windows.task[r] for r in rows]
            )
            seeds = self.rng.integers(2**31, size=len(rows)).tolist()
            after[rows] = (
                world.step(state, torch.from_numpy(windows.actions[rows, 0]), seeds).frames.cpu().numpy()
            )
        progress = np.array([_progress(episodes[p.episode], p.frame, spec.chunk) for p in at], np.float32)
        device = self.model.out.weight.device
        loss, metrics = self.model.loss(
            as_floats(before, device),
            as_floats(after, device),
            torch.from_numpy(windows.success[:, 0].astype(np.float32)).to(device),
            torch.from_numpy(progress).to(device),
        )
        self._optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.model.parameters(), 1.0)
        self._optimizer.step()
        return metrics

    def _draw(self, episodes: Sequence[Episode], chunk: int) -> list[Place]:
        achieving: list[Place] = []
        others: list[Place] = []
        for place in places(episodes):
            episode = episodes[place.episode]
            start = episode.times[place.frame]
            (achieving if start <= episode.success_at < start + chunk else others).append(place)
        if not achieving or not others:
            raise ValueError(f"{len(achieving)} chunks that achieve the task and {len(others)} that do not")
        half = self.config.batch // 2
        return [achieving[i] for i in self.rng.integers(len(achieving), size=half)] + [
            others[i] for i in self.rng.integers(len(others), size=self.config.batch - half)
        ]


def new_success_model(chunk: int) -> SuccessPairsRewardModel:
    """One of the default size, for the CPU."""
    return SuccessPairsRewardModel(SuccessPairsConfig(chunk=chunk, device="cpu"))


def _progress(episode: Episode, frame: int, chunk: int) -> float:
    """How far towards its success an episode is after a chunk; NaN if there is none."""
    if not episode.success:
        return float("nan")
    return min(1.0, (int(episode.times[frame]) + chunk) / (episode.success_at + 1))


def as_floats(frames: np.ndarray, device: torch.device) -> torch.Tensor:
    """uint8 (B, V, H, W, 3) to float (B, V, 3, H, W) in [0, 1], what a success model looks at."""
    return torch.from_numpy(frames).movedim(-1, 2).to(device).float() / 255
