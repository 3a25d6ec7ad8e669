# SPDX-License-Identifier: Apache-2.0
"""Hostile files of a dataset; labels and instructions of its episodes, which all verbs read by one reader."""

import io
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from PIL import Image

from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.demos.dataset_files import (
    EpisodeLabels,
    checked,
    numbers,
    observations,
    open_metadata,
    opened,
    read_labels,
    step_of_reward,
    task_texts,
)
from accerl_lerobot.demos.sft import picked
from accerl_lerobot.errors import InputError
from accerl_lerobot.run.adapter import recorded
from accerl_lerobot.world_model.contract import WorldModelSpec, load_episodes
from tests.tiny_datasets import ACTION, FPS, FRONT, IMAGE, STATE, STEPS, labels, rewrite, write_dataset

ROOT = Path(__file__).parents[2] / "datasets" / "metaworld_tiny"
CAMERA = "observation.images.corner2"
PNG = b"\x89PNG\r\n\x1a\n"
EPISODES, DATA = "meta/episodes/chunk-000/file-000.parquet", "data/chunk-000/file-000.parquet"


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    return Path(shutil.copytree(ROOT, tmp_path / "dataset"))


def edit(root: Path, **changes: Any) -> None:
    file = root / "meta/info.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def refused(root: Path, why: str) -> None:
    """By the very call that every verb makes; LeRobot must not have read a byte of it."""
    with pytest.raises(InputError, match=f"^dataset.root='.*': .*{why}") as caught:
        open_metadata(DatasetConfig(repo_id="a/b", root=str(root)))
    assert "\n" not in str(caught.value)


def test_a_column_has_the_shape_of_its_feature(tmp_path: Path):
    """Also a single number, which LeRobot stores without a dimension."""
    dataset = write_dataset(tmp_path / "data", more={"observation.force": labels("float32")})
    with opened(dataset, open_metadata(dataset)) as data:
        for name, size in ((STATE, 4), ("observation.force", 1)):
            assert numbers(data, name, dataset).shape == (2 * STEPS, size)


def test_datasets_that_are_not_there(tmp_path: Path):
    for root in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(InputError, match=f"^dataset.root='{root}': no meta/info.json there"):
            open_metadata(DatasetConfig(repo_id="a/b", root=str(root)))
    with pytest.raises(InputError, match="^dataset.repo_id=None: name a LeRobotDataset"):
        open_metadata(DatasetConfig())
    with pytest.raises(InputError, match=r"^dataset.repo_id='nobody/nothing': LeRobot cannot read it \("):
        open_metadata(DatasetConfig(repo_id="nobody/nothing"))


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"data_path": "../../{chunk_index}/{file_index}.parquet"}, "meta/info.json: data_path: "),
        ({"data_path": "{chunk_index:999999999}"}, "meta/info.json: data_path: "),
        ({"data_path": "{chunk_index"}, "meta/info.json: data_path: "),
        ({"video_path": "{video_key[0]}"}, "meta/info.json: video_path: "),
        ({"chunks_size": 0}, "chunks_size must be positive"),
        ({"features": {"../../x": {"dtype": "float32", "shape": [4]}}}, "cannot be part of a path"),
        ({"total_episodes": 0, "total_tasks": 0}, "it has no episodes, or no tasks"),
        ({"codebase_version": "v2.1"}, "its format is not v3.0.* convert with: "),
    ],
)
def test_what_info_may_say(copied: Path, changes: dict[str, Any], why: str):
    edit(copied, **changes)
    refused(copied, why)


def test_columns_that_would_open_other_files(copied: Path, tmp_path: Path):
    """`datasets` makes an image of a text in the metadata, where the file says that it is one."""
    picture = tmp_path / "secret.png"
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(picture)
    described = {"info": {"features": {"robot": {"_type": "Image"}}}}

    def change(table: pa.Table) -> pa.Table:
        table = table.append_column("robot", pa.array([str(picture)] * len(table)))
        for name in table.schema.names:
            if name != "robot":
                described["info"]["features"][name] = {"_type": "Value", "dtype": "int64"}
        return table.replace_schema_metadata({"huggingface": json.dumps(described)})

    rewrite(copied / EPISODES, change)
    refused(copied, "columns of kind Image; numbers and texts are wanted")


def postscript() -> bytes:
    file = io.BytesIO()
    Image.new("RGB", (64, 64)).save(file, "EPS")
    return file.getvalue()


