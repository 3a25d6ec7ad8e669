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
"""Dreams beside what really happened, for people."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from accerl_lerobot.evaluation.pictures import write_video
from accerl_lerobot.world_model.config import TrialConfig
from accerl_lerobot.world_model.contract import WorldModel
from accerl_lerobot.world_model.episodes import Episode
from accerl_lerobot.world_model.replayed import dream
from accerl_lerobot.world_model.trial import trial_windows, wrong_actions

FILMED, SCALE = 4, 3
"""Trials in the preview, and how much larger than life."""
FPS = 4
"""Chunks shown per second."""


def film(path: Path, model: WorldModel, episodes: Sequence[Episode], config: TrialConfig, seed: int) -> None:
    """Real, dreamt, and dreamt with another episode's actions, one row each."""
    windows = trial_windows(episodes, model, config, seed)
    rng = np.random.default_rng((seed, 3))
    rows = sorted(rng.choice(len(windows), min(FILMED, len(windows)), replace=False).tolist())
    filmed, context = windows.rows(rows), model.spec.context
    lines = [filmed.frames[:, context - 1 :]]
    for arm in ("true", "shuffled"):
        dreamt = dream(model, filmed, wrong_actions(windows, arm, rng)[rows]).frames
        lines.append(np.concatenate([filmed.frames[:, context - 1 : context], dreamt], 1))
    write_video(path, [[list(_large(clip)) for clip in line] for line in lines], fps=FPS)


def _large(frames: np.ndarray) -> np.ndarray:
    """(D, V, H, W, 3) as (D, SCALE·H, V·SCALE·W, 3): cameras beside each other."""
    beside = np.concatenate(list(frames.transpose(1, 0, 2, 3, 4)), axis=2)
    return beside.repeat(SCALE, 1).repeat(SCALE, 2)
