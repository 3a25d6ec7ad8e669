# SPDX-License-Identifier: Apache-2.0
"""The interface of a pixel world model, and the episodes that it is trained on.

A model starts at real observations and predicts one chunk at a time:

    state = model.begin(context, tasks)
    prediction = model.step(state, actions)    # .frames, .robot; the next step starts at .state

It learns by `loss`. `pixels.py` has our model, and ``docs/world_model.md`` says how to add another.

An `Episode` keeps the recorded frames, each with its env step: every step of a demonstration, every K-th of
an episode played by a policy. A window begins at one of them and goes K env steps at a time; the frame after
a chunk is the one recorded then, or the last one if the episode ended within it.

States are dicts of tensors with the batch in front. Shapes: B batch, R chunks of a window, V cameras, H×W
pixels, S robot state dims, K env steps of a chunk, A action dims, F frames of an episode, T env steps.
"""

from __future__ import annotations

import hashlib
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from accerl_lerobot.checkpoint.snapshot import kind
from accerl_lerobot.demos.dataset_files import numbers, observations, open_metadata, opened, read_labels
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import REWARD, SUCCESS, Segment, task_codes
from accerl_lerobot.policies.features import STATE

if TYPE_CHECKING:
    from accerl_lerobot.config.ranges import DatasetConfig
    from accerl_lerobot.envs.base import EnvironmentSpec
    from accerl_lerobot.world_model.config import LearnableModelConfig

State = dict[str, Tensor]  # each (B, ...)
CONTEXT = 2  # frames that a model sees, a chunk apart


@dataclass(frozen=True, kw_only=True)
class WorldModelSpec:
    """Sizes of a world model, and the environment it models."""

    cameras: tuple[str, ...]  # ``observation.images.<camera>``, in the order of V
    image_size: tuple[int, int]  # (H, W)
    state_dim: int  # S; 0: there is no ``observation.state``
    action_dim: int
    chunk: int  # K
    fps: int  # env steps per second, which a dataset must have too
    labelled_fps: tuple[int, ...] = ()  # see `EnvironmentSpec.labelled_fps`


def spec_of(environment: EnvironmentSpec, side: int, chunk: int) -> WorldModelSpec:
    """The spec of a world model of an environment, with square images."""
    return WorldModelSpec(
        cameras=tuple(environment.images),
        image_size=(side, side),
        state_dim=environment.state_dim,
        action_dim=environment.action_dim,
        chunk=chunk,
        fps=environment.fps,
        labelled_fps=environment.labelled_fps,
    )


class Prediction(NamedTuple):
    """Predicted observation after a chunk."""

    state: State  # input of the next `LearnableWorldModel.step`
    frames: Tensor  # uint8 (B, V, H, W, 3)
    robot: Tensor  # float32 (B, S), in the environment's units


class Context(NamedTuple):
    """The observation at which a rollout starts, and the one a chunk before.

    The episode's beginning is part of it. With relative actions `commanded_sum` tells the place that the
    robot is commanded to be at, and may not have reached yet.
    """

    frames: Tensor  # uint8 (B, 2, V, H, W, 3), the newest last
    robot: Tensor  # float32 (B, 2, S)
    actions: Tensor  # float32 (B, K, A), executed between these; zero before the episode began
    first_frame: Tensor  # uint8 (B, V, H, W, 3), of the episode
    first_robot: Tensor  # float32 (B, S), of the episode
    commanded_sum: Tensor  # float32 (B, A), of the actions since the episode began


class Windows(NamedTuple):
    """A batch of windows. Chunks beyond an episode's end repeat its last frame and its last action."""

    context: Context
    tasks: tuple[str, ...]  # B instructions
    codes: Tensor  # float32 (B, 16), `task_codes` of these
    frames: Tensor  # uint8 (B, R, V, H, W, 3), after each chunk
    robot: Tensor  # float32 (B, R, S), after each chunk
    actions: Tensor  # float32 (B, R, K, A)
    steps: Tensor  # int64 (B, R), how many of a chunk's actions lie between its frames; 0 beyond the end
    known: Tensor  # bool (B, R), True for the chunks of the episode
    success: Tensor  # bool (B, R), True if the task was achieved in this chunk

    @property
    def known_codes(self) -> Tensor:
        """float32 (N, 16), task codes of the N chunks that are `known`."""
        return self.codes.repeat_interleave(self.known.sum(1), 0)


