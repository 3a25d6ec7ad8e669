# SPDX-License-Identifier: Apache-2.0
"""Tensors of which every process of a group may hold a part, `torch.distributed`'s DTensors, and whole ones.

Told apart by what they can do: the class itself costs an import that nobody needs who trains alone.
"""

from __future__ import annotations

from torch import Tensor


def in_parts(tensor: Tensor) -> bool:
    """True if this process holds a part of it only."""
    return hasattr(tensor, "full_tensor")


def whole(tensor: Tensor) -> Tensor:
    """All of it, on the CPU if it was in parts; every process of the group asks for it at the same time."""
    return tensor.full_tensor().cpu() if in_parts(tensor) else tensor


def part_of(tensor: Tensor, like: Tensor) -> Tensor:
    """A whole tensor as `like` is: on its device, and the same part of it."""
    tensor = tensor.to(like.device)
    if not in_parts(like):
        return tensor
    from torch.distributed.tensor import distribute_tensor

    # Without a source: every process has the whole, so that nothing is sent.
    return distribute_tensor(tensor, like.device_mesh, like.placements, src_data_rank=None)


def place(tensor: Tensor) -> tuple[object, ...]:
    """Equal for tensors that are the same memory, seen in the same way."""
    mine = tensor.to_local() if in_parts(tensor) else tensor
    return mine.untyped_storage().data_ptr(), mine.storage_offset(), tensor.shape, tensor.stride()
