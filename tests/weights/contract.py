# SPDX-License-Identifier: Apache-2.0
"""Tests that every weight transport must pass.

Use, in the test file of a transport::

    @pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
    def test_contract(check: Check) -> None:
        check(MyChannel)

A factory is called without arguments and returns a channel of its own.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Protocol

import numpy as np
import pytest

from accerl_lerobot.weights.publisher import Tensors


class WeightChannel(Protocol):
    """A publisher and its readers, as one."""

    def publish(self, version: int, tensors: Tensors) -> None:
        """Publish a set and wait until it has arrived."""

    def newest(self, than: int) -> tuple[int, Tensors] | None:
        """The newest set, if it is newer than `than`."""


Factory = Callable[[], WeightChannel]
Check = Callable[[Factory], None]


def filled(value: float, size: int = 4) -> Tensors:
    """Three tensors that all hold `value`: a mixture of two versions shows."""
    return {name: np.full((2, size), value, np.float32) for name in ("a", "b", "c.weight")}


def values_of(tensors: Tensors) -> set[float]:
    return {float(x) for tensor in tensors.values() for x in np.unique(tensor)}


def nothing_before_the_first_publication(make: Factory) -> None:
    assert make().newest(than=-1) is None


def what_is_published_arrives(make: Factory) -> None:
    channel = make()
    sent: Tensors = {
        "weight": np.arange(6, dtype=np.float32).reshape(2, 3),
        "strided": np.arange(12, dtype=np.float64).reshape(3, 4).T,
        "scalar": np.array(0.5, np.float32),
        "empty": np.zeros((0, 3), np.float32),
        "half": np.array([1.5, -2.0], np.float16),
        "bits": np.array([[1, 65535]], np.uint16),
    }
    channel.publish(3, sent)
    found = channel.newest(than=-1)
    assert found is not None
    version, got = found
    assert version == 3 and got.keys() == sent.keys()
    for name, tensor in sent.items():
        assert got[name].dtype == tensor.dtype and got[name].shape == tensor.shape, name
        np.testing.assert_array_equal(got[name], tensor)


def version_zero_can_be_published(make: Factory) -> None:
    channel = make()
    channel.publish(0, filled(0.0))
    assert channel.newest(than=-1) is not None and channel.newest(than=0) is None


def only_newer_ones_are_handed_out(make: Factory) -> None:
    channel = make()
    channel.publish(5, filled(5.0))
    assert channel.newest(than=4) is not None
    assert channel.newest(than=5) is None and channel.newest(than=6) is None


def a_slow_reader_skips_versions(make: Factory) -> None:
    channel = make()
    for version in (1, 2, 7):
        channel.publish(version, filled(float(version)))
    found = channel.newest(than=1)
    assert found is not None and found[0] == 7 and values_of(found[1]) == {7.0}


def readers_do_not_take_from_each_other(make: Factory) -> None:
    channel = make()
    channel.publish(1, filled(1.0))
    for _ in range(3):
        found = channel.newest(than=0)
        assert found is not None and found[0] == 1


def versions_must_grow(make: Factory) -> None:
    channel = make()
    channel.publish(4, filled(4.0))
    for version in (4, 3, -1):
        with pytest.raises(ValueError, match="published version"):
            channel.publish(version, filled(9.0))
    found = channel.newest(than=-1)
    assert found is not None and found[0] == 4 and values_of(found[1]) == {4.0}
    channel.publish(5, filled(5.0))
    with pytest.raises(ValueError, match="published version"):
        make().publish(-1, filled(0.0))


def later_changes_by_the_publisher_stay_with_it(make: Factory) -> None:
    channel = make()
    tensors = filled(1.0)
    channel.publish(1, tensors)
    before = channel.newest(than=0)
    for tensor in tensors.values():
        tensor[:] = 99.0
    tensors["more"] = np.zeros(1, np.float32)
    after = channel.newest(than=0)
    assert before is not None and after is not None
    for found in (before, after):
        assert found[1].keys() == {"a", "b", "c.weight"} and values_of(found[1]) == {1.0}


def a_reader_cannot_disturb_another(make: Factory) -> None:
    channel = make()
    channel.publish(1, filled(1.0))
    first = channel.newest(than=0)
    assert first is not None
    with pytest.raises(ValueError, match="read-only"):
        first[1]["a"][:] = 99.0
    first[1].clear()
    second = channel.newest(than=0)
    assert second is not None and len(second[1]) == 3 and values_of(second[1]) == {1.0}


def a_set_that_was_read_survives_the_next_publication(make: Factory) -> None:
    channel = make()
    channel.publish(1, filled(1.0))
    held = channel.newest(than=0)
    channel.publish(2, filled(2.0))
    assert held is not None and held[0] == 1 and values_of(held[1]) == {1.0}


def names_belong_to_their_version(make: Factory) -> None:
    channel = make()
    channel.publish(1, {"old": np.ones(1, np.float32), "both": np.ones(1, np.float32)})
    channel.publish(2, {"both": np.zeros(2, np.float32)})
    found = channel.newest(than=0)
    assert found is not None and found[1].keys() == {"both"} and found[1]["both"].shape == (2,)


def no_reader_ever_sees_a_mixture(make: Factory) -> None:
    """A publisher that reuses one set of buffers, as a trainer does, against two readers at full speed."""
    channel = make()
    last = 40
    problems: list[tuple[int, int, set[float]]] = []
    sets_seen: list[int] = []

    def read() -> None:
        seen = -1
        while seen < last and not problems:
            found = channel.newest(than=seen)
            if found is None:
                time.sleep(0)  # lets the publisher run
                continue
            version, tensors = found
            if version <= seen or values_of(tensors) != {float(version)}:
                problems.append((seen, version, values_of(tensors)))
            seen = version
            sets_seen.append(version)

    readers = [threading.Thread(target=read, daemon=True) for _ in range(2)]
    for reader in readers:
        reader.start()
    buffers = filled(0.0, size=4096)
    for version in range(1, last + 1):
        for tensor in buffers.values():
            tensor[:] = version
        channel.publish(version, buffers)
        time.sleep(0.0005)  # lets the readers run
    for reader in readers:
        reader.join(timeout=30)
    assert not problems and not any(reader.is_alive() for reader in readers)
    assert sets_seen.count(last) == 2


CHECKS: tuple[Check, ...] = (
    nothing_before_the_first_publication,
    what_is_published_arrives,
    version_zero_can_be_published,
    only_newer_ones_are_handed_out,
    a_slow_reader_skips_versions,
    readers_do_not_take_from_each_other,
    versions_must_grow,
    later_changes_by_the_publisher_stay_with_it,
    a_reader_cannot_disturb_another,
    a_set_that_was_read_survives_the_next_publication,
    names_belong_to_their_version,
    no_reader_ever_sees_a_mixture,
)
