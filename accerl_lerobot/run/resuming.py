# SPDX-License-Identifier: Apache-2.0
"""Resuming a run, after it was stopped or has lost its workers."""

from __future__ import annotations

import fcntl
import json
import shlex
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from accerl_lerobot.checkpoint import layout
from accerl_lerobot.checkpoint.safety import FileSource, check_folder, read_json
from accerl_lerobot.config.parsing import consent_flags, consents, read_recipe
from accerl_lerobot.console import Console
from accerl_lerobot.engines.config import RunConfig, decode, encode
from accerl_lerobot.errors import InputError
from accerl_lerobot.metrics import METRICS
from accerl_lerobot.replay.journal import EPISODES

LOCK = ".lock"
CHANGEABLE = (
    "resume", "output_dir", "evaluation", "launch.address", "launch.placement", "launch.schedule",
    "launch.stall_s", "launch.max_restarts", "wandb", "save_every_updates", "save_every_s", "trainer.updates",
    "trainer.num_threads", "trainer.ranks", "trainer.sharding", "trainer.activation_checkpointing",
    "inference", "env.assets", "policy.device", "imagination.discover_packages_path", "imagination.path",
    "imagination.learn.dataset", "world_model.path", "rollout.reward_model.path",
)  # fmt: skip
"""Fields and sections that may change when a run is resumed: what is learned, and from what, stays. Another
machine may have another device, and files elsewhere."""
WARM_START = "warm_start.json"
"""File with the path of the policy that came of a run's own demonstrations and SFT."""


def warm_started(directory: Path) -> Path:
    """The policy that came of a run's own demonstrations and SFT."""
    content = json.loads((directory / WARM_START).read_text())
    return directory / str(content["policy"])


def resume_command(directory: Path, config: RunConfig) -> str:
    """The command line that resumes a run."""
    recipe = shlex.quote(str(directory / layout.CONFIG))
    command = f"accerl train --resume=true --config_path={recipe}"
    flags = consent_flags(consents(encode(config)))
    return f"{command} {flags}" if flags else command


def resumed_run(path: Path | None, config: RunConfig) -> tuple[Path, str]:
    """The folder of the run that a config file belongs to, and the name of the checkpoint to resume from.

    `path` is ``RUN/config.yaml`` or ``RUN/checkpoints/NNNNNN/config.yaml``.

    Raises:
        InputError: the file is of no run, a setting differs that must not, or there is nothing left to do.
    """
    how = "name RUN/config.yaml or RUN/checkpoints/last/config.yaml"
    if path is None:
        raise InputError("resume", True, f"add --config_path: {how}")
    directory = path.absolute().parent
    checkpoint = layout.LAST
    if directory.parent.name == layout.CHECKPOINTS:
        checkpoint = directory.name
        directory = directory.parent.parent
    if not all((directory / name).is_file() for name in (layout.CONFIG, LOCK)):
        raise InputError("config_path", str(path), f"no run has been begun there; {how}")
    source = FileSource("config_path", str(path))
    check_folder(directory, source)
    former = decode(type(config), read_recipe(directory / layout.CONFIG))
    _check_unchanged(encode(former), encode(config))
    checkpoints = directory / layout.CHECKPOINTS
    newest = (checkpoints / checkpoint).resolve() == (checkpoints / layout.LAST).resolve()
    summary = directory / layout.SUMMARY
    # From an earlier checkpoint there are updates left to make.
    if newest and summary.is_file():
        made = read_json(summary, source)["updates"]
        if made >= config.trainer.updates:
            hint = f"the run {directory} has made them, and has ended; ask for more"
            raise InputError("trainer.updates", config.trainer.updates, hint)
    return directory, checkpoint


def checkpoint_of(directory: Path, resume_from: str, console: Console) -> Path | None:
    """The checkpoint to resume from; None if there is none yet."""
    if layout.has_checkpoint(directory / layout.CHECKPOINTS):
        return newest_checkpoint(directory, resume_from, console)
    console.say("there is no checkpoint yet: what is kept are demonstrations and SFT, if complete")
    for name in (METRICS, EPISODES):
        (directory / name).unlink(missing_ok=True)
    shutil.rmtree(directory / "tensorboard", ignore_errors=True)
    return None


def newest_checkpoint(directory: Path, resume_from: str, console: Console) -> Path:
    """The checkpoint of this name, or the newest one before it whose files are as they were written."""
    path, passed = layout.newest_whole(directory / layout.CHECKPOINTS, resume_from)
    for why in passed:
        console.say(f"passed over checkpoint {why}")
    return path


def continued(config: RunConfig, directory: Path, checkpoint: Path) -> RunConfig:
    """The run as one that goes on from a checkpoint."""
    if config.policy.tuning.mode != "lora":
        return improving(config, checkpoint / layout.PRETRAINED)
    # A checkpoint has low-rank adapters merged; apart from what they adapt they are in the training state.
    path = Path(config.policy.path or warm_started(directory))
    if path.is_absolute() and not path.exists():
        hint = "the policy that this run began from is gone, and its low-rank adapters are of no other; "
        hint += f"put it back, or begin a new run with --policy.path={checkpoint / layout.PRETRAINED}"
        raise InputError("policy.path", str(path), hint)
    return improving(config, path)


def improving(config: RunConfig, path: Path | str) -> RunConfig:
    """The run as one that improves a checkpoint."""
    policy = replace(config.policy, path=str(path))
    return replace(config, policy=policy, sft=replace(config.sft, steps=0))


def _check_unchanged(before: Any, now: Any, name: str = "") -> None:
    """Refuse a field that differs from the run's and is not in `CHANGEABLE`; `name` is its dotted name."""
    if name in CHANGEABLE or before == now:
        return
    if not (isinstance(before, dict) and isinstance(now, dict)):
        hint = f"the run was begun with {before!r}; leave it so, or begin a new run with --policy.path"
        raise InputError(name, now, hint)
    for key in sorted(before.keys() | now.keys()):
        inner = f"{name}.{key}" if name else key
        _check_unchanged(before.get(key), now.get(key), inner)


@contextmanager
def locked(directory: Path) -> Iterator[None]:
    """Keep other processes out of a run's folder."""
    with (directory / LOCK).open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise InputError("config_path", str(directory), "another process resumes it") from error
        yield