@pytest.mark.parametrize(
    ("content", "path"),
    [
        (None, "/etc/hostname"),
        (None, "http://127.0.0.1:9/x.png"),
        (postscript(), None),  # Pillow would have Ghostscript draw it
        (PNG, "/etc/hostname"),
    ],
)
def test_images_lie_in_their_rows(copied: Path, content: bytes | None, path: str | None):
    def change(table: pa.Table) -> pa.Table:
        rows = [{"bytes": content, "path": path}, *table.column(CAMERA).to_pylist()[1:]]
        kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
        return table.set_column(table.schema.get_field_index(CAMERA), CAMERA, pa.array(rows, kind))

    rewrite(copied / DATA, change)
    dataset = DatasetConfig(repo_id="a/b", root=str(copied))
    refusal = "an image whose row does not hold it as PNG, JPEG or TIFF"
    with pytest.raises(InputError, match=f"^dataset.root='.*': data: {refusal}"), checked(dataset):
        LeRobotDataset("a/b", root=copied, video_backend="pyav")[0]


@pytest.mark.parametrize("part", ["meta/info.json", "data/chunk-000", "videos"])
def test_links_out_of_the_folder(copied: Path, tmp_path: Path, part: str):
    outside = tmp_path / "outside"
    outside.mkdir()
    if (copied / part).exists():
        outside = (copied / part).rename(outside / "it")
    (copied / part).symlink_to(outside)
    refused(copied, "a link that leads out of the folder")


def test_an_error_of_lerobot_s_is_one_line(tmp_path: Path):
    dataset = write_dataset(tmp_path / "data")
    meta = open_metadata(dataset)
    (tmp_path / "data" / DATA).write_bytes(b"PAR1 of something else")
    with pytest.raises(InputError, match=r"^dataset.root='.*': LeRobot cannot read it \(") as caught:
        opened(dataset, meta).__enter__()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("part", ["meta/tasks.parquet", EPISODES, DATA])
def test_a_local_dataset_is_not_completed_from_the_hub(copied: Path, part: str, monkeypatch: Any):
    from lerobot.datasets import lerobot_dataset

    monkeypatch.setattr(lerobot_dataset, "get_safe_version", None)  # it would ask the Hub for the label
    (copied / part).unlink()
    dataset = DatasetConfig(repo_id="a/b", root=str(copied))
    with pytest.raises(InputError, match="^dataset.root='.*': .*give the whole folder"):
        opened(dataset, open_metadata(dataset)).__enter__()


