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
"""A dataset that does not fit the world is refused before anything is trained on it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from accerl_lerobot.config import DatasetConfig
from accerl_lerobot.demos import windows
from accerl_lerobot.demos.windows import check_dataset, open_metadata, task_texts
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError

ROOT = Path(__file__).parents[2] / "datasets" / "metaworld_tiny"
HERE = DatasetConfig(repo_id="accerl/metaworld_tiny", root=str(ROOT))
FITTING = {"observation.images.front": (32, 32, 3), "observation.state": (4,), "action": (2,)}


def pretend(monkeypatch: pytest.MonkeyPatch, shapes: dict[str, tuple[int, ...]]) -> Any:
    meta = SimpleNamespace(features={k: {"shape": list(shape)} for k, shape in shapes.items()})
    monkeypatch.setattr(windows, "open_metadata", lambda dataset: meta)
    return meta


def test_a_local_dataset_opens_offline():
    meta = open_metadata(HERE)
    assert meta.total_frames == 365
    assert task_texts(meta) == ["Open a drawer"]


def test_a_folder_without_a_dataset(tmp_path: Path):
    for root in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(InputError, match=f"^dataset.root='{root}': no meta/info.json there"):
            open_metadata(DatasetConfig(repo_id="a/b", root=str(root)))


def test_an_unknown_dataset_offline():
    with pytest.raises(InputError) as caught:
        open_metadata(DatasetConfig(repo_id="nobody/nothing"))
    assert str(caught.value).startswith(
        "dataset.repo_id='nobody/nothing': not found locally nor on the Hub ("
    )
    assert "\n" not in str(caught.value)


def test_no_name_at_all():
    with pytest.raises(InputError, match="^dataset.repo_id=None: name a LeRobotDataset"):
        open_metadata(DatasetConfig())


def test_another_format_version(tmp_path: Path):
    root = Path(shutil.copytree(ROOT, tmp_path / "old"))
    info = json.loads((root / "meta" / "info.json").read_text())
    for version in ("v1.6", "v2.1"):
        (root / "meta" / "info.json").write_text(json.dumps(info | {"codebase_version": version}))
        with pytest.raises(
            InputError, match="^dataset.repo_id='a/b': its format is not v3.0.* convert with: "
        ):
            open_metadata(DatasetConfig(repo_id="a/b", root=str(root)))


def test_a_camera_the_dataset_does_not_have():
    with pytest.raises(InputError) as caught:
        check_dataset(HERE, SimulatedConfig(), {})
    assert str(caught.value) == (
        "dataset.repo_id='accerl/metaworld_tiny': no observation.images.front: the dataset has "
        "observation.images.corner2; choose env.camera accordingly"
    )


def test_what_fits_with_and_without_renaming(monkeypatch: pytest.MonkeyPatch):
    meta = pretend(monkeypatch, FITTING)
    assert check_dataset(HERE, SimulatedConfig(), {}) is meta
    renamed = {k.replace("front", "top"): v for k, v in FITTING.items()}
    meta = pretend(monkeypatch, renamed)
    renames = {"observation.images.front": "observation.images.top"}
    assert check_dataset(HERE, SimulatedConfig(), renames) is meta
    with pytest.raises(
        InputError, match="no observation.images.front: the dataset has observation.images.top"
    ):
        check_dataset(HERE, SimulatedConfig(), {})


@pytest.mark.parametrize(
    ("key", "shape"),
    [("observation.state", (3,)), ("observation.state", None), ("action", (4,)), ("action", None)],
)
def test_other_sizes(monkeypatch: pytest.MonkeyPatch, key: str, shape: tuple[int, ...] | None):
    shapes = {k: v for k, v in (FITTING | {key: shape}).items() if v is not None}
    pretend(monkeypatch, shapes)
    with pytest.raises(InputError) as caught:
        check_dataset(HERE, SimulatedConfig(), {})
    assert f"{key} has shape {shape} here and {FITTING[key]} in the world" in str(caught.value)


def test_no_camera_at_all(monkeypatch: pytest.MonkeyPatch):
    pretend(monkeypatch, {"observation.state": (4,), "action": (2,)})
    with pytest.raises(InputError, match="the dataset has no camera"):
        check_dataset(HERE, SimulatedConfig(), {})
