# SPDX-License-Identifier: Apache-2.0
"""How each episode of a dataset began, so that it can be played again: task and seed of `World.reset`."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from accerl_lerobot.checkpoint.safety import Origin, read_json, safe_join
from accerl_lerobot.seeds import EVAL_SEEDS

Start = tuple[str, int]
"""Task and seed."""

STARTS = Path("meta") / "accerl_starts.json"
"""Inside a dataset of ``accerl demos`` or ``accerl export``."""


def write_starts(root: Path, starts: Sequence[Start]) -> None:
    """Puts them beside the dataset's own metadata, in the order of its episodes."""
    (root / STARTS).write_text(json.dumps({"starts": starts}) + "\n")


def read_starts(root: Path, episodes: int, origin: Origin) -> list[Start]:
    """Reads the file of `write_starts`.

    Args:
        root: of the dataset.
        episodes: that it has.
        origin: what named it, for the error.

    Raises:
        InputError: the dataset does not say how its episodes began, or not of each.
    """
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
