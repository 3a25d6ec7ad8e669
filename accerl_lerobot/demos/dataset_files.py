# SPDX-License-Identifier: Apache-2.0
"""Opening of LeRobotDatasets whose authors are not known.

LeRobot fills the templates of ``meta/info.json`` in with `str.format` and joins the result to the folder.
Where an image's ``bytes`` are missing, Hugging Face's `datasets` opens the file or address that its ``path``
names. Pillow has Ghostscript draw PostScript. In the context of `checked`, LeRobot's own classes refuse all
of this.

LeRobot looks up tasks and episodes by their rows. `put_in_order` sorts the rows by the index that names them.
Statistics and columns are checked in `policies.features` and `demos.episodes`, which know what is read. Any
other damage is an error of LeRobot's, and `open_metadata` makes one line of it.
"""

from __future__ import annotations

import contextlib
import io
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np

from accerl_lerobot.checkpoint.safety import FileSource, brief, check_name, read_json, safe_join, unsafe_name
from accerl_lerobot.errors import InputError, causes, expanded

if TYPE_CHECKING:
    from accerl_lerobot.config.ranges import DatasetConfig

INFO, TASKS, EPISODES, DATA = "meta/info.json", "meta/tasks.parquet", "meta/episodes", "data"
FOLDERS = ("meta", "data", "videos")
"""Folders of a dataset in which LeRobot reads files."""
IMAGES = ("PNG", "JPEG", "TIFF")
"""Pillow's names of the formats that are decoded; LeRobot stores depth as TIFF."""
INDEX = r"\{(chunk_index|file_index)(:0?[1-9]?d)?\}"
PLACES = {"data_path": INDEX, "video_path": rf"{INDEX}|\{{video_key\}}"}
OLD_VERSION = re.compile(r"v?[0-2](\.|$)")
"""Versions of the format that LeRobot refuses by itself; their ``info.json`` has other fields."""
CHANNELS = (1, 3, 4)
PLAIN = {"Value", "Sequence", "List", "LargeList"}
"""Kinds of columns that `datasets` reads without opening other files."""
AGAIN = "get the dataset again"


def open_metadata(dataset: DatasetConfig) -> Any:
    """LeRobot's metadata of a local or Hub dataset; anything wrong with it is one line."""
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.datasets.utils import CompatibilityError

    name, root, origin = dataset.repo_id, dataset.root, origin_of(dataset)
    if name is None:
        hint = "name a LeRobotDataset; with dataset.root any label will do"
        raise InputError("dataset.repo_id", None, hint)
    if root is not None:
        root = str(expanded(root, "dataset.root"))
        if not (Path(root) / INFO).is_file():
            raise InputError("dataset.root", root, f"no {INFO} there; give the folder of a LeRobotDataset v3")
    try:
        with checked(origin, whole=root is not None):
            meta = LeRobotDatasetMetadata(name, root=root, revision=dataset.revision)
    except InputError:
        raise
    except (CompatibilityError, NotImplementedError) as error:
        raise another_version(dataset) from error
    except Exception as error:
        if root is None and isinstance(error, (OSError, ValueError)):
            hint = f"not found locally nor on the Hub ({brief(error)})"
            raise InputError("dataset.repo_id", name, hint) from error
        raise origin.refuse("meta", f"LeRobot cannot read it ({brief(error)})") from error
    if meta.episodes is None or meta.tasks is None:
        raise origin.refuse(INFO, "it has no episodes, or no tasks; name a dataset that has some")
    return meta


def another_version(dataset: DatasetConfig) -> InputError:
    """The error of a dataset in another version of the format."""
    from lerobot.datasets.dataset_metadata import CODEBASE_VERSION

    tool = f"python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id={dataset.repo_id}"
    if dataset.root is not None:
        tool += f" --root={expanded(dataset.root, 'dataset.root')}"
    why = f"its format is not {CODEBASE_VERSION}, which this LeRobot reads; from v2.1 convert with: {tool}"
    return InputError("dataset.repo_id", dataset.repo_id, f"{why} --push-to-hub=false")


@contextlib.contextmanager
def opened(dataset: DatasetConfig, meta: Any, episodes: Sequence[int] | None = None) -> Iterator[Any]:
    """A LeRobotDataset, whose files are checked as long as the context lasts.

    `meta` is what `open_metadata` gave for it, `episodes` are indices of those that are read; None: all.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    chosen = None if episodes is None else list(episodes)
    with checked(origin_of(dataset), whole=dataset.root is not None):
        # The default backend probes for FFmpeg's libraries, and prints their tracebacks where there are none.
        yield LeRobotDataset(
            meta.repo_id, root=meta.root, revision=meta.revision, episodes=chosen, video_backend="pyav"
        )


def origin_of(dataset: DatasetConfig) -> FileSource:
    """The field that names a dataset's files."""
    if dataset.root is not None:
        return FileSource("dataset.root", dataset.root)
    return FileSource("dataset.repo_id", dataset.repo_id)


