# SPDX-License-Identifier: Apache-2.0
"""A LeRobotDataset from simulated episodes: several processes simulate, the parent writes, in order."""

from __future__ import annotations

import collections
import concurrent.futures
import json
import multiprocessing
import shutil
import signal
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from accerl_lerobot import guardian
from accerl_lerobot.checkpoint.safety import Origin, read_json, safe_join
from accerl_lerobot.errors import check_absent, expanded
from accerl_lerobot.seeds import EVAL_SEEDS

Start = tuple[str, int]
"""Task and seed of `World.reset`."""

STARTS = Path("meta") / "accerl_starts.json"
"""Inside a dataset of ``accerl demos`` or ``accerl export``."""


def check_free(root: str, prefix: str = "") -> Path:
    """The folder of a dataset that is to be written; an existing one is refused."""
    folder = expanded(root, f"{prefix}root")
    check_absent(folder, f"{prefix}root")
    return folder


@contextmanager
def appearing(root: Path) -> Iterator[Path]:
    """A folder to be filled, which becomes `root` when the context is left, or goes if there was an error."""
    partial = root.with_name(f"{root.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    guardian.remove(partial)
    try:
        yield partial
        partial.rename(root)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise


@contextmanager
def simulators(
    processes: int, start: Callable[..., None], *arguments: Any
) -> Iterator[concurrent.futures.ProcessPoolExecutor]:
    """So many processes, each made ready by `start`; an error inside ends them at once."""
    context = multiprocessing.get_context("spawn")
    before = set(multiprocessing.active_children())
    with concurrent.futures.ProcessPoolExecutor(
        processes, context, initializer=_ready, initargs=(start, *arguments)
    ) as pool:
        try:
            yield pool
        except BaseException:
            for process in set(multiprocessing.active_children()) - before:
                process.kill()
            raise


def _ready(start: Callable[..., None], *arguments: Any) -> None:
    """Makes a process ready; Ctrl-C on the terminal is for its parent, which ends it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    start(*arguments)


def in_order[Item, Result](
    pool: concurrent.futures.Executor, work: Callable[[Item], Result], items: Iterable[Item], ahead: int
) -> Iterator[Result]:
    """Results of `work`, in the order of `items`, with at most `ahead` finished ones waiting in memory.

    The first are already under way when this returns.
    """
    left = iter(items)
    waiting = collections.deque(pool.submit(work, item) for _, item in zip(range(ahead), left, strict=False))
    return _drained(pool, work, left, waiting)


def _drained[Item, Result](
    pool: concurrent.futures.Executor,
    work: Callable[[Item], Result],
    left: Iterator[Item],
    waiting: collections.deque[concurrent.futures.Future[Result]],
) -> Iterator[Result]:
    while waiting:
        result = waiting.popleft().result()
        for item in left:
            waiting.append(pool.submit(work, item))
            break
        yield result


@contextmanager
def new_dataset(
    root: Path, repo_id: str, fps: int, robot_type: str, features: dict[str, Any]
) -> Iterator[Any]:
    """A LeRobotDataset to be filled; complete when the context has been left."""
    from datasets.utils.logging import disable_progress_bar
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    disable_progress_bar()  # one per episode would bury ours
    dataset = LeRobotDataset.create(
        repo_id,
        fps=fps,
        features=features,
        root=root,
        robot_type=robot_type,
        use_videos=False,
        video_backend="pyav",  # unused, but the default probes for FFmpeg and complains at length
    )
    yield dataset
    dataset.finalize()
    # The pictures are inside the parquet files; LeRobot leaves the folders they were collected in.
    shutil.rmtree(root / "images", ignore_errors=True)


def write_starts(root: Path, starts: Sequence[Start]) -> None:
    """Writes, in order, how each episode of a dataset began, so that it can be played again."""
    (root / STARTS).write_text(json.dumps({"starts": starts}) + "\n")


def read_starts(root: Path, episodes: int, origin: Origin) -> list[Start]:
    """Reads the file of `write_starts`; one that does not have all `episodes` is refused."""
    path = safe_join(root, STARTS.as_posix(), origin)
    if not path.is_file():
        remedy = "is missing: nobody knows how its episodes began; record it with accerl demos or export"
        raise origin.refuse(STARTS.as_posix(), remedy)
    starts = read_json(path, origin).get("starts")
    if not isinstance(starts, list) or len(starts) != episodes or not all(map(_is_start, starts)):
        raise origin.refuse(STARTS.as_posix(), f"{episodes} pairs of a task and a seed are wanted")
    return [(task, seed) for task, seed in starts]


def _is_start(value: object) -> bool:
    if not isinstance(value, list) or len(value) != 2 or not isinstance(value[0], str):
        return False
    return type(value[1]) is int and 0 <= value[1] < EVAL_SEEDS.stop
