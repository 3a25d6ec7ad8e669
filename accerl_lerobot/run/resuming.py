# SPDX-License-Identifier: Apache-2.0
"""Resuming a run, after it was stopped or has lost its workers."""

from __future__ import annotations

import fcntl
import json
import shlex
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from accerl_lerobot.checkpoint import layout
from accerl_lerobot.checkpoint.safety import FileSource, check_folder, read_json
from accerl_lerobot.config.parsing import consent_flags, consents, read_recipe
from accerl_lerobot.config.ranges import Steps, check
from accerl_lerobot.console import Console
from accerl_lerobot.engines.config import RunConfig, decode, encode
from accerl_lerobot.engines.stopping import WorkerError, pause_s
from accerl_lerobot.errors import InputError, is_full, make_folder, reading
from accerl_lerobot.metrics import METRICS
from accerl_lerobot.replay.journal import EPISODES

LOCK = ".lock"
CHANGEABLE = (
    "resume", "output_dir", "evaluation", "launch", "wandb", "save_every_updates", "save_every_s",
    "trainer.updates", "trainer.num_threads", "trainer.ranks", "trainer.sharding",
    "trainer.activation_checkpointing", "inference", "imagination.discover_packages_path", "env.assets",
)  # fmt: skip
"""Fields and sections that may change when a run is resumed: what is learned, and from what, stays."""
WARM_START = "warm_start.json"
"""File with the path of the policy that came of a run's own demonstrations and SFT."""


def warm_started(directory: Path) -> Path | None:
    """The policy that came of a run's own demonstrations and SFT; None: there is none yet."""
    note = directory / WARM_START
    if not note.is_file():
        return None
    with reading("config_path", str(directory), WARM_START):
        return directory / str(json.loads(note.read_text())["policy"])


def resume_command(directory: Path, config: RunConfig) -> str:
    command = f"accerl train --resume=true --config_path={shlex.quote(str(directory / layout.CONFIG))}"
    return " ".join(filter(None, (command, consent_flags(consents(encode(config))))))


def resumed_run(path: Path | None, config: RunConfig) -> tuple[Path, str]:
    """The folder of the run that a config file belongs to, and the name of the checkpoint to resume from.

    `path` is ``RUN/config.yaml`` or ``RUN/checkpoints/NNNNNN/config.yaml``.

    Raises:
        InputError: the file is of no run, a setting differs that must not, or there is nothing left to do.
    """
    how = "name RUN/config.yaml or RUN/checkpoints/last/config.yaml"
    if path is None:
        raise InputError("resume", True, f"add --config_path: {how}")
    folders = path.absolute().parents
    directory, checkpoint = folders[0], layout.LAST
    if len(folders) > 2 and folders[1].name == layout.CHECKPOINTS:
        directory, checkpoint = folders[2], folders[0].name
    if not (directory / layout.CONFIG).is_file() or not (directory / LOCK).is_file():
        raise InputError("config_path", str(path), f"no run has been begun there; {how}")
    origin = FileSource("config_path", str(path))
    check_folder(directory, origin)
    before = decode(type(config), read_recipe(directory / layout.CONFIG))
    for name, (was, now) in _differences(encode(before), encode(config), "").items():
        if not any(name == free or name.startswith(f"{free}.") for free in CHANGEABLE):
            hint = f"the run was begun with {was!r}; leave it so, or begin a new run with --policy.path"
            raise InputError(name, now, hint)
    summary, checkpoints = directory / layout.SUMMARY, directory / layout.CHECKPOINTS
    newest = (checkpoints / checkpoint).resolve() == (checkpoints / layout.LAST).resolve()
    # From an earlier checkpoint there are updates left to make.
    if newest and summary.is_file():
        made: Any = read_json(summary, origin).get("updates")
        check(Steps, made, f"{summary}: updates")
        if made >= config.trainer.updates:
            hint = f"the run {directory} has made them, and has ended; ask for more"
            raise InputError("trainer.updates", config.trainer.updates, hint)
    return directory, checkpoint


