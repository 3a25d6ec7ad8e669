# SPDX-License-Identifier: Apache-2.0
"""Dreams beside what really happened, for people."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from accerl_lerobot.evaluation.pictures import captioned, write_video
from accerl_lerobot.world_model.config import TrialConfig
from accerl_lerobot.world_model.contract import WorldModel
from accerl_lerobot.world_model.episodes import Episode, Place, longest
from accerl_lerobot.world_model.replayed import dream, replay
from accerl_lerobot.world_model.stand_in import SuccessModel
from accerl_lerobot.world_model.success import probabilities
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


def beside(
    path: Path, model: WorldModel, success: SuccessModel | None, episode: Episode, scale: int = SCALE
) -> None:
    """An episode above, and below it what is dreamt with the same actions, from its beginning to its end.

    A frame at the end tells by its colour how it went: green is success, red failure. A dream that is once
    taken for a success has succeeded.

    Args:
        path: .mp4 to write; it appears when it is whole.
        model: that dreams.
        success: what tells the dream's successes; None: no dream has one.
        episode: that happened.
        scale: how much larger than life.
    """
    depth = longest([episode], model.spec.chunk)
    replayed = replay(model, [episode], [Place(0, 0)], depth)
    made = int(replayed.made.sum())
    dreamt = np.concatenate([replayed.newest, replayed.dreams.frames[0, :made]])
    real = replayed.windows.frames[0, model.spec.context - 1 :][: made + 1]
    taken = success is not None and bool(
        (probabilities(success, dreamt[:-1], dreamt[1:]) > success.config.threshold).any()
    )
    rows = [
        [captioned(list(_large(frames, scale)), name, achieved)]
        for frames, name, achieved in ((real, "happened", episode.success), (dreamt, "dreamt", taken))
    ]
    part = path.with_name(f".{path.name}")
    write_video(part, rows, fps=FPS)
    os.replace(part, path)


class TrialFilms:
    """A film of every so-and-so-many trials of what goes on learning in a run.

    Args:
        folder: where they are to be; it is made with the first.
        every: trials between two films.
    """

    def __init__(self, folder: Path, every: int) -> None:
        self.folder, self.every = folder, every

    def __call__(
        self, model: WorldModel, success: SuccessModel, episode: Episode, number: int, passed: bool
    ) -> None:
        """After a trial.

        Args:
            model: that was tried.
            success: beside it.
            episode: one that neither has learnt from.
            number: of the trial, from 1.
            passed: how it ended.
        """
        if (number - 1) % self.every:
            return
        self.folder.mkdir(exist_ok=True)
        name = f"{number:04d}_{'passed' if passed else 'failed'}.mp4"
        beside(self.folder / name, model, success, episode)


def _large(frames: np.ndarray, scale: int = SCALE) -> np.ndarray:
    """(D, V, H, W, 3) as (D, scale·H, V·scale·W, 3): cameras beside each other."""
    beside_ = np.concatenate(list(frames.transpose(1, 0, 2, 3, 4)), axis=2)
    return beside_.repeat(scale, 1).repeat(scale, 2)
