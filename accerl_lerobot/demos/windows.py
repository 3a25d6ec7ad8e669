# SPDX-License-Identifier: Apache-2.0
"""Opens a LeRobotDataset's metadata."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from accerl_lerobot.checkpoint.safety import Origin, brief
from accerl_lerobot.demos.dataset_files import checked
from accerl_lerobot.errors import InputError

if TYPE_CHECKING:
    from accerl_lerobot.engine.config import DatasetConfig


def open_metadata(dataset: DatasetConfig) -> Any:
    """LeRobot's metadata of a local or Hub dataset, which is checked before LeRobot reads it.

    Raises:
        InputError: it cannot be found or read, or says what a dataset may not, see `dataset_files`.
    """
    from pathlib import Path

    from lerobot.datasets.dataset_metadata import CODEBASE_VERSION, LeRobotDatasetMetadata
    from lerobot.datasets.utils import CompatibilityError

    if dataset.repo_id is None:
        raise InputError(
            "dataset.repo_id", None, "name a LeRobotDataset; with dataset.root any label will do"
        )
    if dataset.root is not None and not (Path(dataset.root) / "meta" / "info.json").is_file():
        raise InputError(
            "dataset.root", dataset.root, "no meta/info.json there; give the folder of a LeRobotDataset v3"
        )
    try:
        with checked(origin_of(dataset), whole=dataset.root is not None):
            return LeRobotDatasetMetadata(dataset.repo_id, root=dataset.root, revision=dataset.revision)
    except InputError:
        raise
    except (CompatibilityError, NotImplementedError) as error:
        tool = f"python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id={dataset.repo_id}"
        remedy = (
            f"its format is not {CODEBASE_VERSION}, which this LeRobot reads; from v2.1 convert with: {tool}"
        )
        raise InputError("dataset.repo_id", dataset.repo_id, remedy) from error
    except (OSError, ValueError) as error:
        remedy = f"not found locally nor on the Hub ({brief(error)})"
        raise InputError("dataset.repo_id", dataset.repo_id, remedy) from error
    except Exception as error:  # LeRobot takes the files at their word, and may fail over any of it
        raise origin_of(dataset).refuse("meta", f"LeRobot cannot read it ({brief(error)})") from error


def origin_of(dataset: DatasetConfig) -> Origin:
    """The field that names a dataset's files."""
    if dataset.root is not None:
        return Origin("dataset.root", dataset.root)
    return Origin("dataset.repo_id", dataset.repo_id)


def task_texts(meta: Any) -> list[str]:
    """The dataset's instructions."""
    return [str(text) for text in meta.tasks.index]