class LearnableWorldModel(nn.Module):
    """A world model that is trained, see `training.Trainer`; its ``state_dict`` is saved.

    All inputs are on its device. Randomness is torch's global generator's.
    """

    def __init__(self, spec: WorldModelSpec, config: LearnableModelConfig) -> None:
        super().__init__()
        self.spec = spec
        self.config = config

    @abstractmethod
    def fit_statistics(self, windows: Windows) -> None:
        """Fits normalisation statistics to many windows, once, before the first loss."""

    @abstractmethod
    def begin(self, context: Context, tasks: Sequence[str]) -> State:
        """Starts B rollouts at their last real observations."""

    @abstractmethod
    def step(self, state: State, actions: Tensor) -> Prediction:
        """Predicts one chunk further from a state, which is not modified.

        Actions are float32 (B, K, A), in the environment's units.
        """

    @abstractmethod
    def loss(self, windows: Windows) -> tuple[Tensor, dict[str, float]]:
        """Loss of a batch of real windows, a scalar, and metrics."""


@torch.no_grad()
def replay(model: LearnableWorldModel, windows: Windows) -> Tensor:
    """Frames predicted after each chunk from the executed actions, uint8 (B, R, V, H, W, 3)."""
    state = model.begin(windows.context, windows.tasks)
    frames = []
    for actions in windows.actions.unbind(1):
        prediction = model.step(state, actions)
        frames.append(prediction.frames)
        state = prediction.state
    return torch.stack(frames, 1)


@kind
@dataclass(frozen=True, kw_only=True)
class Episode:
    """One recorded episode, which ends with its success."""

    frames: np.ndarray  # uint8 (F, V, H, W, 3)
    times: np.ndarray  # int64 (F,), env steps before each frame; rising, from 0
    state: np.ndarray  # float32 (F, S); S may be 0
    actions: np.ndarray  # float32 (T, A), as executed, in the environment's units
    success: bool
    task: str  # the instruction

    @property
    def key(self) -> str:
        """Identifies an episode, whatever dataset it is in."""
        return hashlib.sha256(self.actions.tobytes()).hexdigest()[:16]


class WindowStart(NamedTuple):
    """An episode, and the index of one of its frames."""

    episode: Episode
    frame: int


def starts_of(episodes: Sequence[Episode]) -> list[WindowStart]:
    """All starts of windows: frames that are followed by another."""
    starts = []
    for episode in episodes:
        starts += [WindowStart(episode, frame) for frame in range(len(episode.frames) - 1)]
    return starts


