# SPDX-License-Identifier: Apache-2.0
"""A checkpoint is there whole or not at all, ``last`` points at a whole one; trees come out as they go in."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import (
    BACKBONE,
    PRETRAINED,
    RUN_STATE,
    TRAINING_STATE,
    WEIGHTS,
    defect,
    displaced,
    go_back_to,
    newest_whole,
    prune,
    relocate,
    save_checkpoint,
)
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import SegmentStart
from tests.replay.segments import make_segment


def writer(version: int, content: str = "weights") -> Callable[[Path], int]:
    def write(directory: Path) -> int:
        (directory / PRETRAINED).mkdir()
        (directory / PRETRAINED / "model.safetensors").write_text(content)
        return version

    return write


def listing(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def test_layout(tmp_path: Path):
    seen: list[list[str]] = []

    def write(directory: Path) -> int:
        seen.append([name for name in listing(directory.parent) if not name.startswith(".")])
        return writer(20)(directory)

    save_checkpoint(tmp_path / "run", writer(7))
    path = save_checkpoint(tmp_path / "run", write)
    assert seen == [["000007", "last"]], "nothing is visible while it is written"
    assert listing(path) == ["manifest.json", PRETRAINED, TRAINING_STATE]
    assert listing(path / PRETRAINED) == ["model.safetensors"]
    assert json.loads((path / TRAINING_STATE / "training_step.json").read_text()) == {"step": 20}
    assert listing(path.parent) == ["000007", "000020", "last"]
    shutil.move(tmp_path / "run", tmp_path / "moved")
    assert os.readlink(tmp_path / "moved" / "last") == "000020", "relative"


def test_a_failure_leaves_everything_as_it_was(tmp_path: Path):
    save_checkpoint(tmp_path, writer(1))

    def write(directory: Path) -> int:
        writer(2)(directory)
        raise OSError("no space left on device")

    with pytest.raises(OSError, match="no space"):
        save_checkpoint(tmp_path, write)
    assert listing(tmp_path) == ["000001", "last"] and os.readlink(tmp_path / "last") == "000001"
    save_checkpoint(tmp_path, writer(2))
    assert os.readlink(tmp_path / "last") == "000002", "and the next attempt succeeds"


def test_what_a_killed_process_left_behind_is_no_obstacle(tmp_path: Path):
    (tmp_path / f".writing-{os.getpid()}" / PRETRAINED).mkdir(parents=True)
    (tmp_path / f".writing-{os.getpid()}" / PRETRAINED / "half").touch()
    (tmp_path / ".last-new").symlink_to("000000")
    path = save_checkpoint(tmp_path, writer(1))
    assert listing(path / PRETRAINED) == ["model.safetensors"]
    assert listing(tmp_path) == ["000001", "last"]


def test_the_same_version_again_replaces_the_first(tmp_path: Path):
    """The same weights may be saved with another state, replay above all."""
    first = save_checkpoint(tmp_path, writer(5, "first"))
    again = save_checkpoint(tmp_path, writer(5, "again"))
    assert first == again and (first / PRETRAINED / "model.safetensors").read_text() == "again"
    assert listing(tmp_path) == ["000005", "last"] and defect(first) is None


def test_going_back_puts_aside_what_came_after(tmp_path: Path):
    for version in (1, 2, 30):
        save_checkpoint(tmp_path, state_writer(version))
    go_back_to(tmp_path / "000002")
    assert os.readlink(tmp_path / "last") == "000002" and newest_whole(tmp_path)[0].name == "000002"
    assert listing(tmp_path) == ["000001", "000002", "abandoned-000030", "last"]
    assert (tmp_path / "abandoned-000030" / PRETRAINED / "model.safetensors").is_file()


def state_writer(version: int) -> Callable[[Path], int]:
    def write(directory: Path) -> int:
        snapshot.save(directory / TRAINING_STATE / RUN_STATE, {"version": version, "array": np.arange(50)})
        snapshot.save(directory / TRAINING_STATE / WEIGHTS, {"w": np.array([1.0, 2.0])})
        return writer(version)(directory)

    return write


def test_every_torn_or_changed_file_is_noticed_and_the_one_before_is_taken(tmp_path: Path):
    for version in (1, 2):
        save_checkpoint(tmp_path, state_writer(version))
    newest = tmp_path / "000002"
    assert newest_whole(tmp_path) == (newest, [])
    files = [path for path in newest.rglob("*") if path.is_file()]
    assert len(files) == 7
    for path in files:
        whole = path.read_bytes()
        changed = bytes([whole[0] ^ 1]) + whole[1:]
        for broken in (whole[:-2], changed, b"", None):
            path.unlink()
            if broken is not None:
                path.write_bytes(broken)
            if path.name != f"{RUN_STATE}.json" or broken is not None:  # without it, there is no state
                assert defect(newest) is not None, path
            found, passed = newest_whole(tmp_path)
            assert found == tmp_path / "000001" and len(passed) == 1 and passed[0].startswith("000002: ")
        path.write_bytes(whole)
        assert defect(newest) is None


def test_where_nothing_is_whole_nothing_is_begun_from_scratch(tmp_path: Path):
    with pytest.raises(InputError, match="there is none"):
        newest_whole(tmp_path)
    path = save_checkpoint(tmp_path, state_writer(3))
    (path / PRETRAINED / "model.safetensors").write_text("WEIGHTS")
    with pytest.raises(InputError, match="000003: pretrained_model/model.safetensors is not what was"):
        newest_whole(tmp_path)
    manifest = json.loads((path / "manifest.json").read_text())
    (path / "manifest.json").write_text(json.dumps(manifest | {"format": 9}))
    with pytest.raises(InputError, match="its format is 9, and this accerl reads 7"):
        newest_whole(tmp_path)
    manifest["files"]["../../outside"] = {"size": 1, "sha256": "0"}
    (path / "manifest.json").write_text(json.dumps(manifest))
    (path / PRETRAINED / "model.safetensors").write_text("weights")
    with pytest.raises(InputError, match=r"json is broken \(.*\./outside: it leads out of the"):
        newest_whole(tmp_path)


def test_only_the_newest_keep_their_training_state(tmp_path: Path):
    for version in range(1, 6):
        save_checkpoint(tmp_path, state_writer(version))
        prune(tmp_path, needed="000002")
    kept = [path.name for path in sorted(tmp_path.glob("0*")) if (path / TRAINING_STATE).exists()]
    assert kept == ["000002", "000004", "000005"]
    assert snapshot.load(tmp_path / "000002" / TRAINING_STATE / WEIGHTS)["w"].tolist() == [1.0, 2.0]
    assert all((tmp_path / f"00000{v}" / PRETRAINED / "model.safetensors").is_file() for v in range(1, 6))
    assert all(defect(tmp_path / f"00000{v}") is None for v in range(1, 6))
    assert newest_whole(tmp_path)[0].name == "000005" and newest_whole(tmp_path, "000004")[0].name == "000004"
    with pytest.raises(InputError, match="000003: only the newest 2 keep their training state"):
        newest_whole(tmp_path, "000003")
    with pytest.raises(InputError, match="no such checkpoint; there are 000001, 000002"):
        newest_whole(tmp_path, "000006")
    prune(tmp_path)
    assert not (tmp_path / "000002" / TRAINING_STATE).exists()


def test_pruning_that_was_interrupted_is_completed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for version in (1, 2, 3):
        save_checkpoint(tmp_path, state_writer(version))
    with monkeypatch.context() as context:
        context.setattr(shutil, "rmtree", lambda path: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            prune(tmp_path)
    assert newest_whole(tmp_path)[0].name == "000003" and defect(tmp_path / "000001") is None
    prune(tmp_path)
    assert not (tmp_path / "000001" / TRAINING_STATE).exists()


def test_a_backbone_by_its_bare_name_is_the_one_beside_and_one_from_the_hub_stays(tmp_path: Path):
    (tmp_path / "config.json").write_text('{"vlm_model_name": "some/backbone"}')
    relocate(tmp_path, tmp_path / "home")
    assert (tmp_path / "config.json").read_text() == '{"vlm_model_name": "some/backbone"}'
    (tmp_path / BACKBONE).mkdir()
    (tmp_path / "config.json").write_text(json.dumps({"vlm_model_name": BACKBONE}))
    (tmp_path / "policy_preprocessor.json").write_text('{"steps": []}')
    assert displaced(tmp_path), "LeRobot would look for it where the process runs"
    relocate(tmp_path, tmp_path)
    assert json.loads((tmp_path / "config.json").read_text()) == {"vlm_model_name": str(tmp_path / BACKBONE)}
    assert not displaced(tmp_path)


def test_what_goes_in_comes_out(tmp_path: Path):
    tree = {
        "plain": [None, True, -3, 0.1, "text", float("inf"), 2**100],
        "tuple": (1, ("a", [2.5])),
        "by number": {0: "zero", (1, "b"): {"$": 1}},
        "arrays": [
            np.zeros((2, 0), np.uint8),
            np.float32(1.5),
            np.array(7),
            np.arange(6).reshape(2, 3)[:, ::2],
        ],
        "empty": {},
    }
    snapshot.save(tmp_path / "tree", tree)
    back = snapshot.load(tmp_path / "tree")
    arrays, expected = back.pop("arrays"), tree.pop("arrays")
    assert back == tree
    assert arrays[1] == 1.5
    for i in (0, 2, 3):
        assert arrays[i].dtype == expected[i].dtype
        np.testing.assert_array_equal(arrays[i], expected[i])
    arrays[3][0, 0] = 9  # the caller's own


def test_known_kinds_tensors_and_generators(tmp_path: Path):
    rng = np.random.default_rng(4)
    rng.random(5)
    segment = make_segment("a", n=3, version=[1, 2, 3], success=True)
    tensor = torch.arange(6.0).reshape(2, 3).T
    start = SegmentStart("t", 3, 1)
    tree = {"segment": segment, "rng": rng, "tensor": tensor, "start": [start]}
    snapshot.save(tmp_path / "tree", tree)
    back = snapshot.load(tmp_path / "tree")
    assert back["start"] == [start] and back["segment"].key == "a" and back["segment"].success
    np.testing.assert_array_equal(back["segment"].version, [1, 2, 3])
    assert back["rng"].random(3).tolist() == rng.random(3).tolist()
    assert torch.equal(back["tensor"], tensor)


class Stranger(NamedTuple):
    x: int


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (Stranger(1), r"tree\.a\.0: a Stranger cannot be saved"),
        ({1, 2}, "a set cannot be saved"),
        (np.array(["text"]), "an array of <U4 cannot be saved"),
        (np.array([object()]), "an array of object cannot be saved"),
    ],
)
def test_what_is_not_known_is_refused_and_named(value: Any, message: str, tmp_path: Path):
    with pytest.raises(TypeError, match=message):
        snapshot.save(tmp_path / "tree", {"a": [value]})
    assert not list(tmp_path.iterdir()), "nothing half written"


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("tree.json", "{"),
        ("tree.json", '{"$": "Popen", "fields": {"args": "true"}}'),
        ("tree.json", '{"$": "Origin", "fields": {"task": "a", "seed": 1, "decision": 2, "more": 3}}'),
        ("tree.json", '{"$": "generator", "state": {"bit_generator": "MT19937"}}'),
        ("tree.safetensors", "\xff" * 64),
    ],
)
def test_broken_files_and_those_of_another_make_are_refused(name: str, content: str, tmp_path: Path):
    snapshot.save(tmp_path / "tree", {"a": np.zeros(30)})
    (tmp_path / name).write_bytes(content.encode("latin-1"))
    with pytest.raises(InputError, match="not a state that accerl has saved"):
        snapshot.load(tmp_path / "tree")
