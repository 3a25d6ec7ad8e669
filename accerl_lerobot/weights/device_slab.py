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
"""A set of weights on a device of torch, for what goes from GPU to GPU without the host's memory between.

As `slab.Slab`, but for the layout, which travels apart, and for the digest: to hash a set on the host would
cost more than to send it, so its words are summed where they are.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
import xxhash
from torch import Tensor

from accerl_lerobot.weights.slab import Layout, digest

_AT_ONCE = 1 << 20
"""Words that are summed at a time; bounds the memory that it takes."""
_MIX = -7046029254386353131
"""Odd, and 64 bits long: 0x9E3779B97F4A7C15 as an int64."""


class DeviceSlab:
    """Memory for one set at a time.

    Args:
        size: bytes.
        device: where.
    """

    def __init__(self, size: int, device: torch.device) -> None:
        self.memory = torch.zeros(_whole_words(size), dtype=torch.uint8, device=device)

    def __len__(self) -> int:
        return len(self.memory)

    def views(self, layout: Layout) -> dict[str, Tensor]:
        """The tensors as they lie in it."""
        return {
            name: self.memory[place.offset : place.offset + place.nbytes]
            .view(_dtype(place.dtype))
            .view(place.shape)
            for name, place in layout.places.items()
        }

    def fill(self, layout: Layout, tensors: Mapping[str, Any]) -> None:
        """Copies a set into it, of tensors or arrays."""
        for view, tensor in zip(self.views(layout).values(), tensors.values(), strict=True):
            view.copy_(tensor if isinstance(tensor, Tensor) else torch.tensor(tensor))

    def close(self) -> None:
        """Lets the memory go, as soon as nothing points into it any more."""
        self.memory = self.memory[:0].clone()


def digest_there(version: int, layout: Layout, memory: Tensor) -> bytes:
    """128 bits of version, layout and data, of which the device sums its 64-bit words, each times an odd
    number of its place: one that is wrong, or in another's place, changes the sum.

    Args:
        version: of the set.
        layout: of the set.
        memory: bytes, on any device.
    """
    words = memory[: _whole_words(layout.size)].view(torch.int64)
    total = torch.zeros((), dtype=torch.int64, device=memory.device)
    for start in range(0, len(words), _AT_ONCE):
        part = words[start : start + _AT_ONCE]
        place = torch.arange(start, start + len(part), device=memory.device)
        total += (part * (_MIX * (2 * place + 1))).sum()
    found = xxhash.xxh3_128(version.to_bytes(8, "little"))
    found.update(layout.text)
    found.update(int(total).to_bytes(8, "little", signed=True))
    return found.digest()


def digest_of(version: int, layout: Layout, memory: Tensor | np.ndarray) -> bytes:
    """Of a set in either kind of slab."""
    if isinstance(memory, Tensor):
        return digest_there(version, layout, memory)
    return digest(version, layout, memory)


def _whole_words(size: int) -> int:
    return -(-max(size, 8) // 8) * 8


def _dtype(name: str) -> torch.dtype:
    return torch.from_numpy(np.empty(0, name)).dtype
