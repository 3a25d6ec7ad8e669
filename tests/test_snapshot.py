# SPDX-License-Identifier: Apache-2.0
"""Trees on disk: what goes in comes out, and nothing else is taken."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import SegmentStart
from tests.replay.segments import make_segment


def there_and_back(tree: Any, folder: Path) -> Any:
    snapshot.save(folder / "tree", tree)
    return snapshot.load(folder / "tree")


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
    back = there_and_back(tree, tmp_path)
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
    back = there_and_back(
        {"segment": segment, "rng": rng, "tensor": tensor, "origin": [SegmentStart("t", 3, 1)]}, tmp_path
    )
    assert (
        back["origin"] == [SegmentStart("t", 3, 1)] and back["segment"].key == "a" and back["segment"].success
    )
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
