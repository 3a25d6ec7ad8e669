# SPDX-License-Identifier: Apache-2.0
"""Opening of LeRobotDatasets whose authors are not known, and the labels of their episodes.

LeRobot fills the templates of ``meta/info.json`` in with `str.format` and joins the result to the folder.
Where an image's ``bytes`` are missing, Hugging Face's `datasets` opens the file or address that its ``path``
names. Pillow has Ghostscript draw PostScript. In the context of `checked`, LeRobot's own classes refuse all
of this. Any other damage is an error of LeRobot's, and `open_metadata` and `opened` make one line of it.

Rows of an episode are found by ``episode_index`` and ``frame_index``, an instruction by ``task_index``.
`docs/recorded.md` says when an episode counts as a success.
"""

from __future__ import annotations

import contextlib
import io
import json
import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np

from accerl_lerobot.checkpoint.safety import FileSource, check_folder, check_name, read_json, unsafe_name
from accerl_lerobot.errors import InputError, expanded, in_one_line
from accerl_lerobot.experience import REWARD, SUCCESS

if TYPE_CHECKING:
    from accerl_lerobot.config.ranges import DatasetConfig

INFO = "meta/info.json"
DATA = "data"
IMAGES = ("PNG", "JPEG", "TIFF")
"""Pillow's names of the formats that are decoded; LeRobot stores depth as TIFF."""
PLACE = re.compile(r"\{(video_key|(chunk_index|file_index)(:0?[1-9]?d)?)\}")
"""Fields that the templates of file names may have."""
OLD_VERSION = re.compile(r"v?[0-2](\.|$)")
"""Versions of the format that LeRobot refuses by itself; their ``info.json`` has other fields."""
LABEL = f"label the episodes with {SUCCESS}, as the page about recorded episodes shows"
PLAIN = {"Value", "Sequence", "List", "LargeList"}
"""Kinds of columns that `datasets` reads without opening other files."""


def open_metadata(dataset: DatasetConfig) -> Any:
    """LeRobot's metadata of a local or Hub dataset; anything wrong with it is one line."""
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    name = dataset.repo_id
    if name is None:
        hint = "name a LeRobotDataset; with dataset.root any label will do"
        raise InputError("dataset.repo_id", None, hint)
    root = local_folder(dataset)
    if root is not None and not (Path(root) / INFO).is_file():
        raise InputError("dataset.root", root, f"no {INFO} there; give the folder of a LeRobotDataset v3")
    with _one_line_errors(dataset), checked(dataset):
        meta = LeRobotDatasetMetadata(name, root=root, revision=dataset.revision)
    if meta.episodes is None or meta.tasks is None:
        raise origin_of(dataset).refuse(INFO, "it has no episodes, or no tasks; name a dataset that has some")
    return meta


@contextlib.contextmanager
def opened(dataset: DatasetConfig, meta: Any, episodes: Sequence[int] | None = None) -> Iterator[Any]:
    """A LeRobotDataset, whose files are checked as long as the context lasts.

    `meta` is the result of `open_metadata` for it, `episodes` are indices of those that are read; None: all.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    if episodes is not None:
        episodes = list(episodes)
    with checked(dataset):
        with _one_line_errors(dataset):
            # The default backend probes for FFmpeg's libraries, and prints tracebacks where there are none.
            data = LeRobotDataset(
                meta.repo_id, root=meta.root, revision=meta.revision, episodes=episodes, video_backend="pyav"
            )
            _check_rows(data, origin_of(dataset))
        yield data


def _check_rows(data: Any, origin: FileSource) -> None:
    """Refuse rows that LeRobot would take for those of another episode or, in videos, of another time."""
    meta = data.meta
    names = ["index", "episode_index", "frame_index", "timestamp"]
    rows = data.hf_dataset.with_format("numpy", columns=names)[:]
    by_borders = np.searchsorted(meta.episodes["dataset_to_index"], rows["index"], side="right")
    regular = np.isclose(rows["timestamp"], rows["frame_index"] / meta.fps, rtol=1e-6, atol=1e-4)
    for right, hint in (
        (rows["episode_index"] == by_borders, "by meta/episodes it is of another episode; get it again"),
        (regular | (not meta.video_keys), f"its timestamp is not frame_index / {meta.fps}; set it to that"),
    ):
        if not right.all():
            raise origin.refuse(DATA, f"row {rows['index'][right.argmin()]}: {hint}")


@contextlib.contextmanager
def _one_line_errors(dataset: DatasetConfig) -> Iterator[None]:
    """Make one line of any error with which LeRobot reads a dataset's files."""
    from lerobot.datasets.utils import CompatibilityError

    origin = origin_of(dataset)
    try:
        yield
    except InputError:
        raise
    except (CompatibilityError, NotImplementedError) as error:
        raise another_version(dataset) from error
    except Exception as error:
        shown = error.__cause__ or error  # `datasets` raises an error of its own from the one that tells why
        hint = f"LeRobot cannot read it ({in_one_line(shown)}); name a complete LeRobotDataset that exists"
        raise InputError(origin.field, origin.value, hint) from error


