# SPDX-License-Identifier: Apache-2.0
"""Checks of a LeRobotDataset's files, before LeRobot believes them.

LeRobot fills the templates of ``meta/info.json`` in with `str.format` and joins the outcome to the folder.
Where an image's ``bytes`` are missing, Hugging Face's `datasets` opens what its ``path`` names, a file of
this machine or an address, and Pillow has Ghostscript draw what is PostScript. Parquet stores a million equal
rows in a few bytes. While `checked` lasts, LeRobot's own classes look at the files first, wherever they come
from, the Hub included.
"""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from accerl_lerobot.checkpoint.safety import (
    MIB,
    Origin,
    brief,
    check_name,
    check_number,
    check_shape,
    check_template,
    file_size,
    read_json,
    safe_join,
)
from accerl_lerobot.errors import InputError

if TYPE_CHECKING:
    import pyarrow.parquet as pq

INFO, STATS, TASKS, EPISODES, DATA = (
    "meta/info.json", "meta/stats.json", "meta/tasks.parquet", "meta/episodes", "data",
)  # fmt: skip
STATS_MOST = 32 * MIB
META_FILE_MOST, FOOTER_MOST = 512 * MIB, 64 * MIB
FEATURES_MOST, COLUMNS_MOST = 1_000, 20_000
EPISODES_MOST, FRAMES_MOST, LENGTH_MOST = 10_000_000, 10_000_000_000, 1_000_000
TEXT_MOST, TEXTS_MOST = 65_536, 64 * MIB
"""Bytes of one task's text, and of all of them written out."""
SIDE_MOST, PIXELS_MOST, NUMBERS_MOST = 8192, 64_000_000, 10_000_000
"""Pixels of an image's side and of all of it; numbers in any other feature of one frame."""
FPS_MOST = 10_000
DEPTH_MOST = 8
"""Lists within lists of a statistic."""
DTYPES = {
    "image", "video", "string", "bool", "language", "int8", "int16", "int32", "int64", "uint8", "uint16",
    "uint32", "uint64", "float16", "float32", "float64",
}  # fmt: skip
IMAGES = (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff")
"""First bytes of PNG and JPEG, which LeRobot writes; for one of the others Pillow runs a program."""
LEARNT = ("action", "observation", "next.reward", "timestamp")
"""First parts of the names of features in which a non-finite number would be learnt from."""
PLAIN = {"Value", "Sequence", "List", "LargeList"}
"""Kinds of columns that `datasets` reads without opening other files."""
DATA_PLACES: dict[str, type] = {"chunk_index": int, "file_index": int}
VIDEO_PLACES: dict[str, type] = DATA_PLACES | {"video_key": str}
"""Fields that the templates of ``info.json`` may contain."""


def check_info(info: dict[str, Any], origin: Origin) -> None:
    """The content of ``meta/info.json``.

    Raises:
        InputError: it would lead LeRobot out of the folder, or into more memory than there is.
    """

    def at(key: str) -> str:
        return f"{INFO}: {key}"

    version = info.get("codebase_version")
    if not isinstance(version, str) or not 0 < len(version) <= 32:
        raise origin.refuse(at("codebase_version"), "a version such as v3.0 is wanted")
    check_number(info.get("fps"), 1, FPS_MOST, at("fps"), origin)
    for key, most in (
        ("total_episodes", EPISODES_MOST), ("total_frames", FRAMES_MOST), ("total_tasks", EPISODES_MOST),
    ):  # fmt: skip
        _check_count(info.get(key, 0), 0, most, at(key), origin)
    for key in ("chunks_size", "data_files_size_in_mb", "video_files_size_in_mb"):
        _check_count(info.get(key, 1), 1, 10**9, at(key), origin)
    if "data_path" in info:
        check_template(info["data_path"], DATA_PLACES, at("data_path"), origin)
    if info.get("video_path") is not None:
        check_template(info["video_path"], VIDEO_PLACES, at("video_path"), origin)
    features = info.get("features")
    if not isinstance(features, dict) or not 0 < len(features) <= FEATURES_MOST:
        raise origin.refuse(at("features"), f"1 to {FEATURES_MOST} named features are wanted")
    for name, feature in features.items():
        _check_feature(name, feature, origin)
    if not isinstance(info.get("splits", {}), dict) or not isinstance(
        info.get("tools", []), (list, type(None))
    ):
        raise origin.refuse(INFO, "splits is a mapping and tools a list; record the dataset again")


def check_stats(stats: dict[str, Any], features: dict[str, Any], origin: Origin) -> None:
    """The content of ``meta/stats.json``: feature → statistic → numbers, as many as the feature has.

    Raises:
        InputError: it is something else, or a policy would be normalised by a number that is not finite.
    """
    for name, statistics in stats.items():
        if not isinstance(statistics, dict):
            raise origin.refuse(f"{STATS}: {name}", "a mapping from statistics to numbers is wanted")
        feature = features.get(name, {"dtype": "image"})
        for statistic, values in statistics.items():
            where, again = f"{STATS}: {name}.{statistic}", "compute the statistics again"
            if (shape := _regular(values)) is None:
                raise origin.refuse(where, f"numbers in lists of equal lengths are wanted; {again}")
            if not name.startswith(LEARNT):
                continue
            plain = feature["dtype"] not in ("image", "video") and statistic != "count"
            if plain and shape and list(shape) != list(feature["shape"]):
                remedy = f"shape {list(shape)}, and the feature has {list(feature['shape'])}; {again}"
                raise origin.refuse(where, remedy)
            if not np.isfinite(np.asarray(values, np.float64)).all():
                raise origin.refuse(where, f"a number that is not finite; {again}")


def check_metadata(root: Path, origin: Origin, whole: bool = False) -> None:
    """All of ``meta/``, before LeRobot reads it.

    Args:
        root: the dataset's folder.
        origin: who named it.
        whole: whether a missing file is an error; otherwise nothing is said, and LeRobot fetches it.

    Raises:
        InputError: a file is not what its name says, or larger than such a file may be.
    """
    if not safe_join(root, INFO, origin).exists():
        return
    info = read_json(root / INFO, origin)
    check_info(info, origin)
    if safe_join(root, STATS, origin).exists():
        check_stats(read_json(root / STATS, origin, STATS_MOST), info["features"], origin)
    if safe_join(root, TASKS, origin).exists() or (whole and info.get("total_tasks", 0)):
        with _parquet(root / TASKS, origin) as tasks:
            _check_plain(tasks, TASKS, origin)
            _check_texts(tasks, TASKS, origin)
            if (count := tasks.metadata.num_rows) != info.get("total_tasks", 0):
                remedy = f"{count} tasks, and {INFO} says {info.get('total_tasks', 0)}; get the dataset again"
                raise origin.refuse(TASKS, remedy)
    rows = 0
    files = _files(root, EPISODES, origin)
    for path in files:
        name = f"{EPISODES}/{path.parent.name}/{path.name}"
        with _parquet(path, origin) as episodes:
            _check_plain(episodes, name, origin)
            rows += _check_episodes(episodes, info, name, origin)
    if (files or whole) and rows < info.get("total_episodes", 0):
        remedy = f"{rows} episodes, and {INFO} says {info['total_episodes']}; get the dataset again"
        raise origin.refuse(EPISODES, remedy)


def check_data(root: Path, info: dict[str, Any], origin: Origin, whole: bool = False) -> None:
    """The parquet files of ``data/`` and the folders of videos, before LeRobot reads them.

    Args:
        root: the dataset's folder.
        info: content of its ``meta/info.json``, checked.
        origin: who named it.
        whole: whether fewer rows than frames are an error; otherwise LeRobot fetches the others.

    Raises:
        InputError: there are other rows than frames, a column is not what its feature says, a number cannot
            be learnt from, or an image is no PNG or JPEG inside its row.
    """
    features = {name: feature for name, feature in info["features"].items() if feature["dtype"] != "video"}
    rows = 0
    for path in _files(root, DATA, origin):
        name = f"{DATA}/{path.parent.name}/{path.name}"
        with _parquet(path, origin) as file:
            rows += file.metadata.num_rows
            if rows > info.get("total_frames", 0):
                remedy = f"more rows than the {info.get('total_frames', 0)} frames that {INFO} says"
                raise origin.refuse(name, f"{remedy}; get the dataset again")
            _check_columns(file, features, info, name, origin)
            for feature in (f for f in features if features[f]["dtype"] == "image"):
                _check_images(file, feature, list(features[feature]["shape"]), name, origin)
    if whole and rows < info.get("total_frames", 0):
        raise origin.refuse(DATA, _fewer(rows, info["total_frames"]))
    videos = safe_join(root, "videos", origin)
    for path in videos.rglob("*") if videos.is_dir() else ():
        safe_join(root, path.relative_to(root).as_posix(), origin)


def _fewer(rows: int, frames: int) -> str:
    return f"{rows} rows, fewer than the {frames} frames that {INFO} says; get the dataset again"


@contextlib.contextmanager
def checked(origin: Origin, whole: bool = False) -> Iterator[None]:
    """While it lasts, LeRobot checks a dataset's files before it reads them, in this process.

    Args:
        origin: who named the dataset.
        whole: see `check_metadata`.
    """
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.datasets.dataset_reader import DatasetReader
    from PIL import Image

    from accerl_lerobot.hub.errors import guard_client
    from datasets import Image as ImageFeature

    load_metadata, load_data = LeRobotDatasetMetadata._load_metadata, DatasetReader._load_hf_dataset
    index, decode = DatasetReader._build_index_mapping, ImageFeature.decode_example
    pixels = Image.MAX_IMAGE_PIXELS

    def checked_metadata(self: Any) -> None:
        check_metadata(Path(self.root), origin, whole)
        load_metadata(self)

    def checked_data(self: Any) -> Any:
        root = Path(self.root)
        check_data(root, read_json(root / INFO, origin), origin, whole and self.episodes is None)
        return load_data(self)

    def checked_index(self: Any) -> None:
        if self.episodes is None and len(self.hf_dataset) < self._meta.total_frames:
            raise origin.refuse(DATA, _fewer(len(self.hf_dataset), self._meta.total_frames))
        index(self)

    def checked_decode(self: Any, value: Any, token_per_repo_id: Any = None) -> Any:
        try:
            return decode(self, value, token_per_repo_id)
        except Exception as error:
            raise _undecodable(error, DATA, origin) from error

    guard_client()
    ImageFeature.decode_example = checked_decode
    LeRobotDatasetMetadata._load_metadata = checked_metadata
    DatasetReader._load_hf_dataset = checked_data
    DatasetReader._build_index_mapping = checked_index
    Image.MAX_IMAGE_PIXELS = PIXELS_MOST // 2  # Pillow refuses what is twice as large
    try:
        yield
    finally:
        LeRobotDatasetMetadata._load_metadata = load_metadata
        DatasetReader._load_hf_dataset = load_data
        DatasetReader._build_index_mapping = index
        ImageFeature.decode_example = decode
        Image.MAX_IMAGE_PIXELS = pixels


def _check_count(value: object, low: int, high: int, what: str, origin: Origin) -> None:
    if not isinstance(value, int):
        raise origin.refuse(what, f"{str(value)[:40]!r}; use a whole number")
    check_number(value, low, high, what, origin)


def _check_feature(name: str, feature: Any, origin: Origin) -> None:
    where = f"{INFO}: features.{name[:60]}"
    check_name(name, where, origin)
    if not isinstance(feature, dict) or str(feature.get("dtype")) not in DTYPES:
        raise origin.refuse(where, f"a dtype is wanted, one of {', '.join(sorted(DTYPES))}")
    shape = feature.get("shape")
    for key in ("info", "video_info"):
        if not isinstance(feature.get(key), (dict, type(None))):
            raise origin.refuse(where, f"{key} is a mapping; record the dataset again")
    if feature["dtype"] not in ("image", "video"):
        check_shape(shape, NUMBERS_MOST, where, origin)
        return
    check_shape(shape, PIXELS_MOST * 4, where, origin)
    if len(shape or ()) != 3 or max(shape or ()) > SIDE_MOST:
        raise origin.refuse(where, f"shape {shape}; an image has 3 sides of at most {SIDE_MOST}")


def _regular(values: Any, depth: int = 0) -> tuple[int, ...] | None:
    """The shape of nested lists of numbers; None if they are not regular, or hold something else."""
    if depth > DEPTH_MOST:
        return None
    if isinstance(values, (int, float)):  # true and false are minima of flags
        return () if isinstance(values, float) or abs(values) < 2**63 else None
    if not isinstance(values, list) or len(values) > NUMBERS_MOST:
        return None
    shapes = {_regular(value, depth + 1) for value in values}
    if len(shapes) > 1 or None in shapes:
        return None
    inner = next(iter(shapes), ())
    return (len(values), *(inner or ()))


def _files(root: Path, folder: str, origin: Origin) -> list[Path]:
    """Files that LeRobot would read, none of which leads out of the dataset."""
    if not safe_join(root, folder, origin).is_dir():
        return []
    found = sorted((root / folder).glob("*/*.parquet"))
    return [safe_join(root, path.relative_to(root).as_posix(), origin) for path in found]


@contextlib.contextmanager
def _parquet(path: Path, origin: Origin) -> Iterator[pq.ParquetFile]:
    """Its metadata; whatever Arrow finds wrong with the file is the user's to know."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    if file_size(path, origin) > META_FILE_MOST and DATA not in path.parts:
        raise origin.refuse(path.name, f"more than {META_FILE_MOST} bytes; get the dataset again")
    try:
        limits = {"thrift_string_size_limit": FOOTER_MOST, "thrift_container_size_limit": 10**6}
        with pq.ParquetFile(path, **limits) as file:
            if file.metadata.num_columns > COLUMNS_MOST:
                raise origin.refuse(path.name, f"more than {COLUMNS_MOST} columns; get the dataset again")
            yield file
    except InputError:
        raise
    except (pa.ArrowException, OSError, ValueError, KeyError, TypeError, IndexError, MemoryError) as error:
        raise origin.refuse(path.name, f"not good parquet ({brief(error)}); get the dataset again") from error


def _check_plain(file: pq.ParquetFile, name: str, origin: Origin) -> None:
    """Metadata of numbers and texts only, of a size that can be read."""
    import pyarrow as pa

    stored = (file.schema_arrow.metadata or {}).get(b"huggingface")
    try:
        kinds = set(_kinds(json.loads(stored))) if stored else set()
    except (ValueError, RecursionError) as error:
        raise origin.refuse(name, "its description of columns is not JSON; get the dataset again") from error
    if kinds - PLAIN:
        remedy = (
            f"columns of kind {', '.join(sorted(kinds - PLAIN))[:80]}, which name other files; numbers and "
        )
        raise origin.refuse(name, f"{remedy}texts are wanted")
    for field in file.schema_arrow:
        kind = field.type
        while pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
            if pa.types.is_fixed_size_list(kind) and kind.list_size > NUMBERS_MOST:
                raise origin.refuse(name, f"lists of {kind.list_size}; use at most {NUMBERS_MOST}")
            kind = kind.value_type
        primitive = pa.types.is_primitive(kind) or pa.types.is_null(kind)
        if not (primitive or pa.types.is_string(kind) or pa.types.is_large_string(kind)):
            raise origin.refuse(name, f"column {field.name[:60]} of {str(kind)[:60]}; use numbers and texts")
    # Not how many values a column has: pyarrow 26.0.1 ends the process where that description is damaged.
    if not 0 <= file.metadata.num_rows <= EPISODES_MOST:
        raise origin.refuse(name, f"{file.metadata.num_rows} rows; use at most {EPISODES_MOST}")


def _kinds(described: Any) -> Iterator[str]:
    if isinstance(described, dict):
        if "_type" in described:
            yield str(described["_type"])
        described = list(described.values())
    if isinstance(described, list):
        for entry in described:
            yield from _kinds(entry)


def _check_texts(file: pq.ParquetFile, name: str, origin: Origin) -> None:
    """Texts are counted as stored, once each, before they are written out row by row."""
    import pyarrow as pa

    columns = [
        f.name for f in file.schema_arrow if pa.types.is_string(f.type) or pa.types.is_large_string(f.type)
    ]
    total = 0
    for batch in file.iter_batches(batch_size=1024, columns=columns) if columns else ():
        for column in batch.columns:
            sizes = [len(text or "") for text in column.to_pylist()]
            total += sum(sizes)
            if max(sizes, default=0) > TEXT_MOST or total > TEXTS_MOST:
                raise origin.refuse(name, f"a text of more than {TEXT_MOST} characters, or too many of them")


def _check_episodes(file: pq.ParquetFile, info: dict[str, Any], name: str, origin: Origin) -> int:
    """Where each episode is; gives how many there are."""
    frames = info.get("total_frames", 0)
    bounds = {"episode_index": EPISODES_MOST, "length": LENGTH_MOST}
    bounds |= dict.fromkeys(("dataset_from_index", "dataset_to_index"), frames)
    for column in file.schema_arrow.names:
        if column.endswith(("/chunk_index", "/file_index")):
            bounds[column] = EPISODES_MOST
    wanted = ("dataset_from_index", "dataset_to_index", "data/chunk_index", "data/file_index")
    if missing := [column for column in wanted if column not in file.schema_arrow.names]:
        raise origin.refuse(name, f"no column {missing[0]}; get the dataset again")
    count = 0
    present = [column for column in bounds if column in file.schema_arrow.names]
    for batch in file.iter_batches(batch_size=4096, columns=present):
        rows = batch.to_pydict()
        for column in present:
            for value in rows[column]:
                _check_count(value, 0, bounds[column], f"{name}: {column}", origin)
        for first, last in zip(rows["dataset_from_index"], rows["dataset_to_index"], strict=True):
            if not first < last <= first + LENGTH_MOST:
                remedy = f"an episode from frame {first} to {last}; get the dataset again"
                raise origin.refuse(name, remedy)
        count += batch.num_rows
    return count


def _check_columns(
    file: pq.ParquetFile, features: dict[str, Any], info: dict[str, Any], name: str, origin: Origin
) -> None:
    """Columns are what features say: all of them, of such numbers, as many in each row."""
    columns = set(file.schema_arrow.names)
    if missing := sorted(features.keys() - columns) or sorted(columns - features.keys()):
        which = "is no column" if missing[0] in features else f"is no feature of {INFO}"
        raise origin.refuse(name, f"{missing[0][:60]} {which}; get the dataset again")
    below = {"task_index": info.get("total_tasks", 0), "episode_index": info.get("total_episodes", 0)}
    numbers = [f for f in features if features[f]["dtype"] not in ("image", "string", "language")]
    for feature in numbers:
        dtype = features[feature]["dtype"]
        if _family(file.schema_arrow.field(feature).type) != _FAMILIES[dtype.rstrip("0123468")]:
            raise origin.refuse(name, f"{feature[:60]} holds no numbers of type {dtype}; record it again")
    for batch in file.iter_batches(batch_size=1024, columns=numbers):
        for feature, column in zip(batch.schema.names, batch.columns, strict=True):
            shape = list(features[feature]["shape"])
            values = _values(column, [] if shape == [1] else shape)
            if values is None:
                remedy = f"{feature[:60]} has other numbers than {shape} in a row; record it again"
                raise origin.refuse(name, remedy)
            if feature.startswith(LEARNT) and not np.isfinite(values).all():
                raise origin.refuse(name, f"{feature[:60]} has a number that is not finite; record it again")
            if feature in below:
                wrong = values[(values < 0) | (values >= below[feature])]
                if len(wrong):
                    remedy = f"{feature}={wrong[0]}, and there are {below[feature]}; get the dataset again"
                    raise origin.refuse(name, remedy)


_FAMILIES = {"bool": "b", "int": "i", "uint": "i", "float": "f"}
"""dtype of a feature, without its bits, → `_family` of its column."""


def _family(kind: Any) -> str:
    """Kind of a column's values, at the bottom of its lists: b, i, f, or nothing of these."""
    import pyarrow as pa

    kind = getattr(kind, "storage_type", kind)
    while pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind):
        kind = kind.value_type
    tests = {"b": pa.types.is_boolean, "i": pa.types.is_integer, "f": pa.types.is_floating}
    return next((family for family, test in tests.items() if test(kind)), "")


