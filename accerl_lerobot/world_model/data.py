# SPDX-License-Identifier: Apache-2.0
"""Training data of world models: episodes, windows cut from them, and reading both from a LeRobotDataset.

An `Episode` keeps the recorded frames, each with its env step: every step of a demonstration, every K-th of
an episode played by a policy. A window begins at one of them and goes K env steps at a time; the frame after
a chunk is the one recorded then, or the last one if the episode ended within it.

Shapes: F frames of an episode, T env steps, V cameras, H×W pixels, S state dims, A action dims, K env steps
of a chunk, L frames of context, R chunks of a window, B batch.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from accerl_lerobot.checkpoint.snapshot import kind
from accerl_lerobot.demos.dataset_files import frames_of, open_metadata, opened, pixels_of
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import SUCCESS, TASK, Observation

if TYPE_CHECKING:
    from accerl_lerobot.config.ranges import DatasetConfig
    from accerl_lerobot.envs.base import WorldSpec
    from accerl_lerobot.world_model.contract import WorldModelSpec


@kind
@dataclass(frozen=True, kw_only=True)
class Episode:
    """One recorded episode.

    Raises:
        ValueError: the arrays do not fit each other.
    """

    frames: np.ndarray
    """uint8 (F, V, H, W, 3)."""
    times: np.ndarray
    """int64 (F,), env steps before each frame; rising, from 0."""
    state: np.ndarray
    """float32 (F, S); S may be 0."""
    actions: np.ndarray
    """float32 (T, A), as executed, in the environment's units."""
    success_at: int
    """Index of the step that achieved the task; −1 for never."""
    task: str
    """The instruction."""
    source: str
    """``demo``, ``online``, or another name that an evaluation gives it."""

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
        """bool (F,), True for frames that show the task achieved.

        Demonstrations have no frame after their last step: the one before it counts.
        """
        shown: np.ndarray = self.times > self.success_at if self.success else np.zeros(len(self.times), bool)
        if self.success and not shown.any():
            shown[-1] = True
        return shown

    @property
    def starts(self) -> int:
        """Number of frames, from the first on, that are followed by another and precede the success."""
        followed = len(self.frames) - 1
        if not self.success:
            return followed
        return min(followed, int(np.searchsorted(self.times, self.success_at, side="right")))

    def __len__(self) -> int:
        """Env steps."""
        return len(self.actions)


class WindowStart(NamedTuple):
    """Indices of an episode and of one of its frames."""

    episode: int
    frame: int


@dataclass(frozen=True, kw_only=True)
class Windows:
    """A batch of windows. Chunks beyond an episode's end repeat its last frame and are not `valid`."""

    frames: np.ndarray
    """uint8 (B, L + R, V, H, W, 3): the context, the window's first frame last, then one after each chunk."""
    anchor: np.ndarray
    """uint8 (B, V, H, W, 3): a frame some chunks before the first, where a rollout would have started."""
    state: np.ndarray
    """float32 (B, L + R, S), at each of these."""
    before: np.ndarray
    """float32 (B, L − 1, K, A), actions between the frames of the context; zero where none was executed."""
    commanded_sum: np.ndarray
    """float32 (B, A), the sum of the actions before the window's first frame."""
    initial_state: np.ndarray
    """float32 (B, S), the robot's state when the episode began."""
    actions: np.ndarray
    """float32 (B, R, K, A), zero where none was executed."""
    steps: np.ndarray
    """int64 (B, R), how many of a chunk's actions lie between its frames; 0 beyond the end."""
    success: np.ndarray
    """bool (B, R), True if the task was achieved in this chunk."""
    valid: np.ndarray
    """bool (B, R), True if the chunk's frame is at least one step later than the one before."""
    episode: np.ndarray
    """int64 (B,), index of the episode."""
    task: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def context(self) -> int:
        """L."""
        return self.before.shape[1] + 1

    def rows(self, chosen: Sequence[int]) -> Windows:
        """Selects some of the windows."""
        arrays = {k: v[list(chosen)] for k, v in vars(self).items() if k != "task"}
        return Windows(**arrays, task=tuple(self.task[i] for i in chosen))


