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
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from accerl_lerobot.checkpoint.snapshot import kind
from accerl_lerobot.demos.dataset_files import open_metadata, opened
from accerl_lerobot.demos.episodes import EpisodeLabels, numbers, observations, read_labels
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import REWARD, SUCCESS
from accerl_lerobot.world_model.contract import Windows, WorldModelSpec

if TYPE_CHECKING:
    from accerl_lerobot.config.ranges import DatasetConfig

logger = logging.getLogger(__name__)

DATASET, ONLINE = "dataset", "online"
"""Config sections of a verb's datasets, of which the second has a policy's own episodes."""


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
    own: bool  # played by the policy that the world model is for: in validation its failures count

    @property
    def key(self) -> str:
        """Identifies an episode, whatever dataset it is in."""
        return hashlib.sha256(self.actions.tobytes()).hexdigest()[:16]

    @property
    def success(self) -> bool:
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
        return min(followed, self.frame_at(self.success_at) + 1) if self.success else followed

    def progress(self, time: int) -> float:
        """Share of the way to the success by an env step; NaN without a success."""
        return min(1.0, time / max(1, self.success_at)) if self.success else float("nan")

    def frame_at(self, time: int) -> int:
        """Index of the last frame recorded by an env step; the first one before all of them."""
        return max(0, int(np.searchsorted(self.times, time, side="right")) - 1)

    def __len__(self) -> int:
        """Env steps."""
        return len(self.actions)


class WindowStart(NamedTuple):
    """Indices of an episode and of one of its frames."""

    episode: int
    frame: int