def test_one_from_the_hub_is_checked_as_well(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Checked right after it was fetched, before LeRobot reads it."""
    from lerobot.datasets import dataset_metadata

    fetched = Path(shutil.copytree(ROOT, tmp_path / "fetched"))
    edit(fetched, data_path="../../{chunk_index}")
    monkeypatch.setattr(dataset_metadata, "HF_LEROBOT_HOME", tmp_path / "home")
    monkeypatch.setattr(dataset_metadata, "get_safe_version", lambda *_: "v3.0")
    monkeypatch.setattr(dataset_metadata, "snapshot_download", lambda *_, **__: str(fetched))
    with pytest.raises(InputError, match="^dataset.repo_id='them/data': meta/info.json: data_path: "):
        open_metadata(DatasetConfig(repo_id="them/data"))


def test_tasks_are_found_by_their_indices(tmp_path: Path):
    """LeRobot takes them from the rows of their table, whose order no file promises."""
    dataset = write_dataset(tmp_path / "data", tasks=("open", "close"))
    rewrite(tmp_path / "data/meta/tasks.parquet", lambda table: table.take([1, 0]))
    meta = open_metadata(dataset)
    assert task_texts(meta) == ["open", "close"]
    with opened(dataset, meta) as data:
        assert (data[0]["task"], data[STEPS]["task"]) == ("open", "close")


def test_depth_is_decoded(tmp_path: Path):
    depth = {"dtype": "image", "shape": (8, 8, 1), "names": None, "info": {"is_depth_map": True}}
    values = {"observation.images.depth": np.full((8, 8, 1), 700)}
    dataset = write_dataset(
        tmp_path / "data", more={"observation.images.depth": depth}, values=lambda name, *_: values.get(name)
    )
    with opened(dataset, open_metadata(dataset)) as data:
        assert data[0]["observation.images.depth"].unique().tolist() == [700]


SUCCESS, REWARD = "next.success", "next.reward"


@pytest.mark.parametrize(
    ("rewards", "step"),
    [
        ([0, 0, 0, 1], 3),
        ([0, 0, 5, 5], 2),
        ([-0.1, 10, -0.1, -0.1], 1),
        ([-3, -2, -1, 0], -1),
        ([0.1, 0.2, 0.3, 0.4], None),  # dense: no step tells success
        ([1, 1, 1, 1], None),  # a reward for being alive
        ([0, 0.1, 0.5, 0.9], None),
        ([0, 1, 0, 1], None),
    ],
)
def test_a_reward_tells_success_where_it_is_sparse(rewards: list[float], step: int | None):
    assert step_of_reward(np.array(rewards)) == step


def read(dataset: DatasetConfig, one_task: bool = True) -> list[EpisodeLabels]:
    with opened(dataset, open_metadata(dataset)) as data:
        return read_labels(data, dataset, one_task)


def outcomes(dataset: DatasetConfig) -> dict[str, list[bool]]:
    """Which episodes are successes, by each verb that reads labels."""
    shapes = {STATE: (4,), ACTION: (2,)}
    segments = recorded(dataset, open_metadata(dataset), shapes, STEPS, 1000, 1, time_limit=100)
    spec = WorldModelSpec(cameras=(FRONT,), image_size=(32, 32), state_dim=4, action_dim=2, chunk=2, fps=FPS)
    episodes = load_episodes(dataset, spec)
    chosen = picked(dataset, "successes") or []
    return {
        "memory": [segment.success for segment in segments],
        "world model": [episode.success for episode in episodes],
        "pick": [index in chosen for index in range(len(episodes))],
    }


@pytest.mark.parametrize(
    ("name", "dtype", "values"),
    [
        (SUCCESS, "bool", [[0, 0, 0, 0, 1, 1], [0] * 6, [1] * 6]),
        (SUCCESS, "int64", [[0, 0, 1, 0, 0, 0], [0] * 6, [1] * 6]),
        (SUCCESS, "float32", [[0, 0, 0, 0, 0, 1], [0] * 6, [1] * 6]),
        (REWARD, "float32", [[0, 0, 0, 0, 0, 1], [0, -1, 0, 0, 0, 0], [0, 0, 0, 2, 2, 2]]),
    ],
)
def test_all_verbs_read_a_label_in_the_same_way(tmp_path: Path, name: str, dtype: str, values: Any):
    dataset = write_dataset(
        tmp_path / "data", ("go",) * 3, {FRONT: IMAGE, name: labels(dtype)},
        lambda feature, episode, step: [values[episode][step]] if feature == name else None,
    )  # fmt: skip
    assert outcomes(dataset) == dict.fromkeys(("memory", "world model", "pick"), [True, False, True])


@pytest.mark.parametrize(
    ("name", "value", "why"),
    [
        (REWARD, lambda step: 0.1 * step, "above 0 at steps that do not end it.*label the episodes"),
        (REWARD, lambda step: np.nan, "a number that is not finite in episode 0"),
    ],
)
def test_labels_that_tell_no_success_are_refused(tmp_path: Path, name: str, value: Any, why: str):
    dataset = write_dataset(
        tmp_path / "data", more={name: labels("float32")},
        values=lambda feature, episode, step: [value(step)] if feature == name else None,
    )  # fmt: skip
    for verb in (lambda: read(dataset), lambda: picked(dataset, "successes")):
        with pytest.raises(InputError, match=f"^dataset.root=.*{why}"):
            verb()


def test_an_instruction_that_changes_is_refused_where_one_is_read(tmp_path: Path):
    dataset = write_dataset(tmp_path / "data", ("go", ["go"] * 3 + ["stop"] * 3))
    assert [episode.tasks for episode in read(dataset, one_task=False)] == [("go",), ("go", "stop")]
    with pytest.raises(InputError, match="episode 1: its instruction changes from 'go' to 'stop'"):
        read(dataset)
    with opened(dataset, open_metadata(dataset)) as data:  # SFT reads it where it stands
        assert [data[i]["task"] for i in (STEPS + 2, STEPS + 3)] == ["go", "stop"]


def test_frames_are_kept_as_bytes():
    frames = [{CAMERA: torch.full((3, 2, 4), row / 255)} for row in range(5)]
    found = observations(frames, np.arange(5), {"action": np.arange(9)}, [CAMERA])
    assert found["action"].tolist() == list(range(5))
    assert found[CAMERA].shape == (5, 2, 4, 3) and found[CAMERA].dtype == np.uint8
    assert found[CAMERA][:, 0, 0, 0].tolist() == list(range(5))
