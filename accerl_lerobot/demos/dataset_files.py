# SPDX-License-Identifier: Apache-2.0
"""Opening of LeRobotDatasets, whose files are checked before LeRobot reads them.

LeRobot fills the templates of ``meta/info.json`` in with `str.format` and joins the result to the folder.
Where an image's ``bytes`` are missing, Hugging Face's `datasets` opens the file or address that its ``path``
names, and Pillow has Ghostscript draw PostScript. In the context of `checked`, LeRobot's own classes have
files checked first, wherever they come from. A child process does it, and then loads them with LeRobot,
within limits of memory and time.
"""

from __future__ import annotations

import contextlib
import io
import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from accerl_lerobot.checkpoint.isolation import rehearse
from accerl_lerobot.checkpoint.safety import (
    MIB,
    Origin,
    brief,
    check_name,
    file_size,
    read_json,
    safe_join,
    unsafe_name,
)
from accerl_lerobot.errors import InputError, expanded

if TYPE_CHECKING:
    import pyarrow.parquet as pq

    from accerl_lerobot.engine.config import DatasetConfig

INFO, STATS, TASKS, EPISODES, DATA = (
    "meta/info.json", "meta/stats.json", "meta/tasks.parquet", "meta/episodes", "data",
)  # fmt: skip
STATS_MOST = 32 * MIB
SIDE_MOST = 8192
INDEX = r"\{(chunk_index|file_index)(:0?[1-9]?d)?\}"
PLACES = {"data_path": INDEX, "video_path": rf"{INDEX}|\{{video_key\}}"}
LEARNED = ("action", "observation", "next.reward", "timestamp")
"""Prefixes of features in which a non-finite number would be learned from."""
PLAIN = {"Value", "Sequence", "List", "LargeList"}
"""Kinds of columns that `datasets` reads without opening other files."""
AGAIN = "get the dataset again"


def open_metadata(dataset: DatasetConfig) -> Any:
    """LeRobot's metadata of a local or Hub dataset; anything wrong with it is one line."""
    from lerobot.datasets.dataset_metadata import CODEBASE_VERSION, LeRobotDatasetMetadata
    from lerobot.datasets.utils import CompatibilityError

    name, root = dataset.repo_id, dataset.root
    if name is None:
        raise InputError(
            "dataset.repo_id", None, "name a LeRobotDataset; with dataset.root any label will do"
        )
    if root is not None:
        root = str(expanded(root, "dataset.root"))
        if not (Path(root) / INFO).is_file():
            raise InputError("dataset.root", root, f"no {INFO} there; give the folder of a LeRobotDataset v3")
    try:
        with checked(origin_of(dataset), whole=root is not None):
            return LeRobotDatasetMetadata(name, root=root, revision=dataset.revision)
    except InputError:
        raise
    except (CompatibilityError, NotImplementedError) as error:
        tool = f"python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id={name}"
        remedy = (
            f"its format is not {CODEBASE_VERSION}, which this LeRobot reads; from v2.1 convert with: {tool}"
        )
        raise InputError("dataset.repo_id", name, remedy) from error
    except Exception as error:  # LeRobot may fail over anything in the files
        if root is None and isinstance(error, (OSError, ValueError)):
            remedy = f"not found locally nor on the Hub ({brief(error)})"
            raise InputError("dataset.repo_id", name, remedy) from error
        raise origin_of(dataset).refuse("meta", f"LeRobot cannot read it ({brief(error)})") from error


@contextlib.contextmanager
def opened(dataset: DatasetConfig, meta: Any, episodes: Sequence[int] | None = None) -> Iterator[Any]:
    """A LeRobotDataset, whose files are checked as long as the context lasts.

    `meta` is what `open_metadata` gave for it, `episodes` are indices of those that are read; None: all.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    chosen = None if episodes is None else list(episodes)
    with checked(origin_of(dataset)):
        # The default backend probes for FFmpeg's libraries, and prints their tracebacks where there are none.
        yield LeRobotDataset(
            meta.repo_id, root=meta.root, revision=meta.revision, episodes=chosen, video_backend="pyav"
        )


def frames_of(data: Any, index: int) -> Iterator[dict[str, Any]]:
    """The items of an episode, one per env step, of a dataset that holds all episodes up to it."""
    first, last = (int(data.meta.episodes[index][f"dataset_{end}_index"]) for end in ("from", "to"))
    return (data[i] for i in range(first, last))


def pixels_of(image: Any) -> np.ndarray:
    """uint8 (h, w, 3) from LeRobot's float (3, h, w) in [0, 1]."""
    pixels: np.ndarray = (image * 255).round().clamp(0, 255).byte().permute(1, 2, 0).numpy()
    return pixels


