# SPDX-License-Identifier: Apache-2.0
"""The in-memory channel keeps the contract, and the contract notices channels that do not."""

import time

import numpy as np
import pytest

from accerl_lerobot.weights.channel import MemoryChannel, Tensors, WeightChannel
from tests.weights import contract
from tests.weights.contract import CHECKS, Check


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_memory_channel(check: Check) -> None:
    check(MemoryChannel)


class Aliasing(WeightChannel):
    """Hands out the publisher's own arrays."""

    def __init__(self) -> None:
        self.kept: tuple[int, Tensors] | None = None

    def publish(self, version: int, tensors: Tensors) -> None:
        self.kept = (version, tensors)

    def newest(self, than: int) -> tuple[int, Tensors] | None:
        return self.kept if self.kept is not None and self.kept[0] > than else None


class Torn(MemoryChannel):
    """Updates a shared set tensor by tensor."""

    def __init__(self) -> None:
        super().__init__()
        self.shared: Tensors = {}
        self.version = -1

    def publish(self, version: int, tensors: Tensors) -> None:
        self.version = version
        for name, tensor in tensors.items():
            self.shared[name] = np.array(tensor)
            time.sleep(0.001)

    def newest(self, than: int) -> tuple[int, Tensors] | None:
        return (self.version, dict(self.shared)) if self.version > than else None


@pytest.mark.parametrize(
    ("channel", "check"),
    [
        (Aliasing, contract.later_changes_by_the_publisher_stay_with_it),
        (Aliasing, contract.versions_must_grow),
        (Aliasing, contract.a_reader_cannot_disturb_another),
        (Torn, contract.names_belong_to_their_version),
        (Torn, contract.no_reader_ever_sees_a_mixture),
    ],
)
def test_the_contract_notices(channel: type[WeightChannel], check: Check) -> None:
    with pytest.raises((AssertionError, pytest.fail.Exception)):
        check(channel)
