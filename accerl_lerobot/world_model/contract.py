# SPDX-License-Identifier: Apache-2.0
"""The interface of a pixel world model, and the episodes that it is trained on.

A model starts at real observations and predicts one chunk at a time:

    state = model.begin(context, tasks)
    prediction = model.step(state, actions, seeds)    # .frames, .robot; the next step starts at .state

It learns by `loss`. `pixels.py` has our model, and ``docs/world_model.md`` says how to add another.

An `Episode` keeps the recorded frames, each with its env step: every step of a demonstration, every K-th of
an episode played by a policy. A window begins at one of them and goes K env steps at a time; the frame after
a chunk is the one recorded then, or the last one if the episode ended within it.

States are dicts of tensors with the batch in front. Shapes: B batch, L frames of context, R chunks of a
window, V cameras, H×W pixels, S robot state dims, K env steps of a chunk, A action dims, F frames of an
episode, T env steps.
"""

from __future__ import annotations

import hashlib
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from accerl_lerobot.checkpoint.snapshot import kind
from accerl_lerobot.config.parsing import imported
from accerl_lerobot.config.ranges import Range, Section
from accerl_lerobot.demos.dataset_files import numbers, observations, open_metadata, opened, read_labels
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import REWARD, SUCCESS, task_codes
from accerl_lerobot.policies.features import STATE

if TYPE_CHECKING:
    from accerl_lerobot.config.ranges import DatasetConfig
    from accerl_lerobot.world_model.config import LearnableModelConfig

State = dict[str, Tensor]  # each (B, ...)
Size = Annotated[int, Range("[1, 1000000]")]
HELD_OUT = 0.2  # share of the episodes that a world model is checked on


@dataclass(frozen=True, kw_only=True)
class WorldModelSpec(Section, section="spec"):
    """Sizes of a world model, and the environment it models."""

    cameras: tuple[str, ...]  # ``observation.images.<camera>``, in the order of V
    image_size: tuple[Size, Size]  # (H, W)
    state_dim: Annotated[int, Range("[0, 1000000]")]  # S; 0: there is no ``observation.state``
    action_dim: Size
    chunk: Size  # K
    fps: Size  # env steps per second, which a dataset must have too
    labelled_fps: tuple[Size, ...] = ()  # see `EnvironmentSpec.labelled_fps`
    context: Size  # L
    tasks: tuple[str, ...] = ()  # instructions of the episodes it was trained on; empty: unknown


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Predicted observation after a chunk."""

    state: State  # input of the next `LearnableWorldModel.step`
    frames: Tensor  # uint8 (B, V, H, W, 3)
    robot: Tensor  # float32 (B, S), in the environment's units


class Context(NamedTuple):
    """Observations until a rollout starts, a chunk apart, the newest last.

    The episode's beginning is part of it. With relative actions `commanded_sum` tells the place that the
    robot is commanded to be at, and may not have reached yet.
    """

    frames: Tensor  # uint8 (B, L, V, H, W, 3)
    robot: Tensor  # float32 (B, L, S)
    actions: Tensor  # float32 (B, L − 1, K, A), executed between these; zero before the episode began
    first_frame: Tensor  # uint8 (B, V, H, W, 3), of the episode
    first_robot: Tensor  # float32 (B, S), of the episode
    commanded_sum: Tensor  # float32 (B, A), of the actions since the episode began


@dataclass(frozen=True, kw_only=True)
class Windows:
    """A batch of windows. Chunks beyond an episode's end repeat its last frame and its last action."""

    context: Context
    frames: Tensor  # uint8 (B, R, V, H, W, 3), after each chunk
    robot: Tensor  # float32 (B, R, S), after each chunk
    actions: Tensor  # float32 (B, R, K, A)
    steps: Tensor  # int64 (B, R), how many of a chunk's actions lie between its frames; 0 beyond the end
    success: Tensor  # bool (B, R), True if the task was achieved in this chunk
    episode: Tensor  # int64 (B,), index of the episode
    tasks: tuple[str, ...]  # B instructions

    @property
    def known(self) -> Tensor:
        """bool (B, R), True until the episode ended or achieved the task, that chunk included."""
        successes_before = self.success.cumsum(1) - self.success.long()
        return ((self.steps > 0) | self.success) & (successes_before == 0)

    @property
    def known_tasks(self) -> Tensor:
        """float32 (N, 16), `task_codes` of the N chunks that are `known`."""
        codes = torch.from_numpy(task_codes(self.tasks))
        return codes.repeat_interleave(self.known.sum(1), 0)


class LearnableWorldModel(nn.Module):
    """A world model that is trained, see `training.Trainer`; its ``state_dict`` is saved.

    It moves its inputs to its own device: windows, states and actions may be on the CPU.
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
    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Prediction:
        """Predicts one chunk further from a state, which is not modified.

        Actions are float32 (B, K, A), in the environment's units. All randomness is that of B seeds, so a row
        does not depend on its batch.
        """

    @abstractmethod
    def loss(self, windows: Windows, generator: torch.Generator) -> tuple[Tensor, dict[str, float]]:
        """Loss of a batch of real windows, a scalar, and metrics; all randomness is the generator's."""


def new_model(spec: WorldModelSpec, config: LearnableModelConfig) -> LearnableWorldModel:
    """Builds an untrained model of the class that `config` names."""
    made: LearnableWorldModel = imported(config.make)(spec, config)
    return made


@torch.no_grad()
def replay(model: LearnableWorldModel, windows: Windows, rows_at_once: int = 64) -> Tensor:
    """Frames predicted after each chunk from the executed actions, uint8 (B, R, V, H, W, 3), on the CPU."""
    parts = []
    for rows in torch.arange(len(windows.tasks)).split(rows_at_once):
        context = Context(*(tensor[rows] for tensor in windows.context))
        state = model.begin(context, [windows.tasks[row] for row in rows.tolist()])
        frames = []
        for chunk in range(windows.actions.shape[1]):
            seeds = (rows + 1_000_003 * chunk).tolist()
            prediction = model.step(state, windows.actions[rows, chunk], seeds)
            frames.append(prediction.frames.cpu())
            state = prediction.state
        parts.append(torch.stack(frames, 1))
    return torch.cat(parts)


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
    if meta.fps not in (spec.fps, *spec.labelled_fps):
        return f"{meta.fps} frames a second, and the environment makes {spec.fps} steps; record at its rate"
    return None