def origin_of(dataset: DatasetConfig) -> Origin:
    """The field that names a dataset's files."""
    if dataset.root is not None:
        return Origin("dataset.root", dataset.root)
    return Origin("dataset.repo_id", dataset.repo_id)


def task_texts(meta: Any) -> list[str]:
    """The dataset's instructions."""
    return [str(text) for text in meta.tasks.index]


@contextlib.contextmanager
def checked(origin: Origin, whole: bool = False) -> Iterator[None]:
    """In this context LeRobot has a dataset's files checked before it reads them.

    With `whole`, missing files and rows are refused; otherwise LeRobot fetches them.
    """
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.datasets.dataset_reader import DatasetReader

    from accerl_lerobot.hub.errors import guard_client
    from datasets import Image

    decode = Image.decode_example
    load_metadata, load_data = LeRobotDatasetMetadata._load_metadata, DatasetReader._load_hf_dataset

    def checked_metadata(self: Any) -> None:
        root = Path(self.root)

        def check() -> None:
            check_metadata(root, origin, whole)
            try:
                load_metadata(self)
            except MemoryError:
                raise
            except Exception:
                pass  # the caller meets it as well, and LeRobot fetches what is missing

        rehearse(check, root, origin, "meta/**/*")
        load_metadata(self)

    def checked_data(self: Any) -> Any:
        root = Path(self.root)
        info = read_json(root / INFO, origin)

        def check() -> None:
            check_data(root, info, origin)
            try:
                rows = load_data(self)
            except MemoryError:
                raise
            except (FileNotFoundError, NotADirectoryError):
                return  # LeRobot fetches them
            except Exception as error:
                raise origin.refuse(DATA, f"LeRobot cannot load it ({_cause(error)}); {AGAIN}") from error
            check_rows(rows, info, origin, whole and self.episodes is None)

        rehearse(check, root, origin, "data/**/*")
        return load_data(self)

    def checked_decode(self: Any, value: Any, token_per_repo_id: Any = None) -> Any:
        try:
            return decode(self, value, token_per_repo_id)
        except Exception as error:
            raise _undecodable(error, DATA, origin) from error

    guard_client()
    Image.decode_example = checked_decode
    LeRobotDatasetMetadata._load_metadata = checked_metadata
    DatasetReader._load_hf_dataset = checked_data
    try:
        yield
    finally:
        LeRobotDatasetMetadata._load_metadata = load_metadata
        DatasetReader._load_hf_dataset = load_data
        Image.decode_example = decode


def _cause(error: BaseException) -> str:
    """The words of the first error, which `datasets` hides behind one of its own."""
    return _cause(error.__cause__) if error.__cause__ else brief(error)


def check_metadata(root: Path, origin: Origin, whole: bool = False) -> None:
    """Refuses metadata that are not what their names say; with `whole`, also missing files."""
    if not safe_join(root, INFO, origin).exists():
        return
    info = read_json(root / INFO, origin)
    check_info(info, origin)
    if safe_join(root, STATS, origin).exists():
        check_stats(read_json(root / STATS, origin, STATS_MOST), info["features"], origin)
    if safe_join(root, TASKS, origin).exists() or (whole and info.get("total_tasks", 0)):
        with _parquet(root / TASKS, origin) as tasks:
            _check_plain(tasks, TASKS, origin)
            if (count := tasks.metadata.num_rows) != info.get("total_tasks", 0):
                remedy = f"{count} tasks, and {INFO} says {info.get('total_tasks', 0)}; {AGAIN}"
                raise origin.refuse(TASKS, remedy)
    rows = 0
    files = _files(root, EPISODES, origin)
    for path in files:
        name = f"{EPISODES}/{path.parent.name}/{path.name}"
        with _parquet(path, origin) as episodes:
            _check_plain(episodes, name, origin)
            _check_episodes(episodes, info.get("total_frames", 0), name, origin)
            rows += episodes.metadata.num_rows
    if (files or whole) and rows < info.get("total_episodes", 0):
        raise origin.refuse(EPISODES, f"{rows} episodes, and {INFO} says {info['total_episodes']}; {AGAIN}")