def another_version(dataset: DatasetConfig) -> InputError:
    """The error of a dataset in another version of the format."""
    from lerobot.datasets.dataset_metadata import CODEBASE_VERSION

    tool = f"python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id={dataset.repo_id}"
    if dataset.root is not None:
        tool += f" --root={local_folder(dataset)}"
    why = f"its format is not {CODEBASE_VERSION}, which this LeRobot reads; from v2.1 convert with: {tool}"
    origin = origin_of(dataset)
    return InputError(origin.field, origin.value, f"{why} --push-to-hub=false")


def local_folder(dataset: DatasetConfig) -> str | None:
    """The folder of a dataset that is not the Hub's."""
    if dataset.root is None:
        return None
    return str(expanded(dataset.root, "dataset.root"))


def origin_of(dataset: DatasetConfig) -> FileSource:
    """The field that names a dataset's files."""
    if dataset.root is not None:
        return FileSource("dataset.root", dataset.root)
    return FileSource("dataset.repo_id", dataset.repo_id)


def task_texts(meta: Any) -> list[str]:
    """The dataset's instructions, in the order of their indices."""
    return [str(text) for text in meta.tasks.index]


@contextlib.contextmanager
def checked(dataset: DatasetConfig) -> Iterator[None]:
    """In this context LeRobot has a dataset's files checked when it reads them.

    Missing files of a local dataset are refused; those of others LeRobot fetches.
    """
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.datasets.dataset_reader import DatasetReader

    from datasets import Image

    origin = origin_of(dataset)
    local = dataset.root is not None
    load_metadata = LeRobotDatasetMetadata._load_metadata
    try_load = DatasetReader.try_load
    decode = Image.decode_example

    def checked_metadata(self: Any) -> None:
        check_metadata(Path(self.root), dataset)
        try:
            load_metadata(self)
        except (FileNotFoundError, NotADirectoryError) as error:
            if local:
                raise origin.refuse("meta", f"{error}; give the whole folder") from error
            raise
        if self.tasks is not None:  # LeRobot takes a task's index for the number of its row
            self.tasks = self.tasks.sort_values("task_index")

    def checked_try(self: Any) -> bool:
        found = bool(try_load(self))
        if local and not found:
            raise origin.refuse(DATA, "files of some episodes are missing; give the whole folder")
        return found

    def checked_decode(self: Any, value: Any, token_per_repo_id: Any = None) -> Any:
        from PIL import Image as Pillow

        content = value.get("bytes") or b""
        try:
            Pillow.open(io.BytesIO(content), formats=IMAGES).close()
        except OSError as error:
            raise origin.refuse(DATA, "an image whose row does not hold it as PNG, JPEG or TIFF") from error
        return decode(self, {"bytes": content, "path": None}, token_per_repo_id)

    with (
        patch.object(Image, "decode_example", checked_decode),
        patch.object(LeRobotDatasetMetadata, "_load_metadata", checked_metadata),
        patch.object(DatasetReader, "try_load", checked_try),
    ):
        yield


def check_metadata(root: Path, dataset: DatasetConfig) -> None:
    """Refuse metadata of an old version, or that would have LeRobot read outside the folder."""
    import pyarrow.parquet as pq

    if not (root / INFO).exists():
        return  # LeRobot fetches it
    origin = origin_of(dataset)
    check_folder(root, origin)
    info = read_json(root / INFO, origin)
    if OLD_VERSION.match(str(info.get("codebase_version"))):
        raise another_version(dataset)
    for key in ("data_path", "video_path"):
        template = str(info.get(key) or "-")
        example = PLACE.sub("0", template)
        if unsafe_name(example) or "{" in example:
            hint = "no template of a file in the folder, such as data/{chunk_index:03d}/{file_index:03d}"
            raise origin.refuse(f"{INFO}: {key}", f"{template[:80]!r} is {hint}")
    for name in info.get("features", ()):
        check_name(name, f"{INFO}: features.{name[:60]}", origin)
    for path in (root / "meta").rglob("*.parquet"):
        described = (pq.read_schema(path).metadata or {}).get(b"huggingface", b"{}")
        kinds = re.findall(r'"_type": "(\w+)"', json.dumps(json.loads(described)))
        other = set(kinds) - PLAIN
        if other:  # `datasets` would open the files that they name
            hint = f"columns of kind {', '.join(other)[:80]}; numbers and texts are wanted"
            raise origin.refuse(path.name, hint)