def _values(column: Any, shape: list[int]) -> np.ndarray | None:
    """All numbers of a column whose rows have a shape; None if one has another."""
    import pyarrow as pa
    import pyarrow.compute as pc

    column = getattr(column, "storage", column)
    for length in shape:
        if not hasattr(column, "flatten") or not hasattr(column.type, "value_type") or column.null_count:
            return None
        if not pc.all(pc.equal(pc.list_value_length(column), length)).as_py():
            return None
        column = column.flatten()
    if column.null_count or pa.types.is_nested(column.type):
        return None
    return np.asarray(column.to_numpy(zero_copy_only=False))


def _undecodable(error: Exception, name: str, origin: Origin) -> InputError:
    return origin.refuse(name, f"an image that cannot be read ({brief(error)}); record it again")


def _check_images(file: pq.ParquetFile, image: str, shape: list[int], name: str, origin: Origin) -> None:
    """Its bytes are PNG or JPEG, lie in the row, and what it says of a path names no other file."""
    import pyarrow as pa
    from PIL import Image

    kinds = {field.name: field.type for field in file.schema_arrow}
    kind = kinds.get(image)
    if kind is None or not pa.types.is_struct(kind) or {f.name for f in kind} != {"bytes", "path"}:
        raise origin.refuse(name, f"{image[:60]} is no column of images with their bytes; record it again")
    for batch in file.iter_batches(batch_size=32, columns=[image]):
        column = batch.column(0)
        if column.null_count or column.field("bytes").null_count:
            raise origin.refuse(name, f"{image[:60]}: an image without its bytes; record it again")
        for path in column.field("path").to_pylist():
            if path is not None:
                check_name(path, f"{name}: {image[:60]}.path", origin)
        for cell in column.field("bytes").to_pylist():
            if not cell.startswith(IMAGES):
                raise origin.refuse(name, f"{image[:60]}: an image that is no PNG or JPEG; record it again")
            try:
                with Image.open(io.BytesIO(cell), formats=("PNG", "JPEG")) as opened:  # reads its header
                    size = list(opened.size)
            except Exception as error:  # Pillow's plugins raise what they like
                raise _undecodable(error, f"{name}: {image[:60]}", origin) from error
            if size not in (shape[1::-1], shape[:0:-1]):
                remedy = (
                    f"an image of {size[0]} x {size[1]} pixels, and its shape is {shape}; record it again"
                )
                raise origin.refuse(name, f"{image[:60]}: {remedy}")
