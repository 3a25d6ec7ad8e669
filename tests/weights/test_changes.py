# SPDX-License-Identifier: Apache-2.0
"""Index and new value of what differs, against comparing every value."""

from __future__ import annotations

import numpy as np
import pytest

from accerl_lerobot.weights import changes
from accerl_lerobot.weights.channel import Tensors
from accerl_lerobot.weights.slab import Layout, Slab


def two_sets(dtype: str, share: float, size: int = 5000, seed: int = 0) -> tuple[Tensors, Tensors]:
    """Random bits, NaNs among them, and the same with about `share` of the values changed."""
    rng = np.random.default_rng(seed)
    width = np.dtype(dtype).itemsize
    before = {
        "matrix": rng.integers(0, 256, (size // 50, 50, width), np.uint8).view(dtype)[..., 0],
        "empty": np.zeros((0, 3), dtype),
        "vector": rng.integers(0, 256, (7, width), np.uint8).view(dtype)[..., 0],
        "scalar": np.array(1, dtype),
    }
    after = {}
    for name, tensor in before.items():
        mask = rng.random(tensor.shape) < share
        bits = tensor.copy().view(f"u{width}")
        bits[mask] ^= 1
        after[name] = bits.view(dtype)
    return before, after


def filled(tensors: Tensors) -> tuple[Layout, np.ndarray]:
    layout = Layout.of(tensors)
    slab = Slab(layout.end)
    slab.fill(layout, tensors)
    return layout, slab.memory[: layout.size]


@pytest.mark.parametrize("dtype", ["f4", "f2", "u2", "f8", "u1"])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.2])
def test_what_is_applied_to_the_base_is_the_other_set_bit_for_bit(dtype: str, share: float):
    before, after = two_sets(dtype, share)
    (layout, base), (_, new) = filled(before), filled(after)
    found = changes.find(base, new, layout.word)
    assert found is not None
    own = base.copy()
    changes.apply(found, own)
    np.testing.assert_array_equal(own, new)
    kind = f"u{np.dtype(dtype).itemsize}"
    differing = sum(int((before[k].view(kind) != after[k].view(kind)).sum()) for k in before)
    assert len(found.where) == differing and (share == 0) == (differing == 0)


def test_each_tensor_is_told_which_of_its_elements_have_changed():
    before, after = two_sets("f4", 0.1)
    (layout, base), (_, new) = filled(before), filled(after)
    found = changes.find(base, new, layout.word)
    assert found is not None
    told = changes.by_tensor(found, layout)
    for name in before:
        expected = np.flatnonzero(before[name].view("u4") != after[name].view("u4"))
        np.testing.assert_array_equal(told.get(name, []), expected)


def test_tensors_of_different_types_are_told_of_elements_not_of_words():
    before = {"half": np.zeros(5, np.float16), "double": np.zeros(40, np.float64)}
    after = {name: tensor.copy() for name, tensor in before.items()}
    after["half"][3] = 1.0
    after["double"][[7, 9]] = 1 / 3  # four words of two bytes each
    (layout, base), (_, new) = filled(before), filled(after)
    found = changes.find(base, new, layout.word)
    assert found is not None and len(found.where) == 9
    told = changes.by_tensor(found, layout)
    assert {name: index.tolist() for name, index in told.items()} == {"half": [3], "double": [7, 9]}


@pytest.mark.parametrize(("changed", "worth_it"), [(333, True), (334, False), (1000, False)])
def test_above_a_third_it_is_not_worth_it(changed: int, worth_it: bool):
    base = np.zeros(999 + 1, np.float32)
    new = base.copy()
    new[:changed] = 1
    assert (changes.find(base.view(np.uint8), new.view(np.uint8), 4) is not None) == worth_it


def test_zero_with_another_sign_is_another_value():
    base, new = np.zeros(4, np.float32), np.array([0.0, -0.0, 0.0, 0.0], np.float32)
    found = changes.find(base.view(np.uint8), new.view(np.uint8), 4)
    assert found is not None and found.where.tolist() == [1]


def test_blocks_do_not_show(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(changes, "_BLOCK", 64)
    before, after = two_sets("f4", 0.2)
    (layout, base), (_, new) = filled(before), filled(after)
    found = changes.find(base, new, layout.word)
    assert found is not None
    np.testing.assert_array_equal(found.where, np.flatnonzero(base.view("u4") != new.view("u4")))