@dataclass(frozen=True, kw_only=True)
class EpisodeLabels:
    """Rows of an episode in the order of time, and its labels; T env steps."""

    index: int  # its number in the dataset
    rows: np.ndarray  # int64 (T,), places in the loaded dataset
    tasks: tuple[str, ...]  # its instructions, in the order in which they first appear
    rewards: np.ndarray | None  # float32 (T,); None: the dataset has none
    success_at: int | None  # index of the step that achieved the task; -1 for never; None: not labelled

    @property
    def success(self) -> bool:
        """True if the episode is labelled as a success."""
        return self.success_at is not None and self.success_at >= 0


def read_labels(data: Any, dataset: DatasetConfig, one_task: bool = True) -> list[EpisodeLabels]:
    """The labels of the loaded episodes, in the order of their indices.

    With `one_task`, an episode whose instruction changes is refused.
    """
    origin = origin_of(dataset)
    texts = task_texts(data.meta)
    labels = [name for name in (REWARD, SUCCESS) if name in data.meta.features]
    for name in labels:
        numbers(data, name, dataset)  # refuses what is not finite
    table = data.hf_dataset.select_columns(
        ["episode_index", "frame_index", "task_index", *labels]
    ).to_pandas()
    found = []
    for index, own in table.sort_values(["episode_index", "frame_index"]).groupby("episode_index"):
        tasks = tuple(texts[number] for number in own["task_index"].unique())
        if one_task and len(tasks) > 1:
            hint = f"its instruction changes from {tasks[0]!r} to {tasks[1]!r}, and one is read here"
            raise origin.refuse(f"episode {index}", f"{hint}; split the episode, or use accerl sft")
        success_at = None
        rewards = None
        if REWARD in own:
            rewards = own[REWARD].to_numpy(np.float32)
        if SUCCESS in own:
            success_at = step_of_success(own[SUCCESS].to_numpy())
        elif rewards is not None:
            success_at = step_of_reward(rewards)
            if success_at is None:
                hint = f"{REWARD} is above 0 at steps that do not end it, so that it tells no success"
                raise origin.refuse(f"episode {index}", f"{hint}; {LABEL}")
        rows = own.index.to_numpy()
        found.append(
            EpisodeLabels(index=int(index), rows=rows, tasks=tasks, rewards=rewards, success_at=success_at)
        )
    return found


def step_of_success(flags: np.ndarray) -> int:
    """Index of the step that achieved the task, by ``next.success`` (T,); -1 for none.

    Where all steps have it, the episode as a whole is labelled, and its last step counts.
    """
    if flags.all():
        return len(flags) - 1
    if not flags.any():
        return -1
    return int(flags.argmax())


def step_of_reward(rewards: np.ndarray) -> int | None:
    """Index of the step that achieved the task, by ``next.reward`` (T,); -1 for none.

    None if rewards are dense: a reward above 0 tells success if it comes once, or stays until the end.
    """
    positive = np.flatnonzero(rewards > 0)
    if len(positive) == 0:
        return -1
    first = int(positive[0])
    if len(positive) == 1:
        return first
    stays = (rewards[first:] == rewards[first]).all()
    if first == 0 or not stays:
        return None
    return first


def numbers(data: Any, name: str, dataset: DatasetConfig) -> np.ndarray:
    """A column of finite numbers (frames, ...), each of the feature's shape."""
    rows = data.hf_dataset.with_format("numpy", columns=[name])[:]
    values = np.asarray(rows[name])
    origin = origin_of(dataset)
    if values.dtype.kind not in "biuf":
        raise origin.refuse(name, "numbers are wanted, of the same shape in all rows; record it again")
    finite = np.isfinite(values).reshape(len(values), -1).all(1)
    if not finite.all():
        row = data.hf_dataset[int(finite.argmin())]
        where = int(row["episode_index"])
        raise origin.refuse(name, f"a number that is not finite in episode {where}; leave the episode out")
    # LeRobot stores one number a frame without a dimension.
    return values.reshape(-1, *data.meta.features[name]["shape"])


def observations(
    data: Any, rows: np.ndarray, vectors: dict[str, np.ndarray], cameras: Collection[str]
) -> dict[str, np.ndarray]:
    """Contents of some rows: of `vectors`, columns of the dataset, and images uint8 (T, h, w, 3)."""
    found = {name: values[rows] for name, values in vectors.items()}
    if not cameras:
        return found
    images: dict[str, list[np.ndarray]] = {camera: [] for camera in cameras}
    for row in rows:
        frame = data[int(row)]
        for camera in cameras:
            pixels = (frame[camera] * 255).round().byte()  # LeRobot gives float (3, h, w) in [0, 1]
            images[camera].append(pixels.permute(1, 2, 0).numpy())
    return found | {camera: np.stack(frames) for camera, frames in images.items()}