def cut_windows(
    at: Sequence[WindowStart],
    spec: WorldModelSpec,
    chunks: int | None = None,
    device: torch.device | str = "cpu",
) -> Windows:
    """Cuts windows of R = `chunks` chunks; None: as many as the longest of the episodes has."""
    if chunks is None:
        longest = max(len(start.episode.actions) for start in at)
        chunks = -(-longest // spec.chunk)
    rows = [_window(start.episode, start.frame, spec.chunk, chunks) for start in at]
    arrays = {}
    for name in rows[0]:
        arrays[name] = torch.from_numpy(np.stack([row[name] for row in rows])).to(device)
    frames = arrays.pop("frames")
    robot = arrays.pop("robot")
    context = Context(
        frames=frames[:, :CONTEXT],
        robot=robot[:, :CONTEXT],
        actions=arrays.pop("before"),
        first_frame=arrays.pop("first_frame"),
        first_robot=arrays.pop("first_robot"),
        commanded_sum=arrays.pop("commanded_sum"),
    )
    tasks = tuple(start.episode.task for start in at)
    codes = torch.from_numpy(task_codes(tasks)).to(device)
    frames = frames[:, CONTEXT:]
    robot = robot[:, CONTEXT:]
    return Windows(context=context, tasks=tasks, codes=codes, frames=frames, robot=robot, **arrays)


def _window(episode: Episode, first: int, size: int, chunks: int) -> dict[str, np.ndarray]:
    """Arrays of one window; ``frames`` and ``robot`` are those of the context and those after each chunk."""
    start = int(episode.times[first])
    length = len(episode.actions)
    boundaries = start + size * np.arange(1 - CONTEXT, chunks + 1)  # env steps between chunks
    begins = boundaries[CONTEXT - 1 : -1]
    ends = boundaries[CONTEXT:]
    latest = np.searchsorted(episode.times, boundaries, side="right") - 1
    shown = np.maximum(latest, 0)  # the first frame stands for those before the episode
    executed = start + np.arange(size * chunks)
    earlier = np.arange(start - size, start)
    actions = episode.actions[np.minimum(executed, length - 1)]
    known = begins < length
    return {
        "frames": episode.frames[shown],
        "robot": episode.state[shown],
        "before": episode.actions[np.maximum(earlier, 0)] * (earlier >= 0)[:, None],
        "first_frame": episode.frames[0],
        "first_robot": episode.state[0],
        "commanded_sum": episode.actions[:start].sum(0, dtype=np.float32),
        "actions": actions.reshape(chunks, size, -1),
        "steps": np.clip(episode.times[shown[CONTEXT:]] - begins, 0, size),
        "known": known,
        "success": known & (ends >= length) & episode.success,
    }


def resize(frames: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Frames uint8 (B, h, w, 3) at size (H, W); the same array if that is their size."""
    if frames.shape[1:3] == size:
        return frames
    tall = torch.from_numpy(frames).permute(0, 3, 1, 2).float()
    tall = functional.interpolate(tall, size=size, mode="bilinear", antialias=True)
    resized: np.ndarray = tall.round().clamp(0, 255).byte().permute(0, 2, 3, 1).contiguous().numpy()
    return resized


def model_arrays(arrays: dict[str, np.ndarray], spec: WorldModelSpec) -> tuple[np.ndarray, np.ndarray]:
    """Frames uint8 (N, V, H, W, 3) and states float32 (N, S) of N observations."""
    frames = np.stack([resize(arrays[camera], spec.image_size) for camera in spec.cameras], 1)
    state = arrays.get(STATE, np.zeros((len(frames), 0)))
    return frames, state.astype(np.float32)


def episode_of(segment: Segment, spec: WorldModelSpec) -> Episode:
    """The episode that a segment is the whole of; it has a frame per decision."""
    frames, robot = model_arrays(segment.observations, spec)
    executed = np.arange(segment.actions.shape[1]) < segment.steps[:, None]
    return Episode(
        frames=frames,
        times=np.append(0, np.cumsum(segment.steps)),
        state=robot,
        actions=segment.actions[executed],
        success=segment.success,
        task=segment.task,
    )


def load_episodes(dataset: DatasetConfig, spec: WorldModelSpec) -> list[Episode]:
    """Reads a LeRobotDataset into memory; an episode that it holds twice is used once."""
    meta = check_dataset(dataset, spec)
    episodes = {}
    with opened(dataset, meta) as data:
        names = ["action"]
        if spec.state_dim:
            names.append(STATE)
        vectors = {name: numbers(data, name, dataset) for name in names}
        for labels in read_labels(data, dataset):
            rows = labels.rows
            length = len(rows)
            if labels.success_at is not None and labels.success:
                length = labels.success_at + 1
            arrays = observations(data, rows[: length + 1], vectors, spec.cameras)
            frames, state = model_arrays(arrays, spec)
            episode = Episode(
                frames=frames,
                times=np.arange(len(frames)),
                state=state,
                actions=arrays["action"][:length].astype(np.float32),
                success=labels.success,
                task=labels.tasks[0],
            )
            if len(frames) > 1:
                episodes[episode.key] = episode
    return list(episodes.values())


def check_dataset(dataset: DatasetConfig, spec: WorldModelSpec) -> Any:
    """The metadata of a dataset; one that a world model of `spec` cannot be trained on is refused."""
    meta = open_metadata(dataset)
    why = _misfit(meta, spec)
    if why is not None:
        raise InputError("dataset.repo_id", dataset.repo_id, why)
    return meta


def _misfit(meta: Any, spec: WorldModelSpec) -> str | None:
    """Why a world model of `spec` cannot be trained on a dataset; None: it can."""
    shapes = {key: tuple(feature["shape"]) for key, feature in meta.features.items()}
    for camera in spec.cameras:
        if camera not in shapes:
            cameras = ", ".join(meta.camera_keys) or "no camera"
            return f"no {camera!r}: the dataset has {cameras}; choose env.camera accordingly"
    for key, size in {"action": spec.action_dim, STATE: spec.state_dim}.items():
        shape = shapes.get(key)
        if size and shape != (size,):
            return f"{key} has shape {shape}, the environment's has ({size},): it is another robot's"
    if not {SUCCESS, REWARD} & shapes.keys():
        return f"no {SUCCESS}: record it, as accerl demos does, or add it to the dataset"
    if meta.fps not in (spec.fps, *spec.labelled_fps):
        return f"{meta.fps} frames a second, and the environment makes {spec.fps} steps; record at its rate"
    return None
