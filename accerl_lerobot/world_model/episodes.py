# SPDX-License-Identifier: Apache-2.0
"""Episodes as a world model learns from them: frames, actions between them, and windows cut from both.

An `Episode` keeps the frames that were looked at, each with the env step it shows: every step of a
demonstration, every K-th of an episode played by a policy. A window begins at one of them and goes K env
steps at a time; the frame after a chunk is the one looked at then, or the last one if the episode ended
within it.

NumPy only. Shapes: F frames of an episode, T env steps, V cameras, H×W pixels, S state dims, A action dims,
K env steps of a chunk, L frames of context, R chunks of a window, B batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from accerl_lerobot.checkpoint.snapshot import kind


@kind
@dataclass(frozen=True, kw_only=True)
class Episode:
    """One episode.

    Raises:
        ValueError: the arrays do not fit each other.
    """

    frames: np.ndarray
    """uint8 (F, V, H, W, 3)."""
    times: np.ndarray
    """int64 (F,), how many env steps had been made at each frame; rising, from 0."""
    state: np.ndarray
    """float32 (F, S); S may be 0."""
    actions: np.ndarray
    """float32 (T, A), as they were executed, in the world's units."""
    success_at: int
    """Index of the step that achieved the task; −1 for never."""
    task: str
    """The instruction."""
    source: str
    """Where it is from: ``demo``, or ``online``, or what an evaluation calls it."""

    def __post_init__(self) -> None:
        f, t = len(self.frames), len(self.actions)
        if not f == len(self.times) == len(self.state) or f == 0 or t == 0:
            raise ValueError(f"{f} frames, {len(self.times)} times, {len(self.state)} states, {t} actions")
        if self.times[0] != 0 or (np.diff(self.times) <= 0).any() or self.times[-1] > t:
            raise ValueError(f"times rise from 0 to at most {t}, not {self.times.tolist()}")
        if not -1 <= self.success_at < t:
            raise ValueError(f"success at step {self.success_at} of {t}")

    @property
    def success(self) -> bool:
        """True if the task was achieved."""
        return self.success_at >= 0

    @property
    def achieved(self) -> np.ndarray:
        """bool (F,), whether a frame shows the task achieved.

        Demonstrations have no frame after their last step: the one before it counts.
        """
        shown: np.ndarray = self.times > self.success_at if self.success else np.zeros(len(self.times), bool)
        if self.success and not shown.any():
            shown[-1] = True
        return shown

    @property
    def starts(self) -> int:
        """How many frames, from the first on, show a task that is still to be achieved, and are followed."""
        followed = len(self.frames) - 1
        if not self.success:
            return followed
        return min(followed, int(np.searchsorted(self.times, self.success_at, side="right")))

    def __len__(self) -> int:
        """Env steps."""
        return len(self.actions)


class Place(NamedTuple):
    """Where a window begins."""

    episode: int
    frame: int


@dataclass(frozen=True, kw_only=True)
class Windows:
    """A batch of them. What lies beyond an episode's end repeats its last frame and is not `valid`."""

    frames: np.ndarray
    """uint8 (B, L + R, V, H, W, 3): the context, the window's first frame last, then one after each chunk."""
    anchor: np.ndarray
    """uint8 (B, V, H, W, 3): a frame some chunks before the first, where imagination would have begun."""
    state: np.ndarray
    """float32 (B, L + R, S), at each of these."""
    before: np.ndarray
    """float32 (B, L − 1, K, A), actions between the frames of the context; zero where none was made."""
    told: np.ndarray
    """float32 (B, A), the sum of the actions before the window's first frame."""
    first: np.ndarray
    """float32 (B, S), where the robot was when its episode began."""
    actions: np.ndarray
    """float32 (B, R, K, A), zero where none was executed."""
    steps: np.ndarray
    """int64 (B, R), how many of a chunk's actions lie between its frames; 0 beyond the end."""
    success: np.ndarray
    """bool (B, R), whether the task was achieved in this chunk."""
    valid: np.ndarray
    """bool (B, R), whether the chunk's frame shows what follows, at least one step on."""
    episode: np.ndarray
    """int64 (B,), which episode each is from."""
    task: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def context(self) -> int:
        """L."""
        return self.before.shape[1] + 1

    def rows(self, chosen: Sequence[int]) -> Windows:
        """Some of them."""
        arrays = {k: v[list(chosen)] for k, v in vars(self).items() if k != "task"}
        return Windows(**arrays, task=tuple(self.task[i] for i in chosen))


