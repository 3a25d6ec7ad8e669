# SPDX-License-Identifier: Apache-2.0
"""Publishing weights: what replicas get, and who is waited for."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from accerl_lerobot.transport import weights
from accerl_lerobot.transport.weights import Tensors, WeightPublisher


def copied(tensors: Tensors) -> Tensors:
    """Copies as Ray's object store would have made them."""
    return {name: tensor.copy() for name, tensor in tensors.items()}


def test_a_replica_gets_the_newest_set_and_skips_those_before():
    publisher, tensor = WeightPublisher(["inference"], copied), np.zeros(3)
    for version in range(5):
        tensor[:] = version
        publisher.publish(version, {"w": tensor})
    tensor[:] = -1
    version, (newest,) = publisher.newer_than("inference", -1)
    assert version == 4 and (newest["w"] == 4).all()


def test_a_replica_waits_for_newer_weights_but_not_for_ever(monkeypatch: pytest.MonkeyPatch):
    publisher = WeightPublisher(["inference"], copied)
    threading.Timer(0.05, publisher.publish, (3, {})).start()
    assert publisher.newer_than("inference", -1) == (3, [{}])
    monkeypatch.setattr(weights, "ASK_S", 0.01)
    assert publisher.newer_than("inference", 3) == (3, [])


def test_flush_waits_until_each_replica_has_applied_the_newest(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(weights, "ASK_S", 0.0)
    publisher = WeightPublisher(["inference 0", "inference 1"], copied)
    publisher.flush(30)
    publisher.publish(1, {})
    publisher.newer_than("inference 0", 1)
    publisher.newer_than("inference 1", 0)
    with pytest.raises(TimeoutError, match=r"weights not applied within 0\.1 s by inference 1"):
        publisher.flush(0.1)
    threading.Timer(0.05, publisher.newer_than, ("inference 1", 1)).start()
    publisher.flush(30)
