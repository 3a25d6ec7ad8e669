# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Opens a LeRobotDataset's metadata and refuses, before any long work, what does not fit a world."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from accerl_lerobot.demos.dataset_files import checked
from accerl_lerobot.envs import EnvConfig, make_world
from accerl_lerobot.errors import InputError
from accerl_lerobot.safety import Origin, brief

if TYPE_CHECKING:
    from accerl_lerobot.config import DatasetConfig


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


def check_dataset(dataset: DatasetConfig, env: EnvConfig, rename_map: dict[str, str]) -> Any:
    """Compares a dataset with the world its policy will act in; returns LeRobot's metadata.

    Raises:
        InputError: a camera of the world is missing, or state or action sizes differ.
    """
    meta = open_metadata(dataset)
    world = make_world(env)
    spec = world.spec
    world.close()
    shapes = {k: tuple(f["shape"]) for k, f in meta.features.items()}
    cameras = [k for k in shapes if k.startswith("observation.images.") or k == "observation.image"]
    for key in spec.images:
        if rename_map.get(key, key) not in shapes:
            remedy = f"the dataset has {', '.join(cameras) or 'no camera'}; choose env.camera accordingly"
            raise InputError("dataset.repo_id", dataset.repo_id, f"no {rename_map.get(key, key)}: {remedy}")
    wanted = {"observation.state": (spec.state_dim,), "action": (spec.action_dim,)}
    for key, shape in wanted.items():
        if shapes.get(key) != shape:
            remedy = f"{key} has shape {shapes.get(key)} here and {shape} in the world; they must be equal"
            raise InputError("dataset.repo_id", dataset.repo_id, remedy)
    return meta


def task_texts(meta: Any) -> list[str]:
    """The dataset's instructions."""
    return [str(text) for text in meta.tasks.index]
