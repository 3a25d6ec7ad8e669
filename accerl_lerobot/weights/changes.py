# SPDX-License-Identifier: Apache-2.0
"""Differences between two sets of weights: index and new value, bit for bit.

The values themselves and no differences of them, so that nothing drifts: whoever applies them to the set they
were found against has the other one exactly, which its digest confirms. Both sets are looked at as words of a
fixed size, whatever the tensors' types.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from accerl_lerobot.weights.slab import Layout

LIMIT = 1 / 3
"""Share of changed words above which the whole set is sent: an index costs as much as a value of four bytes,
and scattered values are slower to write than a copy."""
_BLOCK = 1 << 20
"""Words that are compared at once."""


class Changes(NamedTuple):
    """Words that are others than they were."""

    where: np.ndarray
    """uint32, growing; in words from the beginning of the data."""
    words: np.ndarray
    """uint8, uint16, uint32 or uint64; what stands there now."""

    @property
    def nbytes(self) -> int:
        """Bytes that they take."""
        return int(self.where.nbytes + self.words.nbytes)


def find(base: np.ndarray, new: np.ndarray, word: int, limit: float = LIMIT) -> Changes | None:
    """Compares two sets.

    Args:
        base: data of the earlier one, bytes.
        new: data of the later one, of the same layout.
        word: bytes of a word, 1, 2, 4 or 8.
        limit: share of the words, in [0, 1].

    Returns:
        None if more than `limit` of all words have changed, or there are too many to count with 32 bits.
    """
    kind = f"u{word}"
    before, after = base.view(kind), new.view(kind)
    if len(after) > np.iinfo(np.uint32).max:
        return None
    allowed, found = limit * len(after), 0
    parts = []
    for start in range(0, len(after), _BLOCK):
        end = start + _BLOCK
        part = np.flatnonzero(before[start:end] != after[start:end])
        found += len(part)
        if found > allowed:
            return None
        parts.append((part + start).astype(np.uint32))
    where = np.concatenate(parts) if parts else np.zeros(0, np.uint32)
    return Changes(where, after[where])


def apply(changes: Changes, base: np.ndarray) -> None:
    """Writes them into `base`, bytes, which becomes the later set."""
    base.view(changes.words.dtype)[changes.where] = changes.words


def by_tensor(changes: Changes, layout: Layout) -> dict[str, np.ndarray]:
    """Name → indices of the elements of that tensor, flattened, that have changed; only those with any."""
    word, found = changes.words.dtype.itemsize, {}
    for name, place in layout.places.items():
        start, end = np.searchsorted(
            changes.where, [place.offset // word, (place.offset + place.nbytes) // word]
        )
        if end > start:
            ratio = np.dtype(place.dtype).itemsize // word
            elements = (changes.where[start:end].astype(np.int64) - place.offset // word) // ratio
            found[name] = elements if ratio == 1 else np.unique(elements)
    return found
