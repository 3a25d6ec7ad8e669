# SPDX-License-Identifier: Apache-2.0
"""Advantages to zero mean and unit standard deviation over the *global* batch.

Each trainer rank calls `moments` on its part, sums the three numbers with those of the other ranks (one
all-reduce, made by the caller; this file knows of no ranks), and calls `normalise` with the sum.
Normalising per rank or per micro-batch instead would compare a decision only with its neighbours.

Example:
    >>> total = moments(mine, mask) + moments(theirs, their_mask)
    >>> mine = normalise(mine, total, mask)
"""

from __future__ import annotations

import torch
from torch import Tensor

STD_EPSILON = 1e-6
"""Added to the standard deviation: advantages that are all equal become 0, and not noise of unit size."""


def moments(x: Tensor, mask: Tensor | None = None) -> Tensor:
    """(sum, sum of squares, count) of the valid entries, float64 (3,); add them to merge batches.

    float64, because the variance is the difference of two nearly equal numbers when the mean is large.

    Args:
        x: any shape; padding may hold anything, NaN included.
        mask: bool, same shape, or None.
    """
    wide = x.detach().double()
    if mask is None:
        count = wide.new_tensor(float(x.numel()))
    else:
        wide, count = wide.masked_fill(~mask, 0.0), mask.sum().double()
    return torch.stack([wide.sum(), wide.square().sum(), count])


def normalise(x: Tensor, moments: Tensor, mask: Tensor | None = None) -> Tensor:
    """(x − mean) / (std + `STD_EPSILON`), same shape and dtype as `x`; 0 at padding.

    Args:
        x: any shape.
        moments: (3,), from `moments`, summed over everything that is compared with each other.
        mask: bool, same shape as `x`, or None.
    """
    total, squares, count = moments.unbind()
    mean = total / count.clamp(min=1.0)
    std = (squares / count.clamp(min=1.0) - mean.square()).clamp(min=0.0).sqrt()
    scaled = ((x.detach().double() - mean) / (std + STD_EPSILON)).to(x.dtype)
    return scaled if mask is None else scaled.masked_fill(~mask, 0.0)
