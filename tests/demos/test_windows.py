# SPDX-License-Identifier: Apache-2.0
"""A dataset's metadata is opened, or refused in one line."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from accerl_lerobot.demos.windows import open_metadata, task_texts
from accerl_lerobot.engine.config import DatasetConfig
from accerl_lerobot.errors import InputError

ROOT = Path(__file__).parents[2] / "datasets" / "metaworld_tiny"
HERE = DatasetConfig(repo_id="accerl/metaworld_tiny", root=str(ROOT))


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
