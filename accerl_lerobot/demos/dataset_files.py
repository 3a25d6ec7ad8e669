# SPDX-License-Identifier: Apache-2.0
"""Opening of LeRobotDatasets whose authors are not known.

LeRobot fills the templates of ``meta/info.json`` in with `str.format` and joins the result to the folder.
Where an image's ``bytes`` are missing, Hugging Face's `datasets` opens the file or address that its ``path``
names. Pillow has Ghostscript draw PostScript. In the context of `checked`, LeRobot's own classes refuse all
of this. Any other damage is an error of LeRobot's, and `open_metadata` and `opened` make one line of it.
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

from accerl_lerobot.checkpoint.safety import FileSource, check_folder, check_name, read_json, unsafe_name
from accerl_lerobot.errors import InputError, expanded, in_one_line

if TYPE_CHECKING:
    from accerl_lerobot.config.ranges import DatasetConfig

INFO, DATA = "meta/info.json", "data"
IMAGES = ("PNG", "JPEG", "TIFF")
"""Pillow's names of the formats that are decoded; LeRobot stores depth as TIFF."""
PLACE = re.compile(r"\{(video_key|(chunk_index|file_index)(:0?[1-9]?d)?)\}")
"""Fields that the templates of file names may have."""
OLD_VERSION = re.compile(r"v?[0-2](\.|$)")
"""Versions of the format that LeRobot refuses by itself; their ``info.json`` has other fields."""
PLAIN = {"Value", "Sequence", "List", "LargeList"}
"""Kinds of columns that `datasets` reads without opening other files."""


def open_metadata(dataset: DatasetConfig) -> Any:
    """LeRobot's metadata of a local or Hub dataset; anything wrong with it is one line."""
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    name, root = dataset.repo_id, dataset.root
    if name is None:
        hint = "name a LeRobotDataset; with dataset.root any label will do"
        raise InputError("dataset.repo_id", None, hint)
    if root is not None:
        root = str(expanded(root, "dataset.root"))
        if not (Path(root) / INFO).is_file():
            raise InputError("dataset.root", root, f"no {INFO} there; give the folder of a LeRobotDataset v3")
    with _one_line_errors(dataset), checked(origin_of(dataset), whole=root is not None):
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

    chosen = None if episodes is None else list(episodes)
    with checked(origin_of(dataset), whole=dataset.root is not None):
        with _one_line_errors(dataset):
            # The default backend probes for FFmpeg's libraries, and prints tracebacks where there are none.
            data = LeRobotDataset(
                meta.repo_id, root=meta.root, revision=meta.revision, episodes=chosen, video_backend="pyav"
            )
            _check_rows(data, origin_of(dataset))
        yield data


def _check_rows(data: Any, origin: FileSource) -> None:
    """Refuse rows that LeRobot would take for those of another episode or, in videos, of another time."""
    meta, names = data.meta, ["index", "episode_index", "frame_index", "timestamp"]
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
        tool += f" --root={expanded(dataset.root, 'dataset.root')}"
    why = f"its format is not {CODEBASE_VERSION}, which this LeRobot reads; from v2.1 convert with: {tool}"
    return InputError("dataset.repo_id", dataset.repo_id, f"{why} --push-to-hub=false")


def origin_of(dataset: DatasetConfig) -> FileSource:
    """The field that names a dataset's files."""
    if dataset.root is not None:
        return FileSource("dataset.root", dataset.root)
    return FileSource("dataset.repo_id", dataset.repo_id)


def task_texts(meta: Any) -> list[str]:
    """The dataset's instructions, in the order of their indices."""
    return [str(text) for text in meta.tasks.index]


@contextlib.contextmanager
def checked(origin: FileSource, whole: bool = False) -> Iterator[None]:
    """In this context LeRobot has a dataset's files checked when it reads them.

    With `whole`, missing files are refused; otherwise LeRobot fetches them.
    """
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.datasets.dataset_reader import DatasetReader

    from datasets import Image

    load_metadata, try_load = LeRobotDatasetMetadata._load_metadata, DatasetReader.try_load
    decode = Image.decode_example

    def checked_metadata(self: Any) -> None:
        check_metadata(Path(self.root), origin)
        try:
            load_metadata(self)
        except (FileNotFoundError, NotADirectoryError) as error:
            if whole:
                raise origin.refuse("meta", f"{error}; give the whole folder") from error
            raise
        if self.tasks is not None:  # LeRobot takes a task's index for the number of its row
            self.tasks = self.tasks.sort_values("task_index")

    def checked_try(self: Any) -> bool:
        found = bool(try_load(self))
        if whole and not found:
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


def check_metadata(root: Path, origin: FileSource) -> None:
    """Refuse metadata of an old version, or that would have LeRobot read outside the folder.

    Raises:
        CompatibilityError: LeRobot's, of an old version.
    """
    import pyarrow.parquet as pq
    from lerobot.datasets.utils import CompatibilityError

    if not (root / INFO).exists():
        return  # LeRobot fetches it
    check_folder(root, origin)
    info = read_json(root / INFO, origin)
    if OLD_VERSION.match(str(info.get("codebase_version"))):
        raise CompatibilityError
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
        if other := set(kinds) - PLAIN:  # `datasets` would open the files that they name
            hint = f"columns of kind {', '.join(other)[:80]}; numbers and texts are wanted"
            raise origin.refuse(path.name, hint)