def held(actions: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Chunks made whole: an action that was not executed is replaced by the last one that was.

    Args:
        actions: (B, R, K, A).
        steps: int (B, R), how many of each were.
    """
    b, r, k, a = actions.shape
    made = (np.arange(k) < steps[..., None]).reshape(b, r * k)
    last = np.maximum.accumulate(np.where(made, np.arange(r * k), 0), axis=1)
    return np.take_along_axis(actions.reshape(b, r * k, a), last[..., None], 1).reshape(actions.shape)


def places(episodes: Sequence[Episode]) -> list[Place]:
    """Every frame that something follows, of every episode."""
    return [Place(e, f) for e, episode in enumerate(episodes) for f in range(len(episode.frames) - 1)]


def cut(
    episodes: Sequence[Episode],
    at: Sequence[Place],
    *,
    chunk: int,
    context: int,
    chunks: int,
    anchors: Sequence[int] | None = None,
) -> Windows:
    """The windows at these places.

    Args:
        episodes: of one kind: cameras, sizes.
        at: where they begin.
        chunk: K.
        context: L ≥ 1.
        chunks: R ≥ 1.
        anchors: for each, how many chunks before its first frame the anchor lies; None: 0, the first frame.
    """
    rows = [
        _window(episodes[place.episode], place.frame, chunk, context, chunks, anchor)
        for place, anchor in zip(at, anchors or [0] * len(at), strict=True)
    ]
    stacked = {key: np.stack([row[key] for row in rows]) for key in rows[0]}
    return Windows(
        **stacked,
        episode=np.array([p.episode for p in at], np.int64),
        task=tuple(episodes[p.episode].task for p in at),
    )


def _window(
    episode: Episode, first: int, chunk: int, context: int, chunks: int, anchor: int
) -> dict[str, np.ndarray]:
    times, start = episode.times, int(episode.times[first])

    def frame(time: int) -> int:
        """The last one looked at by then."""
        return int(np.searchsorted(times, max(0, time), side="right")) - 1

    before = [frame(start - chunk * i) for i in range(context - 1, 0, -1)]
    made_before = np.zeros((context - 1, chunk, episode.actions.shape[1]), np.float32)
    for i in range(1, context):
        then = start - chunk * i
        known = episode.actions[max(0, then) : max(0, then + chunk)]
        if len(known):
            made_before[-i, -len(known) :] = known
    path, actions, steps, success = [first], [], [], []
    for r in range(chunks):
        then = start + chunk * r
        following = max(path[-1], frame(then + chunk))
        # Actions between the two frames: the chunk's, unless the last frame comes before its end.
        made = int(np.clip(times[following] - then, 0, chunk))
        padded = np.zeros((chunk, episode.actions.shape[1]), np.float32)
        padded[:made] = episode.actions[then : then + made]
        path.append(following)
        actions.append(padded)
        steps.append(made)
        success.append(then <= episode.success_at < then + chunk)
    executed = np.array(steps, np.int64)
    return {
        "frames": episode.frames[before + path],
        "anchor": episode.frames[frame(start - chunk * anchor)],
        "state": episode.state[before + path],
        "before": made_before,
        "told": episode.actions[:start].sum(0, dtype=np.float32),
        "first": episode.state[0],
        "actions": np.stack(actions),
        "steps": executed,
        "success": np.array(success),
        "valid": executed > 0,
    }


def amount(episodes: Sequence[Episode]) -> dict[str, int]:
    """How many, and of how many env steps."""
    return {"episodes": len(episodes), "env_steps": sum(map(len, episodes))}


def longest(episodes: Sequence[Episode], chunk: int) -> int:
    """How many chunks of so many env steps the longest of them takes."""
    return max(-(-len(episode) // chunk) for episode in episodes)


def split(episodes: Sequence[Episode], share: float, rng: np.random.Generator) -> tuple[list[int], list[int]]:
    """Episodes to learn from and episodes to be judged on, as indices; each kind of outcome is split alike.

    Args:
        episodes: at least one of each outcome gets into either part, where there are two.
        share: of those held out, in (0, 1).
    """
    learn: list[int] = []
    held: list[int] = []
    for outcome in (False, True):
        of = [i for i, e in enumerate(episodes) if e.success is outcome]
        rng.shuffle(of)
        count = min(max(1, round(share * len(of))), len(of) - 1) if len(of) > 1 else 0
        held += of[:count]
        learn += of[count:]
    return sorted(learn), sorted(held)
