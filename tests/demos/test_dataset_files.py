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
from lerobot.datasets import dataset_metadata, lerobot_dataset
from PIL import Image

from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.demos.dataset_files import checked, open_metadata, opened, read_labels, task_texts
from accerl_lerobot.demos.sft import picked
from accerl_lerobot.errors import InputError
from accerl_lerobot.run.adapter import recorded
from accerl_lerobot.world_model.contract import WorldModelSpec, load_episodes
from tests.tiny_datasets import ACTION, FPS, FRONT, IMAGE, STATE, STEPS, labels, rewrite, write_dataset

ROOT = Path(__file__).parents[2] / "datasets" / "metaworld_tiny"
CAMERA, FORCE, REWARD = "observation.images.corner2", "observation.force", "next.reward"
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


def test_datasets_that_are_not_there(tmp_path: Path):
    for root in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(InputError, match=f"^dataset.root='{root}': no meta/info.json there"):
            open_metadata(DatasetConfig(repo_id="a/b", root=str(root)))
    for name, said in ((None, "None: name a LeRobotDataset"), ("a/b", r"'a/b': LeRobot cannot read it \(")):
        with pytest.raises(InputError, match=f"^dataset.repo_id={said}"):
            open_metadata(DatasetConfig(repo_id=name))


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

    def change(table: pa.Table) -> pa.Table:
        features = dict.fromkeys(table.schema.names, {"_type": "Value", "dtype": "int64"})
        features["robot"] = {"_type": "Image"}
        table = table.append_column("robot", pa.array([str(picture)] * len(table)))
        return table.replace_schema_metadata({"huggingface": json.dumps({"info": {"features": features}})})

    rewrite(copied / EPISODES, change)
    refused(copied, "columns of kind Image; numbers and texts are wanted")


POSTSCRIPT = io.BytesIO()  # Pillow would have Ghostscript draw it
Image.new("RGB", (64, 64)).save(POSTSCRIPT, "EPS")


@pytest.mark.parametrize(
    ("content", "path"),
    [
        (None, "/etc/hostname"),
        (None, "http://127.0.0.1:9/x.png"),
        (POSTSCRIPT.getvalue(), None),
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
        lerobot_dataset.LeRobotDataset("a/b", root=copied, video_backend="pyav")[0]


@pytest.mark.parametrize("part", ["meta/info.json", "data/chunk-000", "videos"])
def test_links_out_of_the_folder(copied: Path, tmp_path: Path, part: str):
    outside = tmp_path / "outside"
    outside.mkdir()
    if (copied / part).exists():
        outside = (copied / part).rename(outside / "it")
    (copied / part).symlink_to(outside)
    refused(copied, "a link that leads out of the folder")


@pytest.mark.parametrize(
    ("part", "content", "why"),
    [
        ("meta/tasks.parquet", b"", ".*give the whole folder"),
        (EPISODES, b"", ".*give the whole folder"),
        (DATA, b"", ".*give the whole folder"),
        (DATA, b"PAR1 of something else", r"LeRobot cannot read it \("),
    ],
)
def test_a_local_dataset_is_whole(copied: Path, part: str, content: bytes, why: str, monkeypatch: Any):
    """What it lacks is not fetched from the Hub."""
    monkeypatch.setattr(lerobot_dataset, "get_safe_version", None)  # it would ask the Hub for the label
    (copied / part).write_bytes(content) if content else (copied / part).unlink()
    dataset = DatasetConfig(repo_id="a/b", root=str(copied))
    with pytest.raises(InputError, match=f"^dataset.root='.*': {why}") as caught:
        opened(dataset, open_metadata(dataset)).__enter__()
    assert "\n" not in str(caught.value)


def test_one_from_the_hub_is_checked_as_well(copied: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Checked right after it was fetched, before LeRobot reads it."""
    edit(copied, data_path="../../{chunk_index}")
    monkeypatch.setattr(dataset_metadata, "HF_LEROBOT_HOME", tmp_path / "home")
    monkeypatch.setattr(dataset_metadata, "get_safe_version", lambda *_: "v3.0")
    monkeypatch.setattr(dataset_metadata, "snapshot_download", lambda *_, **__: str(copied))
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
    name = "observation.images.depth"
    depth = {"dtype": "image", "shape": (8, 8, 1), "names": None, "info": {"is_depth_map": True}}
    values = {name: np.full((8, 8, 1), 700)}
    dataset = write_dataset(tmp_path / "data", more={name: depth}, values=lambda name, *_: values.get(name))
    with opened(dataset, open_metadata(dataset)) as data:
        assert data[0][name].unique().tolist() == [700]


def test_all_verbs_read_a_label_in_the_same_way(tmp_path: Path):
    rewards = [[0, 0, 0, 0, 0, 1], [0, -1, 0, 0, 0, 0], [0, 0, 0, 2, 2, 2], [-3, -2, -1, -1, -1, 0]]
    dataset = write_dataset(
        tmp_path / "data", ("go",) * 4, {FRONT: IMAGE} | dict.fromkeys((REWARD, FORCE), labels("float32")),
        lambda feature, episode, step: [rewards[episode][step]] if feature == REWARD else None,
    )  # fmt: skip
    shapes = {STATE: (4,), ACTION: (2,), FORCE: (1,)}
    segments = list(recorded(dataset, open_metadata(dataset), shapes, STEPS, range(4), 100))
    spec = WorldModelSpec(cameras=(FRONT,), image_size=(32, 32), state_dim=4, action_dim=2, chunk=2, fps=FPS)
    assert [segment.success for segment in segments] == [True, False, True, False]
    assert segments[0].observations[FORCE].shape[1:] == (1,), "LeRobot stores it without a dimension"
    assert [episode.success for episode in load_episodes(dataset, spec)] == [True, False, True, False]
    assert picked(dataset, "successes") == [0, 2]


@pytest.mark.parametrize(
    ("rewards", "why"),
    [
        ([0.0, 0.1, 0.2, 0.3, 0.4, 0.5], "above 0 at steps that do not end it.*label the episodes"),
        ([1.0] * 6, "above 0 at steps that do not end it"),  # for being alive
        ([0.0, 1.0, 0.0, 1.0, 0.0, 0.0], "above 0 at steps that do not end it"),
        ([np.nan] * 6, "a number that is not finite in episode 0"),
    ],
)
def test_rewards_that_tell_no_success_are_refused(tmp_path: Path, rewards: list[float], why: str):
    dataset = write_dataset(
        tmp_path / "data", more={REWARD: labels("float32")},
        values=lambda feature, episode, step: [rewards[step]] if feature == REWARD else None,
    )  # fmt: skip
    with pytest.raises(InputError, match=f"^dataset.root=.*{why}"):
        picked(dataset, "successes")


def test_an_instruction_that_changes_is_refused_where_one_is_read(tmp_path: Path):
    dataset = write_dataset(tmp_path / "data", ("go", ["go"] * 3 + ["stop"] * 3))
    with opened(dataset, open_metadata(dataset)) as data:
        episodes = read_labels(data, dataset, one_task=False)
        assert [episode.tasks for episode in episodes] == [("go",), ("go", "stop")]
        with pytest.raises(InputError, match="episode 1: its instruction changes from 'go' to 'stop'"):
            read_labels(data, dataset)
        # SFT reads it where it stands.
        assert [data[i]["task"] for i in (STEPS + 2, STEPS + 3)] == ["go", "stop"]
