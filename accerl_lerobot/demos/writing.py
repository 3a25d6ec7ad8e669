# SPDX-License-Identifier: Apache-2.0
"""A LeRobotDataset from simulated episodes: several processes simulate, the parent writes, in order."""

from __future__ import annotations

import collections
import concurrent.futures
import multiprocessing
import shutil
import signal
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from accerl_lerobot import guardian
from accerl_lerobot.errors import check_absent, expanded


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
