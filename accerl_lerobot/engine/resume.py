# SPDX-License-Identifier: Apache-2.0
"""Which run is gone on with, and whether it may be."""

from __future__ import annotations

import fcntl
import shlex
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from accerl_lerobot.checkpoint.layout import CHECKPOINTS, CONFIG, LAST, SUMMARY
from accerl_lerobot.checkpoint.safety import Origin, check_folder, check_number, read_json
from accerl_lerobot.config.parsing import CONSENT, decode, read_recipe
from accerl_lerobot.engine.config import RunConfig, encode
from accerl_lerobot.engine.stopping import StoppedError, Stopping
from accerl_lerobot.errors import InputError, make_folder

LOCK = ".lock"
CHANGEABLE = (
    "resume", "output_dir", "evaluation", "launch", "wandb", "save_every_updates", "save_every_s",
    "save_keep", "trainer.updates", "trainer.num_threads", "trainer.ranks", "trainer.sharding",
    "trainer.cpu_offload", "trainer.activation_checkpointing", "trainer.rank_timeout_s",
    "rollout.max_restarts", "inference", "imagination.record",
    "imagination.discover_packages_path",
)  # fmt: skip
"""Fields, and rooms, that may be other than before: what is learnt, and from what, is the same."""


def how_to_go_on(directory: Path) -> str:
    """The command that goes on with a run."""
    return f"accerl train --resume=true --config_path={shlex.quote(str(directory / CONFIG))}"


def heed_stop(stop: Stopping, directory: Path) -> None:
    """Ends a run that was asked to stop.

    Raises:
        StoppedError: it was.
    """
    if stop.asked is not None:
        words = f"stopped by {signal.Signals(stop.asked).name}; to go on: {how_to_go_on(directory)}"
        raise StoppedError(stop.asked, words)


class Begun(NamedTuple):
    """A run that was begun before."""

    directory: Path
    checkpoint: str
    """Which one to go on from: ``last``, or a number."""


def begun_run(path: Path | None, config: RunConfig) -> Begun:
    """The run that a config file belongs to.

    Args:
        path: ``--config_path``: ``RUN/config.yaml`` or ``RUN/checkpoints/NNNNNN/config.yaml``.
        config: the run as it is to go on.

    Raises:
        InputError: the file is of no run, a setting differs that must not, or there is nothing left to do.
    """
    how = "name RUN/config.yaml or RUN/checkpoints/last/config.yaml"
    if path is None:
        raise InputError("resume", True, f"add --config_path: {how}")
    folders = path.absolute().parents
    directory, checkpoint = folders[0], LAST
    if len(folders) > 2 and folders[1].name == CHECKPOINTS:
        directory, checkpoint = folders[2], folders[0].name
    if not (directory / CONFIG).is_file() or not (directory / LOCK).is_file():
        raise InputError("config_path", str(path), f"no run has been begun there; {how}")
    origin = Origin("config_path", str(path))
    check_folder(directory, origin)
    before: RunConfig = decode(RunConfig, read_recipe(directory / CONFIG))
    for name, (was, now) in _differences(encode(before), encode(config), "").items():
        if not was and name.rpartition(".")[2] in CONSENT:
            continue  # a pull has dropped it, and the command line allows it anew
        if not any(name == free or name.startswith(f"{free}.") for free in CHANGEABLE):
            remedy = f"the run was begun with {was!r}; leave it so, or begin a new run with --policy.path"
            raise InputError(name, now, remedy)
    summary, checkpoints = directory / SUMMARY, directory / CHECKPOINTS
    newest = (checkpoints / checkpoint).resolve() == (checkpoints / LAST).resolve()
    # From an earlier checkpoint there are updates left to make.
    if newest and summary.is_file():
        made: Any = read_json(summary, origin).get("updates")
        check_number(made, 0, 1e9, f"{SUMMARY}: updates", origin)
        if made >= config.trainer.updates:
            remedy = f"the run {directory} has made them, and has ended; ask for more"
            raise InputError("trainer.updates", config.trainer.updates, remedy)
    return Begun(directory, checkpoint)


def _differences(before: Any, now: Any, name: str) -> dict[str, tuple[Any, Any]]:
    """Dotted field → what it was and is, where they differ."""
    if not (isinstance(before, dict) and isinstance(now, dict)):
        return {} if before == now else {name: (before, now)}
    found: dict[str, tuple[Any, Any]] = {}
    for key in before.keys() | now.keys():
        found |= _differences(before.get(key), now.get(key), f"{name}.{key}" if name else str(key))
    return found


@contextmanager
def locked(directory: Path, field: str, in_use: str) -> Iterator[int]:
    """Keeps other processes out of a folder, which is made if need be, while one that was told so is alive.

    Args:
        directory: the folder.
        field: that it was given by,
        in_use: and what to say if it is in use.

    Returns:
        A file descriptor to hand to child processes that are to keep it locked.

    Raises:
        InputError: it is in use.
    """
    make_folder(directory, field, again=True)
    with (directory / LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise InputError(field, str(directory), in_use) from error
        yield file.fileno()
