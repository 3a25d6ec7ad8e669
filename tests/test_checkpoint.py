# SPDX-License-Identifier: Apache-2.0
"""A checkpoint is there whole or not at all, ``last`` points at a whole one; trees come out as they go in."""

import json
import os
import shutil
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np
import pytest
import torch

from accerl_lerobot.checkpoint import layout, snapshot
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import SegmentStart
from tests.replay.segments import make_segment

FILE = f"{layout.PRETRAINED}/model.safetensors"


def saved(folder: Path, *versions: int, weights: str = "weights", fails: bool = False) -> Path:
    """Saves checkpoints, one after the other; the folder of the last one."""
    for version in versions:

        def write(directory: Path, version: int = version) -> int:
            state = directory / layout.TRAINING_STATE
            snapshot.save(state / layout.RUN_STATE, {"version": version, "array": np.arange(50)})
            snapshot.save(state / layout.WEIGHTS, {"w": np.array([1.0, 2.0])})
            (directory / layout.PRETRAINED).mkdir()
            (directory / FILE).write_text(weights)
            if fails:
                assert listing(folder) == ["000001", "last"], "nothing is visible while it is written"
                raise OSError("no space left on device")
            return version

        path = layout.save_checkpoint(folder, write)
    return path


def listing(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir() if not p.name.startswith(".writing"))


def test_a_failure_leaves_everything_as_it_was(tmp_path: Path):
    saved(tmp_path, 1)
    with pytest.raises(OSError, match="no space"):
        saved(tmp_path, 2, fails=True)
    assert sorted(os.listdir(tmp_path)) == ["000001", "last"]
    assert os.readlink(tmp_path / "last") == "000001", "relative"


def test_what_a_killed_process_left_behind_is_no_obstacle(tmp_path: Path):
    (tmp_path / f".writing-{os.getpid()}" / layout.PRETRAINED).mkdir(parents=True)
    (tmp_path / f".writing-{os.getpid()}" / layout.PRETRAINED / "half").touch()
    (tmp_path / ".last-new").symlink_to("000000")
    path = saved(tmp_path, 20)
    assert listing(path) == ["manifest.json", layout.PRETRAINED, layout.TRAINING_STATE]
    assert listing(path / layout.PRETRAINED) == ["model.safetensors"]
    assert json.loads((path / layout.TRAINING_STATE / "training_step.json").read_text()) == {"step": 20}
    assert sorted(os.listdir(tmp_path)) == ["000020", "last"]


def test_the_same_version_again_replaces_the_first(tmp_path: Path):
    """The same weights may be saved with another state, replay above all."""
    first, again = saved(tmp_path, 5, weights="first"), saved(tmp_path, 5, weights="again")
    assert first == again and (first / FILE).read_text() == "again"
    assert listing(tmp_path) == ["000005", "last"] and layout.defect(first) is None


def test_going_back_puts_aside_what_came_after(tmp_path: Path):
    saved(tmp_path, 1, 2, 30)
    layout.go_back_to(tmp_path / "000002")
    assert os.readlink(tmp_path / "last") == "000002" and layout.newest_whole(tmp_path)[0].name == "000002"
    assert listing(tmp_path) == ["000001", "000002", "abandoned-000030", "last"]
    assert (tmp_path / "abandoned-000030" / FILE).is_file()


def test_every_torn_or_changed_file_is_noticed_and_the_one_before_is_taken(tmp_path: Path):
    newest = saved(tmp_path, 1, 2)
    assert layout.newest_whole(tmp_path) == (newest, [])
    files = [path for path in newest.rglob("*") if path.is_file()]
    assert len(files) == 7
    for path in files:
        whole = path.read_bytes()
        for broken in (whole[:-2], bytes([whole[0] ^ 1]) + whole[1:], b"", None):
            path.unlink()
            if broken is not None:
                path.write_bytes(broken)
            if path.name != f"{layout.RUN_STATE}.json" or broken is not None:  # without it, there is no state
                assert layout.defect(newest) is not None, path
            found, passed = layout.newest_whole(tmp_path)
            assert found == tmp_path / "000001" and len(passed) == 1 and passed[0].startswith("000002: ")
        path.write_bytes(whole)
        assert layout.defect(newest) is None


def test_where_nothing_is_whole_nothing_is_begun_from_scratch(tmp_path: Path):
    with pytest.raises(InputError, match="there is none"):
        layout.newest_whole(tmp_path)
    path = saved(tmp_path, 3)
    manifest = json.loads((path / "manifest.json").read_text())
    outside = {"files": manifest["files"] | {"../../outside": {"size": 1, "sha256": "0"}}}
    for change, weights, why in (
        ({}, "WEIGHTS", "000003: pretrained_model/model.safetensors is not what was"),
        ({"format": 0}, "weights", f"its format is 0, and this accerl reads {layout.FORMAT}"),
        (outside, "weights", r"json is broken \(.*\./outside: it leads out of the"),
    ):
        (path / "manifest.json").write_text(json.dumps(manifest | change))
        (path / FILE).write_text(weights)
        with pytest.raises(InputError, match=why):
            layout.newest_whole(tmp_path)