def hold_last_action(actions: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Fills chunks (B, R, K, A) up: actions beyond `steps` (B, R) repeat the last executed one."""
    b, r, k, a = actions.shape
    executed = (np.arange(k) < steps[..., None]).reshape(b, r * k)
    last = np.maximum.accumulate(np.where(executed, np.arange(r * k), 0), axis=1)
    return np.take_along_axis(actions.reshape(b, r * k, a), last[..., None], 1).reshape(actions.shape)


def shuffle_actions(windows: Windows, rng: np.random.Generator) -> Windows:
    """Gives each window the actions of another one, from another episode where there is one, or its own."""
    rows, groups = np.arange(len(windows)), windows.episode
    donors = rows.copy()
    for i in rows:
        others = rows[groups != groups[i]]
        others = others if len(others) else rows[rows != i]
        if len(others):
            donors[i] = rng.choice(others)
    return replace(windows, actions=windows.actions[donors])


def window_starts(episodes: Sequence[Episode]) -> list[WindowStart]:
    """Every frame that is followed by another, of every episode."""
    return [WindowStart(e, f) for e, episode in enumerate(episodes) for f in range(len(episode.frames) - 1)]


def cut_windows(
    episodes: Sequence[Episode],
    at: Sequence[WindowStart],
    spec: WorldModelSpec,
    chunks: int,
    anchors: Sequence[int] | None = None,
) -> Windows:
    """Cuts windows of R = `chunks` chunks, whose anchors lie so many chunks before their first frame."""
    rows = [
        _window(episodes[start.episode], start.frame, spec, chunks, anchor)
        for start, anchor in zip(at, anchors or [0] * len(at), strict=True)
    ]
    return Windows(
        **{key: np.stack([row[key] for row in rows]) for key in rows[0]},
        episode=np.array([start.episode for start in at], np.int64),
        task=tuple(episodes[start.episode].task for start in at),
    )


def _window(
    episode: Episode, first: int, spec: WorldModelSpec, chunks: int, anchor: int
) -> dict[str, np.ndarray]:
    chunk, context, action_dim = spec.chunk, spec.context, episode.actions.shape[1]
    start = int(episode.times[first])
    before = [episode.frame_at(start - chunk * i) for i in range(context - 1, 0, -1)]
    nothing = np.zeros(((context - 1) * chunk, action_dim), np.float32)
    actions_before = np.concatenate([nothing, episode.actions[:start]])[start:]
    path, actions = [first], np.zeros((chunks, chunk, action_dim), np.float32)
    steps, success = np.zeros(chunks, np.int64), np.zeros(chunks, bool)
    for r in range(chunks):
        then = start + chunk * r
        path.append(max(path[-1], episode.frame_at(then + chunk)))
        # Actions between the two frames: the chunk's, unless the last frame comes before its end.
        steps[r] = np.clip(episode.times[path[-1]] - then, 0, chunk)
        actions[r, : steps[r]] = episode.actions[then : then + steps[r]]
        success[r] = then <= episode.success_at < then + chunk
    return {
        "frames": episode.frames[before + path],
        "anchor": episode.frames[episode.frame_at(start - chunk * anchor)],
        "state": episode.state[before + path],
        "before": actions_before.reshape(context - 1, chunk, action_dim),
        "commanded_sum": episode.actions[:start].sum(0, dtype=np.float32),
        "initial_state": episode.state[0],
        "actions": actions,
        "steps": steps,
        "success": success,
    }


def count_episodes(episodes: Sequence[Episode]) -> dict[str, int]:
    """Numbers of ``episodes`` and ``env_steps``."""
    return {"episodes": len(episodes), "env_steps": sum(map(len, episodes))}


def split_episodes(
    episodes: Sequence[Episode], share: float, rng: np.random.Generator
) -> tuple[list[Episode], list[Episode]]:
    """Episodes to train on, and a held-out share.

    Successes and failures are split alike; where there are two of a kind, each part gets at least one.
    """
    held: set[int] = set()
    for outcome in (False, True):
        of = [i for i, e in enumerate(episodes) if e.success is outcome]
        rng.shuffle(of)
        held.update(of[: min(max(1, round(share * len(of))), len(of) - 1) if len(of) > 1 else 0])
    return [e for i, e in enumerate(episodes) if i not in held], [episodes[i] for i in sorted(held)]


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


def open_datasets(sections: dict[str, DatasetConfig], spec: WorldModelSpec) -> dict[str, Any]:
    """Opens and checks the metadata of each named dataset, by its config section, before images are read."""
    metas: dict[str, Any] = {}
    for section, dataset in sections.items():
        if dataset.repo_id is not None:
            with name_section(section):
                metas[section] = open_metadata(dataset)
                check_metadata(metas[section], dataset.repo_id, spec)
    return metas


def load_datasets(sections: dict[str, DatasetConfig], spec: WorldModelSpec) -> dict[str, list[Episode]]:
    """Reads LeRobotDatasets into memory, one uint8 image of the spec's size per env step and camera.

    Two with an episode in common are refused, as it may be on both sides of a split; one that a dataset has
    twice is used once.
    """
    loaded: dict[str, list[Episode]] = {}
    known: set[str] = set()
    for section, meta in open_datasets(sections, spec).items():
        dataset = sections[section]
        with name_section(section), opened(dataset, meta) as data:
            names = ["action", "observation.state"] if spec.state_dim else ["action"]
            vectors = {name: numbers(data, name, dataset) for name in names}
            own = section == ONLINE
            episodes = [_episode(data, one, vectors, spec, own) for one in read_labels(data, dataset)]
            once = {episode.key: episode for episode in episodes}
            if len(once) < len(episodes):
                text = "%s: %d episodes are in it more than once, and are used once"
                logger.warning(text, dataset.repo_id, len(episodes) - len(once))
            keys = once.keys()
            if twice := len(keys & known):
                hint = f"{twice} of its episodes are in the other dataset, too; name one with others"
                raise InputError("dataset.repo_id", dataset.repo_id, hint)
        known |= keys
        loaded[section] = list(once.values())
    return loaded


@contextmanager
def name_section(section: str) -> Iterator[None]:
    """Puts the config section of a dataset into errors about it."""
    try:
        yield
    except InputError as error:
        field = error.field.replace("dataset.", f"{section}.", 1)
        raise InputError(field, error.value, error.hint) from error


def check_metadata(meta: Any, name: str, spec: WorldModelSpec) -> None:
    """Refuses a dataset that a world model of `spec` cannot be trained on."""
    shapes = {key: tuple(feature["shape"]) for key, feature in meta.features.items()}
    sizes = {"action": spec.action_dim} | ({"observation.state": spec.state_dim} if spec.state_dim else {})
    others = {key: shapes.get(key) for key, size in sizes.items() if shapes.get(key) != (size,)}
    if missing := [camera for camera in spec.cameras if camera not in shapes]:
        cameras = ", ".join(meta.camera_keys) or "no camera"
        why = f"no {missing[0]!r}: the dataset has {cameras}; choose env.camera accordingly"
    elif others:
        key, shape = next(iter(others.items()))
        why = f"{key} has shape {shape}, the environment's has ({sizes[key]},): it is another robot's"
    elif not {SUCCESS, REWARD} & shapes.keys():
        why = f"no {SUCCESS}: record it, as accerl demos does, or add it to the dataset"
    elif meta.fps != spec.fps:
        why = f"{meta.fps} frames a second, and the environment makes {spec.fps} steps; record at its rate"
    elif meta.total_episodes < 2:
        why = "a single episode; at least one to train on and one to hold out are needed"
    else:
        return
    raise InputError("dataset.repo_id", name, why)


def _episode(
    data: Any, labels: EpisodeLabels, vectors: dict[str, np.ndarray], spec: WorldModelSpec, own: bool
) -> Episode:
    assert labels.success_at is not None  # `check_metadata` refuses a dataset without labels
    arrays = observations(data, labels.rows, vectors, spec.cameras)
    frames, state = model_arrays(arrays, spec)
    return Episode(
        frames=frames,
        times=np.arange(len(frames)),
        state=state.astype(np.float32),
        actions=arrays["action"].astype(np.float32),
        success_at=labels.success_at,
        task=labels.tasks[0],
        own=own,
    )
