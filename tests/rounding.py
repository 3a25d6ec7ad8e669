# SPDX-License-Identifier: Apache-2.0
"""Comparison of float32 numbers, whose last digits depend on the CPU and on the batch size."""

from typing import Any

import torch

ROUNDING = 1e-4  # error of a float32 network, relative to its largest number; found are 1e-7 to 1e-5


def assert_close(found: Any, expected: Any, *, rel: float = ROUNDING, largest: float = 0.0) -> None:
    """Asserts that no entry is off by more than `rel` times the largest expected one; whole ones are equal.

    A sum is rounded in proportion to its terms: where these cancel in all entries, `largest` is their size.
    """
    mine, theirs = (torch.as_tensor(x).detach() for x in (found, expected))
    assert mine.shape == theirs.shape, f"{tuple(mine.shape)} is not {tuple(theirs.shape)}"
    exact = not (mine.is_floating_point() or theirs.is_floating_point())
    error, size = float((mine.double() - theirs).abs().max()), max(float(theirs.abs().max()), largest)
    assert error <= (0 if exact else rel * size), f"off by {error:.2e} where the largest is {size:.2e}"