def test_only_the_newest_keep_their_training_state(tmp_path: Path):
    for version in range(1, 6):
        saved(tmp_path, version)
        layout.prune(tmp_path, needed="000002", every=1)
    kept = [path.name for path in sorted(tmp_path.glob("0*")) if (path / layout.TRAINING_STATE).exists()]
    assert kept == ["000002", "000004", "000005"]
    for path in tmp_path.glob("0*"):
        assert (path / FILE).is_file() and layout.defect(path) is None
    assert layout.newest_whole(tmp_path)[0].name == "000005"
    assert layout.newest_whole(tmp_path, "000004")[0].name == "000004"
    with pytest.raises(InputError, match="000003: only the newest 2 keep their training state"):
        layout.newest_whole(tmp_path, "000003")
    with pytest.raises(InputError, match="no such checkpoint; there are 000001, 000002"):
        layout.newest_whole(tmp_path, "000006")
    layout.prune(tmp_path, every=1)
    assert not (tmp_path / "000002" / layout.TRAINING_STATE).exists()


def test_of_those_that_were_saved_by_time_only_the_newest_are_kept(tmp_path: Path):
    for version in (0, 9, 10, 14, 22, 29, 31, 33, 34):
        saved(tmp_path, version)
        layout.prune(tmp_path, every=10)
    kept = [int(path.name) for path in sorted(tmp_path.glob("0*"))]
    assert kept == [10, 22, 31, 33, 34], "the first ones from every tenth update on, and the two newest"
    layout.prune(tmp_path)
    assert [int(path.name) for path in sorted(tmp_path.glob("0*"))] == [33, 34]


def test_pruning_that_was_interrupted_is_completed(tmp_path: Path):
    saved(tmp_path, 1, 2, 3)
    with patch.object(shutil, "rmtree", side_effect=OSError), pytest.raises(OSError):
        layout.prune(tmp_path)
    assert layout.newest_whole(tmp_path)[0].name == "000003" and layout.defect(tmp_path / "000001") is None
    layout.prune(tmp_path)
    assert not (tmp_path / "000001" / layout.TRAINING_STATE).exists()


def test_a_backbone_by_its_bare_name_is_the_one_beside_and_one_from_the_hub_stays(tmp_path: Path):
    config = tmp_path / "config.json"
    config.write_text('{"vlm_model_name": "some/backbone"}')
    layout.relocate(tmp_path, tmp_path / "home")
    assert config.read_text() == '{"vlm_model_name": "some/backbone"}'
    (tmp_path / layout.BACKBONE).mkdir()
    config.write_text(json.dumps({"vlm_model_name": layout.BACKBONE}))
    (tmp_path / "policy_preprocessor.json").write_text('{"steps": []}')
    assert layout.displaced(tmp_path), "LeRobot would look for it where the process runs"
    layout.relocate(tmp_path, tmp_path)
    assert json.loads(config.read_text()) == {"vlm_model_name": str(tmp_path / layout.BACKBONE)}
    assert not layout.displaced(tmp_path)


def test_what_goes_in_comes_out(tmp_path: Path):
    plain = {
        "plain": [None, True, -3, 0.1, "text", float("inf"), 2**100, np.float32(1.5)],
        "tuple": (1, ("a", [2.5]), SegmentStart("t", 3, 1)),
        "dict": {"a": {"b": 1}, "empty": {}},
    }
    arrays = [np.zeros((2, 0), np.uint8), np.array(7), np.arange(6).reshape(2, 3)[:, ::2]]
    rng = np.random.default_rng(4).bit_generator.state
    segment = make_segment("a", n=3, version=[1, 2, 3], success=True)
    tensor = torch.arange(6.0).reshape(2, 3).T
    tree = plain | {"arrays": arrays, "segment": segment, "rng": rng, "tensor": tensor}
    snapshot.save(tmp_path / "tree", tree)
    back = snapshot.load(tmp_path / "tree")
    assert {name: back[name] for name in plain} == plain
    for found, expected in zip(back["arrays"], arrays, strict=True):
        assert found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected)
    back["arrays"][2][0, 0] = 9  # the caller's own
    assert back["segment"].key == "a" and back["segment"].success
    np.testing.assert_array_equal(back["segment"].version, [1, 2, 3])
    assert back["rng"] == rng
    assert torch.equal(back["tensor"], tensor)


class Stranger(NamedTuple):
    x: int


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (Stranger(1), "a Stranger cannot be saved"),
        ({0: "zero"}, "a dict with the key 0 cannot be saved"),
        ({"$": 1}, "a dict with the key '\\$' cannot be saved"),
        ({1, 2}, "a set cannot be saved"),
        (np.array(["text"]), "an array of <U4 cannot be saved"),
        (np.array([object()]), "an array of object cannot be saved"),
    ],
)
def test_what_is_not_known_is_refused(value: Any, message: str, tmp_path: Path):
    with pytest.raises(TypeError, match=message):
        snapshot.save(tmp_path / "tree", {"a": [value]})
    assert not list(tmp_path.iterdir()), "nothing half written"


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("tree.json", "{"),
        ("tree.json", '{"$": "Popen", "fields": {"args": "true"}}'),
        ("tree.json", '{"$": "Origin", "fields": {"task": "a", "seed": 1, "decision": 2, "more": 3}}'),
        ("tree.json", '{"$": "map", "items": []}'),
        ("tree.safetensors", "\xff" * 64),
    ],
)
def test_broken_files_and_those_of_another_make_are_refused(name: str, content: str, tmp_path: Path):
    snapshot.save(tmp_path / "tree", {"a": np.zeros(30)})
    (tmp_path / name).write_bytes(content.encode("latin-1"))
    with pytest.raises(InputError, match="not a state that accerl has saved"):
        snapshot.load(tmp_path / "tree")
