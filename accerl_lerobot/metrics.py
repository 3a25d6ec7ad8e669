# SPDX-License-Identifier: Apache-2.0
"""Where a run's numbers go: JSON lines always, TensorBoard always, wandb when asked for.

``metrics.jsonl`` has one object per line, each with ``kind`` (train, rollout, evaluation), ``wall_s`` and
``update``. ``docs/metrics.md`` explains every number.
"""

from __future__ import annotations

import json
import math
import os
import secrets
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from accerl_lerobot.checkpoint.snapshot import State
from accerl_lerobot.config.ranges import Section
from accerl_lerobot.errors import for_viewing
from accerl_lerobot.fault_points import fault_point

METRICS = "metrics.jsonl"  # name of the file in a run's folder


@dataclass(frozen=True, kw_only=True)
class WandBConfig(Section, section="wandb"):
    """Weights & Biases, off unless enabled."""

    enable: bool = False
    """Log there too; the machine must be logged in. WANDB_ENTITY names a team."""
    project: str = "accerl-lerobot"
    """Project of the run."""


class MetricsLog:
    """Appends records to files in a run's folder; `close` flushes them. wandb is given the run's config."""

    def __init__(self, directory: Path, wandb: WandBConfig, config: dict[str, Any]) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._path = directory / METRICS
        self._file = self._path.open("a", buffering=1)
        self._board = SummaryWriter(directory / "tensorboard")
        self._started = time.monotonic()
        self._wandb = None
        if wandb.enable:
            import wandb as client

            # A resumed run adds to the wandb run that it began.
            note = directory / ".wandb-id"
            if not note.is_file():
                note.write_text(secrets.token_hex(8))
            with for_viewing("record in Weights & Biases"):
                self._wandb = client.init(
                    project=wandb.project,
                    dir=str(directory),
                    name=directory.name,
                    id=note.read_text(),
                    resume="allow",
                    config=config,
                )

    @property
    def wall_s(self) -> float:
        return time.monotonic() - self._started

    def write(self, kind: str, update: int, values: dict[str, Any]) -> None:
        """Records numbers of one kind (train, rollout or evaluation), after so many updates.

        Anything else goes to the JSON lines only. NaN and infinity, which JSON does not know, become null
        there and are left out elsewhere.
        """
        finite = plain(values)
        record = {"kind": kind, "wall_s": round(self.wall_s, 3), "update": update, **finite}
        fault_point("driver.metrics")
        self._file.write(json.dumps(record) + "\n")
        scalars: dict[str, float] = {}
        for name, value in finite.items():
            if isinstance(value, (int, float)):
                scalars[name] = float(value)
        with for_viewing("record in TensorBoard"):
            for name, value in scalars.items():
                self._board.add_scalar(f"{kind}/{name}", value, update)
        if self._wandb is not None:
            named = {f"{kind}/{name}": value for name, value in scalars.items()}
            with for_viewing("record in Weights & Biases"):
                self._wandb.log(named | {"update": update})

    def state(self) -> State:
        """All that `restore` needs: how far the file goes, and the seconds."""
        self._file.flush()
        os.fsync(self._file.fileno())
        return {"bytes": self._path.stat().st_size, "wall_s": self.wall_s}

    def restore(self, state: State, update: int) -> None:
        """Resumes from `state`, after `update` updates; records that were written later are removed."""
        cut_back(self._path, state["bytes"])
        # TensorBoard forgets what older files have of this step and later ones.
        self._board.close()
        self._board = type(self._board)(self._board.log_dir, purge_step=update + 1)
        self._started = time.monotonic() - state["wall_s"]

    def close(self) -> None:
        self._file.close()
        with for_viewing("record in TensorBoard"):
            self._board.close()
        if self._wandb is not None:
            with for_viewing("record in Weights & Biases"):
                self._wandb.finish()


def cut_back(path: Path, size: int) -> None:
    """Shortens a file of lines to so many bytes; one that is shorter already to the end of its last line."""
    if path.stat().st_size < size:
        size = path.read_bytes().rfind(b"\n") + 1
    os.truncate(path, size)


def plain(value: Any) -> Any:
    """JSON types: NumPy numbers become Python's, numbers that are not finite become None."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    return value


def numbered(name: str, count: int) -> list[str]:
    """Names of `count` workers of one kind; a single worker has the name of the kind."""
    if count == 1:
        return [name]
    return [f"{name} {i}" for i in range(count)]
