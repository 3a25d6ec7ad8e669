# SPDX-License-Identifier: Apache-2.0
"""Stock ``lerobot-train`` that runs no code from outside, unpickles nothing, and checks its dataset's files.

Same arguments, same result, but that a new policy of images reads no ``observation.environment_state``, which
a real robot does not have. π0-FAST's action tokeniser, whose newest code LeRobot would fetch and run, is
read by `policies.vla` instead. ``--trust_remote_code=COMMIT`` has code from the Hub run, of this commit only.
``--policy.discover_packages_path`` goes with ``--policy.path`` too, where LeRobot 0.6.1 takes it for a field
of the policy's config.
"""

from __future__ import annotations

import contextlib
import functools
import json
import math
import sys
import traceback
from typing import Any

import torch
from torch.utils.data import Dataset

from accerl_lerobot import errors
from accerl_lerobot.config.parsing import DISCOVER, discover
from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.demos.dataset_files import checked
from accerl_lerobot.demos.sft import ANSWER, TRUST
from accerl_lerobot.experience import ENVIRONMENT_STATE
from accerl_lerobot.policies.untrusted import guarded

PACKAGE = f"--policy.{DISCOVER}="
MAX_BYTES = 4 * 1024**3
"""Datasets whose images, as float32, would take more memory than this are read the stock way."""


@functools.cache
def _column(rows: Any, key: str) -> Any:
    """The rows of a Hugging Face dataset with this column alone."""
    return rows.select_columns(key)


def query_rows(reader: Any, wanted: dict[str, list[int]]) -> dict[str, torch.Tensor]:
    """Each column's values in the rows that are wanted of it, for LeRobot's `DatasetReader`.

    LeRobot 0.6.1 decodes these rows' images to read an action chunk, here seven times as long.
    """
    row_of = reader._absolute_to_relative_idx
    found = {}
    for key in wanted.keys() - set(reader._meta.video_keys):
        rows = wanted[key]
        if row_of is not None:
            rows = [row_of[index] for index in rows]
        found[key] = torch.stack(_column(reader.hf_dataset, key)[rows][key])
    return found


class CachedDataset(Dataset[Any]):
    """A map-style LeRobotDataset whose items are remembered; everything else is the dataset's own.

    Not for datasets with random image transforms, which must differ from epoch to epoch.
    """

    def __init__(self, dataset: Any) -> None:
        self._dataset = dataset
        self._items: dict[int, dict[str, Any]] = {}

    def __len__(self) -> int:
        return len(self._dataset)

    def __getitem__(self, index: int) -> dict[str, Any]:
        if index not in self._items:
            self._items[index] = self._dataset[index]
        return dict(self._items[index])

    def __getattr__(self, name: str) -> Any:
        if name == "_dataset":  # not there yet while a loader process unpickles this object
            raise AttributeError(name)
        return getattr(self._dataset, name)


def _adapted(stock: Any) -> Any:
    """LeRobot's function that makes datasets, without a simulator's state beside the images to train on, and
    with a `CachedDataset` where that is possible."""
    from lerobot.processor import rename_stats

    def make(cfg: Any) -> tuple[Any, Any]:
        train, evaluation = stock(cfg)
        meta = train.meta
        if meta.camera_keys:
            meta.features.pop(ENVIRONMENT_STATE, None)
        # LeRobot 0.6.1 renames the dataset's features and not their statistics.
        meta.stats = rename_stats(meta.stats, cfg.rename_map)
        pixels = [math.prod(meta.features[camera]["shape"]) for camera in meta.camera_keys]
        frames = len(cfg.policy.observation_delta_indices or [0]) * len(train)
        processes = max(1, cfg.num_workers)  # each has a cache of its own
        fits = 4 * sum(pixels) * frames * processes <= MAX_BYTES
        if fits and not cfg.dataset.image_transforms.enable and not cfg.dataset.streaming:
            train = CachedDataset(train)
        return train, evaluation

    return make


def _argument(flag: str) -> str | None:
    """The value of an argument of the command line."""
    return next((text.removeprefix(flag) for text in sys.argv if text.startswith(flag)), None)


def main() -> None:
    """Run ``lerobot-train`` on the command line's arguments."""
    from lerobot.datasets.dataset_reader import DatasetReader
    from lerobot.scripts import lerobot_train

    from accerl_lerobot.policies.vla import data_only

    commit = _argument(TRUST)
    dataset = DatasetConfig(repo_id=_argument("--dataset.repo_id="), root=_argument("--dataset.root="))
    lerobot_train.make_train_eval_datasets = _adapted(lerobot_train.make_train_eval_datasets)
    DatasetReader._query_hf_dataset = query_rows
    discover(_argument(PACKAGE), "policy")
    sys.argv[1:] = [argument for argument in sys.argv[1:] if not argument.startswith((TRUST, PACKAGE))]
    answer: dict[str, Any] = {}
    errors.collect_warnings()
    tokenisers = data_only() if commit is None else contextlib.nullcontext()
    try:
        with guarded("sft", commit), checked(dataset), tokenisers:
            lerobot_train.main()
    except Exception as error:
        answer = errors.error_as_json(error)
        traceback.print_exception(error)
        sys.exit(1)
    finally:
        sys.stderr.flush()
        answer["warnings"] = errors.collected_warnings()
        sys.stdout.write(f"\n{ANSWER}{json.dumps(answer, default=str)}\n")


if __name__ == "__main__":
    main()