class Recovery:
    """Chooses the checkpoint to resume from after a loss, unless that happens again and again."""

    def __init__(self, most: int) -> None:
        self._most, self._times, self._begun, self._furthest = most, 0, "", -1

    def next(self, checkpoints: Path, console: Console, error: WorkerError, furthest: int) -> Path:
        """The checkpoint to resume from; waits longer each time without progress in between.

        A run is not stuck whose latest update (`furthest`) is another each time, though it may be hit again
        before its next checkpoint.
        """
        try:
            path = _newest(checkpoints, layout.LAST, console)
        except InputError:
            raise error from None
        stuck = path.name == self._begun and furthest <= self._furthest
        self._times = self._times + 1 if stuck else 1
        self._begun, self._furthest = path.name, max(furthest, self._furthest)
        if self._times > self._most:
            raise error
        pause = pause_s(self._times - 1)
        when = f" in {pause:.0f} s" if pause else ""
        reason = f"the disk of {checkpoints.parent} is full" if is_full(error) else error
        console.say(f"{reason}\ngoing on from {path}{when} ({self._times} of {self._most} times)")
        time.sleep(pause)
        return path


def checkpoint_of(directory: Path, wanted: str, console: Console) -> Path | None:
    """The checkpoint to resume from; None if there is none yet."""
    if not layout.has_checkpoint(directory / layout.CHECKPOINTS):
        console.say("there is no checkpoint yet: what is kept are demonstrations and SFT, if complete")
        for name in (METRICS, EPISODES):
            (directory / name).unlink(missing_ok=True)
        shutil.rmtree(directory / "tensorboard", ignore_errors=True)
        return None
    return _newest(directory / layout.CHECKPOINTS, wanted, console)


def _newest(checkpoints: Path, wanted: str, console: Console) -> Path:
    path, passed = layout.newest_whole(checkpoints, wanted)
    for why in passed:
        console.say(f"passed over checkpoint {why}")
    return path


def continued(config: RunConfig, directory: Path, checkpoint: Path) -> RunConfig:
    if config.policy.tuning.mode != "lora":
        return improving(config, checkpoint / layout.PRETRAINED)
    # A checkpoint has low-rank adapters merged; apart from what they adapt they are in the training state.
    path = config.policy.path
    if path is None and (warm := warm_started(directory)) is not None:
        path = str(warm)
    # A folder of this machine has to be there; a Hub id is taken at its word.
    on_the_hub = path and not path.startswith((".", "/", "~", f"{layout.AWAY}/")) and path.count("/") <= 1
    if path is None or not (on_the_hub or Path(path).expanduser().is_dir()):
        hint = "the policy that this run began from is gone, and its low-rank adapters are of no other; "
        hint += f"put it back, or begin a new run with --policy.path={checkpoint / layout.PRETRAINED}"
        raise InputError("policy.path", path, hint)
    return improving(config, path)


def improving(config: RunConfig, path: Path | str) -> RunConfig:
    """The run as one that improves a checkpoint."""
    return replace(config, policy=replace(config.policy, path=str(path)), sft=replace(config.sft, steps=0))


def _differences(before: Any, now: Any, name: str) -> dict[str, tuple[Any, Any]]:
    """Dotted field → old and new value, where they differ."""
    if not (isinstance(before, dict) and isinstance(now, dict)):
        return {} if before == now else {name: (before, now)}
    below = ((f"{name}.{key}" if name else key, key) for key in before.keys() | now.keys())
    parts = (_differences(before.get(key), now.get(key), dotted) for dotted, key in below)
    return {dotted: change for part in parts for dotted, change in part.items()}


@contextmanager
def locked(directory: Path, field: str, in_use: str) -> Iterator[int]:
    """Keep other processes out of a folder, which is made if need be.

    Gives a file descriptor to hand to child processes that are to keep it locked. If another process has
    locked it, the error names `field`, and `in_use` as the hint.
    """
    make_folder(directory, field, again=True)
    with (directory / LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise InputError(field, str(directory), in_use) from error
        yield file.fileno()
