# SPDX-License-Identifier: Apache-2.0
"""Training data of world models: episodes, windows cut from them, and reading episodes from a LeRobotDataset.

An `Episode` keeps the recorded frames, each with its env step: every step of a demonstration, every K-th of
an episode played by a policy. A window begins at one of them and goes K env steps at a time; the frame after
a chunk is the one recorded then, or the last one if the episode ended within it.

Shapes: F frames of an episode, T env steps; see `contract.py` for the others.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch.nn import functional

from accerl_lerobot.checkpoint.snapshot import kind
from accerl_lerobot.demos.dataset_files import numbers, observations, open_metadata, opened, read_labels
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import REWARD, SUCCESS
from accerl_lerobot.policies.features import STATE
from accerl_lerobot.world_model.contract import Context, Windows, WorldModelSpec

if TYPE_CHECKING:
    from accerl_lerobot.config.ranges import DatasetConfig

HELD_OUT = 0.2  # share of the episodes that a world model is checked on


@kind
@dataclass(frozen=True, kw_only=True)
class Episode:
    """One recorded episode."""

    frames: np.ndarray  # uint8 (F, V, H, W, 3)
    times: np.ndarray  # int64 (F,), env steps before each frame; rising, from 0
    state: np.ndarray  # float32 (F, S); S may be 0
    actions: np.ndarray  # float32 (T, A), as executed, in the environment's units
    success_at: int  # index of the step that achieved the task; −1 for never
    task: str  # the instruction

    @property
    def key(self) -> str:
        """Identifies an episode, whatever dataset it is in."""
        return hashlib.sha256(self.actions.tobytes()).hexdigest()[:16]

    @property
    def success(self) -> bool:
        return self.success_at >= 0

    @property
    def starts(self) -> int:
        """Number of frames that are followed by another."""
        return len(self.frames) - 1

    @property
    def starts_before_success(self) -> int:
        """Number of frames that are followed by another and precede the success."""
        if not self.success:
            return self.starts
        shown = int(np.searchsorted(self.times, self.success_at, side="right"))
        return min(self.starts, shown)

    def __len__(self) -> int:
        """Env steps."""
        return len(self.actions)


class WindowStart(NamedTuple):
    """Indices of an episode and of one of its frames."""

    episode: int
    frame: int


def cut_windows(
    episodes: Sequence[Episode], at: Sequence[WindowStart], spec: WorldModelSpec, chunks: int
) -> Windows:
    """Cuts windows of R = `chunks` chunks."""
    rows = [_window(episodes[start.episode], start.frame, spec, chunks) for start in at]
    arrays = {name: torch.from_numpy(np.stack([row[name] for row in rows])) for name in rows[0]}
    length = spec.context
    context = Context(
        frames=arrays["frames"][:, :length],
        robot=arrays["robot"][:, :length],
        actions=arrays["before"],
        first_frame=arrays["first_frame"],
        first_robot=arrays["first_robot"],
        commanded_sum=arrays["commanded_sum"],
    )
    return Windows(
        context=context,
        frames=arrays["frames"][:, length:],
        robot=arrays["robot"][:, length:],
        actions=arrays["actions"],
        steps=arrays["steps"],
        success=arrays["success"],
        episode=torch.tensor([start.episode for start in at]),
        tasks=tuple(episodes[start.episode].task for start in at),
    )


def _window(episode: Episode, first: int, spec: WorldModelSpec, chunks: int) -> dict[str, np.ndarray]:
    """Arrays of one window; ``frames`` and ``robot`` are those of the context and those after each chunk."""
    size = spec.chunk
    before = spec.context - 1
    start = int(episode.times[first])
    boundaries = start + size * np.arange(-before, chunks + 1)  # env steps between chunks
    begins = boundaries[before:-1]
    ends = boundaries[before + 1 :]
    latest = np.searchsorted(episode.times, boundaries, side="right") - 1
    shown = np.maximum(latest, 0)  # the first frame stands for those before the episode
    times = episode.times[shown[before + 1 :]]
    last = len(episode) - 1
    executed = start + np.arange(size * chunks)
    action_dim = episode.actions.shape[1]
    earlier = np.zeros((size * before, action_dim), np.float32)
    known = episode.actions[max(0, start - size * before) : start]
    earlier[len(earlier) - len(known) :] = known
    return {
        "frames": episode.frames[shown],
        "robot": episode.state[shown],
        "before": earlier.reshape(before, size, action_dim),
        "first_frame": episode.frames[0],
        "first_robot": episode.state[0],
        "commanded_sum": episode.actions[:start].sum(0, dtype=np.float32),
        "actions": episode.actions[np.minimum(executed, last)].reshape(chunks, size, action_dim),
        "steps": np.clip(times - begins, 0, size),
        "success": (begins <= episode.success_at) & (episode.success_at < ends),
    }


def split_episodes(
    episodes: Sequence[Episode], rng: np.random.Generator
) -> tuple[list[Episode], list[Episode]]:
    """Episodes to train on, and a held-out share; each part gets successes and failures if there are two."""
    held: set[int] = set()
    for outcome in (False, True):
        of_outcome = [i for i, episode in enumerate(episodes) if episode.success is outcome]
        rng.shuffle(of_outcome)
        count = min(max(1, round(HELD_OUT * len(of_outcome))), len(of_outcome) - 1)
        held.update(of_outcome[: max(0, count)])
    learnt = [episode for i, episode in enumerate(episodes) if i not in held]
    return learnt, [episodes[i] for i in sorted(held)]


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
    state = np.zeros((len(frames), 0))
    if spec.state_dim:
        state = arrays[STATE]
    return frames, state.astype(np.float32)


def load_episodes(dataset: DatasetConfig, spec: WorldModelSpec, section: str = "dataset") -> list[Episode]:
    """Reads a LeRobotDataset into memory; an episode that it holds twice is used once.

    Errors name the config `section`.
    """
    with _named(section):
        meta = check_dataset(dataset, spec, section)
        with opened(dataset, meta) as data:
            names = ["action"]
            if spec.state_dim:
                names.append(STATE)
            vectors = {name: numbers(data, name, dataset) for name in names}
            episodes = {}
            for labels in read_labels(data, dataset):
                assert labels.success_at is not None  # `check_dataset` refuses a dataset without labels
                arrays = observations(data, labels.rows, vectors, spec.cameras)
                frames, state = model_arrays(arrays, spec)
                episode = Episode(
                    frames=frames,
                    times=np.arange(len(frames)),
                    state=state,
                    actions=arrays["action"].astype(np.float32),
                    success_at=labels.success_at,
                    task=labels.tasks[0],
                )
                if episode.starts:
                    episodes[episode.key] = episode
    return list(episodes.values())


def check_dataset(dataset: DatasetConfig, spec: WorldModelSpec, section: str = "dataset") -> Any:
    """The metadata of a dataset; one that a world model of `spec` cannot be trained on is refused."""
    with _named(section):
        meta = open_metadata(dataset)
        why = _misfit(meta, spec)
        if why is not None:
            raise InputError("dataset.repo_id", dataset.repo_id, why)
    return meta


@contextmanager
def _named(section: str) -> Iterator[None]:
    """Puts the config section of a dataset into errors about it."""
    try:
        yield
    except InputError as error:
        field = error.field
        if field.startswith("dataset."):
            field = f"{section}.{field.removeprefix('dataset.')}"
        raise InputError(field, error.value, error.hint) from error


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
    if meta.fps != spec.fps:
        return f"{meta.fps} frames a second, and the environment makes {spec.fps} steps; record at its rate"
    return None