def check_info(info: dict[str, Any], origin: Origin) -> None:
    """Refuses an ``info.json`` that would lead LeRobot out of the folder, or that we cannot use."""
    for key, places in PLACES.items():
        template = info.get(key)
        if template is None and (key == "video_path" or key not in info):
            continue
        example = re.sub(places, "0", template) if isinstance(template, str) else "{"
        strange = bool({"{", "}"} & set(example))
        if why := "use {chunk_index:03d} and the like only" if strange else unsafe_name(example):
            raise origin.refuse(f"{INFO}: {key}", f"{str(template)[:80]!r}: {why}")
    features = info.get("features")
    if not isinstance(features, dict) or not features:
        raise origin.refuse(f"{INFO}: features", "named features are wanted")
    for name, feature in features.items():
        where = f"{INFO}: features.{name[:60]}"
        check_name(name, where, origin)
        if not isinstance(feature, dict) or not isinstance(feature.get("dtype"), str):
            raise origin.refuse(where, "a mapping with dtype and shape is wanted")
        shape: Any = feature.get("shape")
        is_image = feature["dtype"] in ("image", "video")
        good = isinstance(shape, list) and all(type(side) is int and 0 < side < 2**31 for side in shape)
        if not good or (is_image and (len(shape) != 3 or max(shape) > SIDE_MOST)):
            wanted = f"an image has 3 sides of at most {SIDE_MOST}" if is_image else "use a list of lengths"
            raise origin.refuse(where, f"shape {str(shape)[:80]}; {wanted}")


def check_stats(stats: dict[str, Any], features: dict[str, Any], origin: Origin) -> None:
    """Refuses a ``stats.json`` (feature → statistic → numbers) that no policy can be normalised by."""
    for name in (name for name in stats if name.startswith(LEARNED)):
        if not isinstance(stats[name], dict):
            raise origin.refuse(f"{STATS}: {name}", "a mapping from statistics to numbers is wanted")
        feature = features.get(name, {"dtype": "image"})
        for statistic, values in stats[name].items():
            where, again = f"{STATS}: {name}.{statistic}", "compute the statistics again"
            try:
                array = np.asarray(values)
            except ValueError:
                array = np.asarray(None)
            if array.dtype.kind not in "biuf":
                raise origin.refuse(where, f"numbers in lists of equal lengths are wanted; {again}")
            plain = feature["dtype"] not in ("image", "video") and statistic != "count"
            if plain and array.shape and list(array.shape) != list(feature["shape"]):
                remedy = f"shape {list(array.shape)}, and the feature has {list(feature['shape'])}; {again}"
                raise origin.refuse(where, remedy)
            if not np.isfinite(array).all():
                raise origin.refuse(where, f"a number that is not finite; {again}")


def check_data(root: Path, info: dict[str, Any], origin: Origin) -> None:
    """Refuses files of rows, images and videos that name other files, before LeRobot reads them."""
    images = {name: feature for name, feature in info["features"].items() if feature["dtype"] == "image"}
    for path in _files(root, DATA, origin):
        name = f"{DATA}/{path.parent.name}/{path.name}"
        with _parquet(path, origin) as file:
            for image in images.keys() & set(file.schema_arrow.names):
                _check_images(file, image, list(images[image]["shape"]), name, origin)
    videos = safe_join(root, "videos", origin)
    for path in videos.rglob("*") if videos.is_dir() else ():
        safe_join(root, path.relative_to(root).as_posix(), origin)


def check_rows(rows: Any, info: dict[str, Any], origin: Origin, whole: bool = False) -> None:
    """Refuses rows that LeRobot has loaded and nobody can learn from; with `whole`, missing ones too."""
    frames = info.get("total_frames", 0)
    if len(rows) > frames or (whole and len(rows) < frames):
        raise origin.refuse(DATA, f"{len(rows)} rows, and {INFO} says {frames} frames; {AGAIN}")
    below = {"task_index": info.get("total_tasks", 0), "episode_index": info.get("total_episodes", 0)}
    for name, feature in info["features"].items():
        whole_numbers = feature["dtype"].startswith(("int", "uint"))
        if not whole_numbers and not (feature["dtype"].startswith("float") and name.startswith(LEARNED)):
            continue
        values = np.asarray(rows.with_format("numpy", columns=[name])[:][name])
        if values.dtype.kind not in "biuf" or not np.isfinite(values).all():
            raise origin.refuse(DATA, f"{name[:60]} has a number that is not finite; record it again")
        if name in below and len(wrong := values[(values < 0) | (values >= below[name])]):
            raise origin.refuse(DATA, f"{name}={wrong[0]}, and there are {below[name]}; {AGAIN}")