def hold_last_action(actions: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Fills chunks (B, R, K, A) up: actions beyond `steps` (B, R) repeat the last executed one."""
    b, r, k, a = actions.shape
    executed = (np.arange(k) < steps[..., None]).reshape(b, r * k)
    last = np.maximum.accumulate(np.where(executed, np.arange(r * k), 0), axis=1)
    return np.take_along_axis(actions.reshape(b, r * k, a), last[..., None], 1).reshape(actions.shape)


def window_starts(episodes: Sequence[Episode]) -> list[WindowStart]:
    """Every frame that is followed by another, of every episode."""
    return [WindowStart(e, f) for e, episode in enumerate(episodes) for f in range(len(episode.frames) - 1)]


def cut_windows(
    episodes: Sequence[Episode],
    at: Sequence[WindowStart],
    *,
    chunk: int,
    context: int,
    chunks: int,
    anchors: Sequence[int] | None = None,
) -> Windows:
    """Cuts windows of R = `chunks` chunks of K = `chunk` env steps, with L = `context` frames.

    The anchor of each lies so many chunks before its first frame; None: it is the first frame.
    """
    rows = [
        _window(episodes[start.episode], start.frame, chunk, context, chunks, anchor)
        for start, anchor in zip(at, anchors or [0] * len(at), strict=True)
    ]
    stacked = {key: np.stack([row[key] for row in rows]) for key in rows[0]}
    return Windows(
        **stacked,
        episode=np.array([start.episode for start in at], np.int64),
        task=tuple(episodes[start.episode].task for start in at),
    )


def _window(
    episode: Episode, first: int, chunk: int, context: int, chunks: int, anchor: int
) -> dict[str, np.ndarray]:
    times, start = episode.times, int(episode.times[first])

    def frame(time: int) -> int:
        """Index of the last frame recorded by then."""
        return int(np.searchsorted(times, max(0, time), side="right")) - 1

    before = [frame(start - chunk * i) for i in range(context - 1, 0, -1)]
    actions_before = np.zeros((context - 1, chunk, episode.actions.shape[1]), np.float32)
    for i in range(1, context):
        then = start - chunk * i
        known = episode.actions[max(0, then) : max(0, then + chunk)]
        if len(known):
            actions_before[-i, -len(known) :] = known
    path, actions, steps, success = [first], [], [], []
    for r in range(chunks):
        then = start + chunk * r
        following = max(path[-1], frame(then + chunk))
        # Actions between the two frames: the chunk's, unless the last frame comes before its end.
        executed = int(np.clip(times[following] - then, 0, chunk))
        padded = np.zeros((chunk, episode.actions.shape[1]), np.float32)
        padded[:executed] = episode.actions[then : then + executed]
        path.append(following)
        actions.append(padded)
        steps.append(executed)
        success.append(then <= episode.success_at < then + chunk)
    counts = np.array(steps, np.int64)
    return {
        "frames": episode.frames[before + path],
        "anchor": episode.frames[frame(start - chunk * anchor)],
        "state": episode.state[before + path],
        "before": actions_before,
        "commanded_sum": episode.actions[:start].sum(0, dtype=np.float32),
        "initial_state": episode.state[0],
        "actions": np.stack(actions),
        "steps": counts,
        "success": np.array(success),
        "valid": counts > 0,
    }


def count_episodes(episodes: Sequence[Episode]) -> dict[str, int]:
    """Numbers of ``episodes`` and ``env_steps``."""
    return {"episodes": len(episodes), "env_steps": sum(map(len, episodes))}


def longest_rollout(episodes: Sequence[Episode], chunk: int) -> int:
    """Chunks of the longest episode."""
    return max(-(-len(episode) // chunk) for episode in episodes)


def split_episodes(
    episodes: Sequence[Episode], share: float, rng: np.random.Generator
) -> tuple[list[int], list[int]]:
    """Indices of episodes to train on and of a held-out share.

    Successes and failures are split alike; where there are two of a kind, each part gets at least one.
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


# Observations, as world models and as policies see them.


def resize(frames: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Frames uint8 (B, h, w, 3) at size (H, W); the same array if that is theirs."""
    if frames.shape[1:3] == size:
        return frames
    import torch
    from torch.nn import functional

    tall = torch.from_numpy(frames).permute(0, 3, 1, 2).float()
    tall = functional.interpolate(tall, size=size, mode="bilinear", antialias=True)
    resized: np.ndarray = tall.round().clamp(0, 255).byte().permute(0, 2, 3, 1).contiguous().numpy()
    return resized


def model_arrays(observations: dict[str, np.ndarray], spec: WorldModelSpec) -> tuple[np.ndarray, np.ndarray]:
    """Frames uint8 (N, V, H, W, 3) and states float32 (N, S) of N observations."""
    frames = np.stack([resize(observations[camera], spec.image_size) for camera in spec.cameras], 1)
    no_state = np.zeros((len(frames), 0), np.float32)
    return frames, observations["observation.state"] if spec.state_dim else no_state


def policy_observation(
    frames: np.ndarray, robot: np.ndarray, task: str, spec: WorldModelSpec, world: WorldSpec
) -> Observation:
    """Observation of frames (V, H, W, 3) and a state (S,), in the sizes of the policy's environment."""
    observation: Observation = {TASK: task}
    for v, camera in enumerate(spec.cameras):
        if camera in world.images:
            observation[camera] = resize(frames[v : v + 1], world.images[camera][:2])[0]
    if world.state_dim:
        observation["observation.state"] = robot
    return observation


def executed_actions(chunks: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Actions (t, A) of chunks (T, K, A) of which the first `steps` (T,) each were executed."""
    actions: np.ndarray = chunks[np.arange(chunks.shape[1]) < steps[:, None]]
    return actions


# LeRobotDatasets.


def load_episodes(
    dataset: DatasetConfig,
    spec: WorldModelSpec,
    source: str = "demo",
    *,
    both: bool = True,
    only: Sequence[int] | None = None,
) -> list[Episode]:
    """Reads a LeRobotDataset into memory, one uint8 image of the spec's size per env step and camera.

    Args:
        dataset: on the Hub, or in a folder.
        spec: of the world model.
        source: see `Episode`.
        both: refuse a dataset without a success, or without a failure.
        only: indices of the episodes to read; None: all.

    Raises:
        InputError: a camera, the success labels or the rate do not match; state or actions are another
            robot's; a single episode; only successes, or only failures.
    """
    meta = open_metadata(dataset)
    check_metadata(meta, dataset.repo_id or "", spec)
    indices = range(meta.total_episodes) if only is None else only
    with opened(dataset, meta) as data:
        episodes = [_episode(data, index, spec, source) for index in indices]
    remedies = {True: "add episodes that succeed", False: "add failures, see demos.failure_share"}
    for outcome, remedy in remedies.items() if both else ():
        if not any(e.success is outcome for e in episodes):
            why = f"no {'success' if outcome else 'failure'} among {len(episodes)} episodes; {remedy}"
            raise InputError("dataset.repo_id", dataset.repo_id, why)
    return episodes


def fingerprint(meta: Any) -> str:
    """Hash of the lengths of a dataset's episodes, in their order, and of statistics of its actions.

    It identifies a dataset whatever its name.
    """
    moments = [np.asarray(meta.stats["action"][k], np.float64).round(6).tolist() for k in ("mean", "std")]
    ends = [list(map(int, meta.episodes[f"dataset_{end}_index"])) for end in ("from", "to")]
    content = json.dumps([ends, meta.fps, moments])
    return hashlib.sha256(content.encode()).hexdigest()


def check_metadata(meta: Any, name: str, spec: WorldModelSpec) -> None:
    """Refuses a dataset that a world model of `spec` cannot be trained on, before any image is read.

    Raises:
        InputError: see `load_episodes`.
    """

    def refuse(why: str) -> InputError:
        return InputError("dataset.repo_id", name, why)

    for camera in spec.cameras:
        if camera not in meta.features:
            cameras = ", ".join(meta.camera_keys) or "no camera"
            raise refuse(f"no {camera}: the dataset has {cameras}; choose env.camera accordingly")
    sizes = {"action": spec.action_dim} | ({"observation.state": spec.state_dim} if spec.state_dim else {})
    for key, size in sizes.items():
        shape = tuple(meta.features[key]["shape"]) if key in meta.features else None
        if shape != (size,):
            raise refuse(f"{key} has shape {shape}, the world's has ({size},): it is another robot's")
    if SUCCESS not in meta.features:
        raise refuse(f"no {SUCCESS}: record it, as accerl demos does, or add it to the dataset")
    if meta.fps != spec.fps:
        why = f"{meta.fps} frames a second, and the world makes {spec.fps} steps"
        raise refuse(f"{why}: its chunks would be other chunks; record at the world's rate")
    if meta.total_episodes < 2:
        raise refuse("a single episode; at least one to train on and one to hold out are needed")


def _episode(data: Any, index: int, spec: WorldModelSpec, source: str) -> Episode:
    items = list(frames_of(data, index))
    success = np.array([bool(item[SUCCESS]) for item in items])
    state = [item["observation.state"].numpy() if spec.state_dim else np.zeros(0) for item in items]
    images = [np.stack([pixels_of(item[camera]) for item in items]) for camera in spec.cameras]
    actions = np.stack([item["action"].numpy() for item in items])
    if not (np.isfinite(actions).all() and np.isfinite(np.stack(state)).all()):
        raise InputError("dataset.repo_id", data.repo_id, f"episode {index} has a NaN state or action")
    return Episode(
        frames=np.stack([resize(frames, spec.image_size) for frames in images], 1),
        times=np.arange(len(items)),
        state=np.stack(state).astype(np.float32),
        actions=actions.astype(np.float32),
        success_at=int(success.argmax()) if success.any() else -1,
        task=str(items[0]["task"]),
        source=source,
    )
