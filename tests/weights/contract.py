# SPDX-License-Identifier: Apache-2.0
"""Tests that every weight transport must pass.

Use, in the test file of a transport::

    @pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
    def test_contract(check: Check) -> None:
        check(MyChannel)

A factory is called without arguments and returns a channel of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
import pytest

from accerl_lerobot.weights.publisher import Tensors


class WeightChannel(Protocol):
    """A publisher and its readers, as one."""

    def publish(self, version: int, tensors: Tensors) -> None:
        """Publish a set and wait until it has arrived."""

    def newest(self) -> tuple[int, Tensors] | None:
        """The newest set that has arrived."""


Factory = Callable[[], WeightChannel]
Check = Callable[[Factory], None]


def filled(value: float, size: int = 4) -> Tensors:
    """Three tensors that all hold `value`: a mixture of two versions shows."""
    return {name: np.full((2, size), value, np.float32) for name in ("a", "b", "c.weight")}


def values_of(tensors: Tensors) -> set[float]:
    return {float(x) for tensor in tensors.values() for x in np.unique(tensor)}


def newest(channel: WeightChannel) -> tuple[int, Tensors]:
    found = channel.newest()
    assert found is not None
    return found


def what_is_published_arrives(make: Factory) -> None:
    channel = make()
    assert channel.newest() is None
    sent: Tensors = {
        "weight": np.arange(6, dtype=np.float32).reshape(2, 3),
        "strided": np.arange(12, dtype=np.float64).reshape(3, 4).T,
        "scalar": np.array(0.5, np.float32),
        "empty": np.zeros((0, 3), np.float32),
        "half": np.array([1.5, -2.0], np.float16),
        "bits": np.array([[1, 65535]], np.uint16),
    }
    channel.publish(0, sent)
    version, got = newest(channel)
    assert version == 0 and got.keys() == sent.keys()
    for name, tensor in sent.items():
        assert got[name].dtype == tensor.dtype and got[name].shape == tensor.shape, name
        np.testing.assert_array_equal(got[name], tensor)


def versions_must_grow(make: Factory) -> None:
    channel = make()
    with pytest.raises(ValueError, match="published version"):
        channel.publish(-1, filled(0.0))
    channel.publish(4, filled(4.0))
    for version in (4, 3, -1):
        with pytest.raises(ValueError, match="published version"):
            channel.publish(version, filled(9.0))
    version, tensors = newest(channel)
    assert version == 4 and values_of(tensors) == {4.0}
    channel.publish(5, filled(5.0))
    assert newest(channel)[0] == 5


def later_changes_by_the_publisher_stay_with_it(make: Factory) -> None:
    channel = make()
    tensors = filled(1.0)
    channel.publish(1, tensors)
    before = newest(channel)
    for tensor in tensors.values():
        tensor[:] = 99.0
    tensors["more"] = np.zeros(1, np.float32)
    for _, found in (before, newest(channel)):
        assert found.keys() == {"a", "b", "c.weight"} and values_of(found) == {1.0}


def names_belong_to_their_version(make: Factory) -> None:
    channel = make()
    channel.publish(1, {"old": np.ones(1, np.float32), "both": np.ones(1, np.float32)})
    channel.publish(2, {"both": np.zeros(2, np.float32)})
    _, found = newest(channel)
    assert found.keys() == {"both"} and found["both"].shape == (2,)


CHECKS: tuple[Check, ...] = (
    what_is_published_arrives,
    versions_must_grow,
    later_changes_by_the_publisher_stay_with_it,
    names_belong_to_their_version,
)