def task_texts(meta: Any) -> list[str]:
    """The dataset's instructions."""
    return [str(text) for text in meta.tasks.index]


@contextlib.contextmanager
def checked(origin: FileSource, whole: bool = False) -> Iterator[None]:
    """In this context LeRobot has a dataset's files checked when it reads them.

    With `whole`, missing files and rows are refused; otherwise LeRobot fetches them.
    """
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.datasets.dataset_reader import DatasetReader

    from datasets import Image

    load_metadata, load_data = LeRobotDatasetMetadata._load_metadata, DatasetReader._load_hf_dataset
    try_load, decode = DatasetReader.try_load, Image.decode_example

    def checked_metadata(self: Any) -> None:
        check_metadata(Path(self.root), origin)
        try:
            load_metadata(self)
        except (FileNotFoundError, NotADirectoryError) as error:
            if whole:
                raise origin.refuse("meta", f"{brief(error)}; give the whole folder") from error
            raise
        put_in_order(self, origin)

    def checked_data(self: Any) -> Any:
        checked_files(Path(self.root), origin)
        try:
            rows = load_data(self)
        except (FileNotFoundError, NotADirectoryError):
            raise  # LeRobot's `try_load` expects them
        except Exception as error:
            first = list(causes(error))[-1]  # `datasets` hides it behind an error of its own
            raise origin.refuse(DATA, f"LeRobot cannot load it ({brief(first)}); {AGAIN}") from error
        check_rows(rows, self._meta, origin, whole=whole and self.episodes is None)
        return rows

    def checked_try(self: Any) -> bool:
        found = bool(try_load(self))
        if whole and not found:
            files = (self.root / name for name in map(str, self.get_episodes_file_paths()))
            missing = sorted(str(file.relative_to(self.root)) for file in files if not file.is_file())
            what = f"{missing[0]} is missing" if missing else "rows of some episodes are missing"
            raise origin.refuse(DATA, f"{what}; give the whole folder")
        return found

    def checked_decode(self: Any, value: Any, token_per_repo_id: Any = None) -> Any:
        from PIL import Image as Pillow

        content = value.get("bytes")
        if content is None:
            raise origin.refuse(DATA, "an image without its bytes; record it again")
        try:
            Pillow.open(io.BytesIO(content), formats=IMAGES).close()
            return decode(self, {"bytes": content, "path": None}, token_per_repo_id)
        except Exception as error:  # Pillow's plugins raise what they like
            hint = "an image that is no PNG, JPEG or TIFF, or broken; record it again"
            raise origin.refuse(DATA, hint) from error

    with (
        patch.object(Image, "decode_example", checked_decode),
        patch.object(LeRobotDatasetMetadata, "_load_metadata", checked_metadata),
        patch.object(DatasetReader, "_load_hf_dataset", checked_data),
        patch.object(DatasetReader, "try_load", checked_try),
    ):
        yield


def checked_files(root: Path, origin: FileSource) -> dict[str, Path]:
    """All that LeRobot may read, by its name in the dataset; a link that leads out is refused."""
    found: dict[str, Path] = {}
    for folder in FOLDERS:
        safe_join(root, folder, origin)
        for path in sorted((root / folder).rglob("*")):
            name = path.relative_to(root).as_posix()
            found[name] = safe_join(root, name, origin)
    return found


def check_metadata(root: Path, origin: FileSource) -> None:
    """Refuses metadata of an old version, or that would have LeRobot read outside the folder.

    Raises:
        CompatibilityError: LeRobot's, of an old version.
    """
    from lerobot.datasets.utils import CompatibilityError

    files = checked_files(root, origin)
    if INFO not in files:
        return
    info = read_json(files[INFO], origin)
    if OLD_VERSION.match(str(info.get("codebase_version"))):
        raise CompatibilityError
    for key, places in PLACES.items():
        template = str(info.get(key) or "-")
        example = re.sub(places, "0", template)
        if why := unsafe_name(example) or ("{" in example and "use {chunk_index:03d} and the like only"):
            raise origin.refuse(f"{INFO}: {key}", f"{template[:80]!r}: {why}")
    for name in info.get("features", ()):
        check_name(name, f"{INFO}: features.{name[:60]}", origin)
    for name, path in files.items():
        if name.startswith("meta/") and path.suffix == ".parquet":
            _check_plain(path, name, origin)