def _files(root: Path, folder: str, origin: Origin) -> list[Path]:
    """Files that LeRobot would read, none of which leads out of the dataset."""
    if not safe_join(root, folder, origin).is_dir():
        return []
    paths = sorted((root / folder).glob("*/*.parquet"))
    return [safe_join(root, path.relative_to(root).as_posix(), origin) for path in paths]


@contextlib.contextmanager
def _parquet(path: Path, origin: Origin) -> Iterator[pq.ParquetFile]:
    """An open file; whatever Arrow finds wrong with it becomes one line."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    file_size(path, origin)
    try:
        with pq.ParquetFile(path) as file:
            yield file
    except InputError:
        raise
    except (pa.ArrowException, OSError, ValueError, KeyError, TypeError, IndexError) as error:
        raise origin.refuse(path.name, f"not good parquet ({brief(error)}); {AGAIN}") from error


def _check_plain(file: pq.ParquetFile, name: str, origin: Origin) -> None:
    """Refuses metadata that are not numbers and texts: `datasets` would open the files that others name."""
    stored = (file.schema_arrow.metadata or {}).get(b"huggingface")
    kinds: set[str] = set()
    try:
        json.loads(stored or b"{}", object_hook=lambda mapping: kinds.add(str(mapping.get("_type", "Value"))))
    except (ValueError, RecursionError) as error:
        raise origin.refuse(name, f"its description of columns is not JSON; {AGAIN}") from error
    if kinds - PLAIN:
        remedy = f"columns of kind {', '.join(sorted(kinds - PLAIN))[:80]}, which name other files"
        raise origin.refuse(name, f"{remedy}; numbers and texts are wanted")


def _check_episodes(file: pq.ParquetFile, frames: int, name: str, origin: Origin) -> None:
    """Refuses a table of episodes that does not say where they are."""
    import pyarrow as pa

    span, places = ("dataset_from_index", "dataset_to_index"), ("/chunk_index", "/file_index")
    columns = [c for c in file.schema_arrow.names if c in span or c.endswith(places)]
    if missing := {*span, *(f"data{place}" for place in places)} - set(columns):
        raise origin.refuse(name, f"no column {min(missing)}; {AGAIN}")
    table = file.read(columns=columns)
    for column, values in zip(table.column_names, table.columns, strict=True):
        if not pa.types.is_integer(values.type) or values.null_count or (values.to_numpy() < 0).any():
            raise origin.refuse(f"{name}: {column}", f"whole numbers from 0 are wanted; {AGAIN}")
    first, last = (table.column(column).to_numpy() for column in span)
    if len(wrong := np.flatnonzero((last <= first) | (last > frames))):
        span_text = f"from frame {first[wrong[0]]} to {last[wrong[0]]} of {frames}"
        raise origin.refuse(name, f"an episode {span_text}; {AGAIN}")


def _undecodable(error: Exception, where: str, origin: Origin) -> InputError:
    return origin.refuse(
        where, f"an image that is no PNG or JPEG, or broken ({brief(error)}); record it again"
    )


def _check_images(file: pq.ParquetFile, image: str, shape: list[int], name: str, origin: Origin) -> None:
    """Refuses images that are not PNG or JPEG of the right size in their rows, or that name other files."""
    import pyarrow as pa
    from PIL import Image

    where = f"{name}: {image[:60]}"
    kind = file.schema_arrow.field(image).type
    if not pa.types.is_struct(kind) or {f.name for f in kind} != {"bytes", "path"}:
        raise origin.refuse(where, "no column of images with their bytes; record it again")
    for batch in file.iter_batches(batch_size=32, columns=[image]):
        column = batch.column(0)
        if column.null_count or column.field("bytes").null_count:
            raise origin.refuse(where, "an image without its bytes; record it again")
        for path in filter(None, column.field("path").to_pylist()):
            check_name(path, f"{where}.path", origin)
        for cell in column.field("bytes").to_pylist():
            try:
                with Image.open(io.BytesIO(cell), formats=("PNG", "JPEG")) as opened:  # reads the header
                    size = list(opened.size)
            except Exception as error:  # Pillow's plugins raise what they like
                raise _undecodable(error, where, origin) from error
            if size not in (shape[1::-1], shape[:0:-1]):
                remedy = (
                    f"an image of {size[0]} x {size[1]} pixels, and its shape is {shape}; record it again"
                )
                raise origin.refuse(where, remedy)
