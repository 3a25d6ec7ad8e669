# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""Weights from the trainer to inference workers through Ray's object store.

One copy is put into the store, each reader gets a reference, and at most one set per reader is under way: a
reader that is slow skips versions instead of queueing them. The publisher never waits for a reader.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import ray

from accerl_lerobot.weights.channel import Tensors, check_grows


class RayPublisher:
    """The trainer's end; the readers' end is `InferenceWorker.receive_weights`.

    Args:
        readers: actor handles with a ``receive_weights(version, tensors)`` method.
    """

    def __init__(self, readers: Sequence[Any]) -> None:
        self._readers = list(readers)
        self._under_way: list[Any] = [None] * len(self._readers)
        self._sent: list[int | None] = [None] * len(self._readers)
        self._version: int | None = None
        self._newest: Any = None

    def publish(self, version: int, tensors: Tensors) -> None:
        """Makes a set the newest one; returns once it is copied into the object store.

        Raises:
            ValueError: `version` does not grow.
            ray.exceptions.RayError: a reader has died.
        """
        check_grows(version, self._version)
        self._version, self._newest = version, ray.put(tensors)
        for index in range(len(self._readers)):
            if self._arrived(index, timeout=0):
                self._send(index)

    def flush(self) -> None:
        """Waits until every reader has the newest set; called once, after the last update.

        Raises:
            ray.exceptions.RayError: a reader has died.
        """
        for index in range(len(self._readers)):
            self._arrived(index, timeout=None)
            self._send(index)
        for index in range(len(self._readers)):
            self._arrived(index, timeout=None)

    def _send(self, index: int) -> None:
        if self._sent[index] != self._version:
            reader = self._readers[index]
            self._under_way[index] = reader.receive_weights.remote(self._version, self._newest)
            self._sent[index] = self._version

    def _arrived(self, index: int, timeout: float | None) -> bool:
        """Whether what was sent to a reader has been received; waits up to `timeout` seconds for it."""
        reference = self._under_way[index]
        if reference is None:
            return True
        done, _ = ray.wait([reference], timeout=timeout)
        if done:
            ray.get(done[0])  # a dead reader raises here
            self._under_way[index] = None
        return bool(done)
