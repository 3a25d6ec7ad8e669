# SPDX-License-Identifier: Apache-2.0
"""Opening of LeRobotDatasets, whose files are checked before LeRobot reads them.

LeRobot fills the templates of ``meta/info.json`` in with `str.format` and joins the result to the folder.
Where an image's ``bytes`` are missing, Hugging Face's `datasets` opens the file or address that its ``path``
names, and Pillow has Ghostscript draw PostScript. In the context of `checked`, LeRobot's own classes have
files checked first, wherever they come from. A child process does it, and then loads them with LeRobot,
within limits of memory and time.

LeRobot looks up tasks and episodes by their rows; `put_in_order` sorts the rows by the index that names them.
Statistics and columns are checked in `policies.features` and `demos.episodes`, which know what is read.
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
    FileSource,
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

    from accerl_lerobot.config.ranges import DatasetConfig

INFO, STATS, TASKS, EPISODES, DATA = (
    "meta/info.json", "meta/stats.json", "meta/tasks.parquet", "meta/episodes", "data",
)  # fmt: skip
SIDE_MOST = 8192
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

    name, root = dataset.repo_id, dataset.root
    if name is None:
        raise InputError(
            "dataset.repo_id", None, "name a LeRobotDataset; with dataset.root any label will do"
        )
    if root is not None:
        root = str(expanded(root, "dataset.root"))
        if not (Path(root) / INFO).is_file():
            raise InputError("dataset.root", root, f"no {INFO} there; give the folder of a LeRobotDataset v3")
        info = read_json(Path(root) / INFO, origin_of(dataset))
        if OLD_VERSION.match(str(info.get("codebase_version"))):  # LeRobot would warn of its fields first
            raise another_version(dataset)
    try:
        with checked(origin_of(dataset), whole=root is not None):
            meta = LeRobotDatasetMetadata(name, root=root, revision=dataset.revision)
    except InputError:
        raise
    except (CompatibilityError, NotImplementedError) as error:
        raise another_version(dataset) from error
    except Exception as error:  # LeRobot may fail over anything in the files
        if root is None and isinstance(error, (OSError, ValueError)):
            hint = f"not found locally nor on the Hub ({brief(error)})"
            raise InputError("dataset.repo_id", name, hint) from error
        raise origin_of(dataset).refuse("meta", f"LeRobot cannot read it ({brief(error)})") from error
    if meta.episodes is None or meta.tasks is None:
        raise origin_of(dataset).refuse(INFO, "it has no episodes, or no tasks; name a dataset that has some")
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
    """In this context LeRobot has a dataset's files checked before it reads them.

    With `whole`, missing files and rows are refused; otherwise LeRobot fetches them.
    """
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.datasets.dataset_reader import DatasetReader

    from accerl_lerobot.hub.errors import guard_client
    from datasets import Image

    decode = Image.decode_example
    load_metadata, load_data = LeRobotDatasetMetadata._load_metadata, DatasetReader._load_hf_dataset
    try_load = DatasetReader.try_load

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
        try:
            load_metadata(self)
        except (FileNotFoundError, NotADirectoryError) as error:
            if whole:
                raise origin.refuse("meta", f"{brief(error)}; give the whole folder") from error
            raise
        put_in_order(self, origin)

    def checked_data(self: Any) -> Any:
        root = Path(self.root)

        def check() -> None:
            check_data(root, origin)
            try:
                rows = load_data(self)
            except MemoryError:
                raise
            except (FileNotFoundError, NotADirectoryError):
                return  # see `try_load`
            except Exception as error:
                raise origin.refuse(DATA, f"LeRobot cannot load it ({_cause(error)}); {AGAIN}") from error
            check_rows(rows, self._meta, origin, self.episodes is None, whole)

        rehearse(check, root, origin, "data/**/*")
        return load_data(self)

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

    guard_client()
    Image.decode_example = checked_decode
    LeRobotDatasetMetadata._load_metadata = checked_metadata
    DatasetReader._load_hf_dataset = checked_data
    DatasetReader.try_load = checked_try
    try:
        yield
    finally:
        LeRobotDatasetMetadata._load_metadata = load_metadata
        DatasetReader._load_hf_dataset = load_data
        DatasetReader.try_load = try_load
        Image.decode_example = decode


def put_in_order(meta: Any, origin: FileSource) -> None:
    """Make good what LeRobot takes for granted: tasks and episodes in the order of their indices, names of an
    image's axes, and statistics of each camera, into which it writes those of ImageNet."""
    if meta.tasks is not None:
        table = meta.tasks.set_index("task") if "task" in meta.tasks.columns else meta.tasks
        meta.tasks = table.sort_values("task_index")
        _check_numbers(meta.tasks["task_index"].tolist(), TASKS, "task_index", origin)
    if meta.episodes is not None:
        numbers = np.asarray(meta.episodes["episode_index"])
        if (order := np.argsort(numbers)).tolist() != list(range(len(numbers))):
            meta.episodes = meta.episodes.select(order)
        _check_numbers(numbers[order].tolist(), EPISODES, "episode_index", origin)
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


def _cause(error: BaseException) -> str:
    """The words of the first error, which `datasets` hides behind one of its own."""
    return _cause(error.__cause__) if error.__cause__ else brief(error)