def _check_plain(path: Path, name: str, origin: FileSource) -> None:
    """Refuses metadata that are not numbers and texts: `datasets` would open the files that others name."""
    import pyarrow.parquet as pq

    described = json.loads((pq.read_schema(path).metadata or {}).get(b"huggingface", b"{}"))
    kinds = set(re.findall(r'"_type": "(\w+)"', json.dumps(described)))
    if other := ", ".join(sorted(kinds - PLAIN)):
        hint = f"columns of kind {other[:80]}, which name other files; numbers and texts are wanted"
        raise origin.refuse(name, hint)


def put_in_order(meta: Any, origin: FileSource) -> None:
    """Make good what LeRobot takes for granted.

    These are tasks and episodes in the order of their indices, names of an image's axes, and a place for
    statistics of each camera, into which LeRobot writes those of ImageNet.
    """
    if meta.tasks is not None:
        table = meta.tasks.set_index("task") if "task" in meta.tasks.columns else meta.tasks
        meta.tasks = table.sort_values("task_index")
        _check_numbers(meta.tasks["task_index"].tolist(), TASKS, "task_index", origin)
    if meta.episodes is not None:
        numbers = np.asarray(meta.episodes["episode_index"])
        order = np.argsort(numbers)
        _check_numbers(numbers[order].tolist(), EPISODES, "episode_index", origin)
        if len(numbers) < meta.total_episodes:
            why = f"{len(numbers)} episodes, and {INFO} says {meta.total_episodes}; {AGAIN}"
            raise origin.refuse(EPISODES, why)
        if (numbers != numbers[order]).any():
            meta.episodes = meta.episodes.select(order)
    for camera in meta.camera_keys:
        feature = meta.features[camera]
        names = feature.get("names")
        if not (isinstance(names, (list, tuple)) and {"channel", "channels"} & set(names)):
            last = feature["shape"][-1] in CHANNELS
            feature["names"] = ["height", "width", "channels"] if last else ["channels", "height", "width"]
    seen = set(meta.camera_keys) - set(meta.depth_keys)
    meta.stats = {camera: {} for camera in seen} | (meta.stats or {})


def _check_numbers(numbers: list[int], where: str, name: str, origin: FileSource) -> None:
    if numbers != list(range(len(numbers))):
        hint = f"its {name} are not 0 to {len(numbers) - 1}, as LeRobot wants them; number them anew"
        raise origin.refuse(where, hint)


def check_rows(rows: Any, meta: Any, origin: FileSource, whole: bool) -> None:
    """Refuses rows that are not where LeRobot looks for them; `whole`: all of them are there."""
    index, episode, step, task = (
        _column(rows, name, origin) for name in ("index", "episode_index", "frame_index", "task_index")
    )
    if whole and len(rows) != meta.total_frames:
        raise origin.refuse(DATA, f"{len(rows)} rows, and {INFO} says {meta.total_frames} frames; {AGAIN}")
    if whole and (np.diff(index) != 1).any():
        raise origin.refuse(DATA, "its rows are not in the order of their index; sort its files by it")
    unknown = task[(task < 0) | (task >= len(meta.tasks))]
    if len(unknown):
        raise origin.refuse(DATA, f"task_index={unknown[0]}, and there are {len(meta.tasks)}; {AGAIN}")
    by_index = np.searchsorted(meta.episodes["dataset_to_index"], index, side="right")
    for row in np.flatnonzero(by_index != episode)[:1]:
        where = f"row {index[row]} is of episode {episode[row]}, and by {EPISODES} of episode {by_index[row]}"
        raise origin.refuse(DATA, f"{where}; {AGAIN}")
    if not meta.video_keys:
        return
    # LeRobot looks up a video's frame by its timestamp, within 1e-4 s.
    stamps, regular = _column(rows, "timestamp", origin), step / meta.fps
    for row in np.flatnonzero(~np.isclose(stamps, regular, rtol=1e-6, atol=1e-4))[:1]:
        where = f"frame {step[row]} of episode {episode[row]} has the timestamp {stamps[row]:.4f}"
        hint = f"at {meta.fps} Hz it is {regular[row]:.4f}; set timestamps to frame_index / fps"
        raise origin.refuse(DATA, f"{where}, and {hint}")


def _column(rows: Any, name: str, origin: FileSource) -> np.ndarray:
    """A column of numbers, one for each row."""
    values = np.asarray(rows.with_format("numpy", columns=[name])[:][name])
    if values.dtype.kind not in "iuf" or not np.isfinite(values).all():
        raise origin.refuse(DATA, f"{name} has a number that is not finite; record it again")
    return values.reshape(-1)