def check_metadata(root: Path, origin: FileSource, whole: bool = False) -> None:
    """Refuses metadata that are not what their names say; with `whole`, also missing files."""
    if not safe_join(root, INFO, origin).exists():
        return
    info = read_json(root / INFO, origin)
    if OLD_VERSION.match(str(info.get("codebase_version"))):
        return  # LeRobot looks at it next, and reads nothing more
    check_info(info, origin)
    safe_join(root, STATS, origin)
    if safe_join(root, TASKS, origin).exists() or (whole and info.get("total_tasks", 0)):
        with _parquet(root / TASKS, origin) as tasks:
            _check_plain(tasks, TASKS, origin)
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


def check_info(info: dict[str, Any], origin: FileSource) -> None:
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


def check_data(root: Path, origin: FileSource) -> None:
    """Refuses files of rows and videos that lie elsewhere, before LeRobot reads them."""
    _files(root, DATA, origin)
    videos = safe_join(root, "videos", origin)
    for path in videos.rglob("*") if videos.is_dir() else ():
        safe_join(root, path.relative_to(root).as_posix(), origin)


def check_rows(rows: Any, meta: Any, origin: FileSource, every: bool, whole: bool) -> None:
    """Refuses rows whose indices do not say where they belong; `every`: those of all episodes were loaded."""
    frames = meta.total_frames
    if len(rows) > frames or (whole and every and len(rows) < frames):
        raise origin.refuse(DATA, f"{len(rows)} rows, and {INFO} says {frames} frames; {AGAIN}")
    most = {
        "index": frames,
        "frame_index": frames,
        "task_index": len(meta.tasks),
        "episode_index": len(meta.episodes),
    }
    columns = {name: _finite(rows, name, origin) for name in (*most, *["timestamp"] * bool(meta.video_keys))}
    for name, limit in most.items():
        if len(wrong := columns[name][(columns[name] < 0) | (columns[name] >= limit)]):
            raise origin.refuse(DATA, f"{name}={wrong[0]}, and there are {limit}; {AGAIN}")
    index, episode, step = (columns[name] for name in ("index", "episode_index", "frame_index"))
    if len(index) == frames and (np.diff(index) != 1).any():
        raise origin.refuse(DATA, "its rows are not in the order of their index; sort its files by it")
    first, last = (np.asarray(meta.episodes[f"dataset_{end}_index"])[episode] for end in ("from", "to"))
    if len(wrong := np.flatnonzero((index < first) | (index >= last))):
        row = wrong[0]
        span = f"{EPISODES} says that it has rows {first[row]} to {last[row] - 1}"
        raise origin.refuse(DATA, f"row {index[row]} is of episode {episode[row]}, and {span}; {AGAIN}")
    if not meta.video_keys:
        return
    # LeRobot looks up a video's frame by its timestamp, within 1e-4 s.
    stamps, regular = columns["timestamp"], step / meta.fps
    if len(wrong := np.flatnonzero(~np.isclose(stamps, regular, rtol=1e-6, atol=1e-4))):
        row = wrong[0]
        where = f"frame {step[row]} of episode {episode[row]} has the timestamp {stamps[row]:.4f}"
        hint = f"at {meta.fps} Hz it is {regular[row]:.4f}; set timestamps to frame_index / fps"
        raise origin.refuse(DATA, f"{where}, and {hint}")


def _finite(rows: Any, name: str, origin: FileSource) -> np.ndarray:
    """A column of numbers, one for each row."""
    values = np.asarray(rows.with_format("numpy", columns=[name])[:][name])
    if values.dtype.kind not in "iuf" or not np.isfinite(values).all():
        raise origin.refuse(DATA, f"{name} has a number that is not finite; record it again")
    return values.reshape(-1)


def _files(root: Path, folder: str, origin: FileSource) -> list[Path]:
    """Files that LeRobot would read, none of which leads out of the dataset."""
    if not safe_join(root, folder, origin).is_dir():
        return []
    paths = sorted((root / folder).glob("*/*.parquet"))
    return [safe_join(root, path.relative_to(root).as_posix(), origin) for path in paths]


@contextlib.contextmanager
def _parquet(path: Path, origin: FileSource) -> Iterator[pq.ParquetFile]:
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


def _check_plain(file: pq.ParquetFile, name: str, origin: FileSource) -> None:
    """Refuses metadata that are not numbers and texts: `datasets` would open the files that others name."""
    stored = (file.schema_arrow.metadata or {}).get(b"huggingface")
    kinds: set[str] = set()
    try:
        json.loads(stored or b"{}", object_hook=lambda mapping: kinds.add(str(mapping.get("_type", "Value"))))
    except (ValueError, RecursionError) as error:
        raise origin.refuse(name, f"its description of columns is not JSON; {AGAIN}") from error
    if kinds - PLAIN:
        hint = f"columns of kind {', '.join(sorted(kinds - PLAIN))[:80]}, which name other files"
        raise origin.refuse(name, f"{hint}; numbers and texts are wanted")


def _check_episodes(file: pq.ParquetFile, frames: int, name: str, origin: FileSource) -> None:
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
