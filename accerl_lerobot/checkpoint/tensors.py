# SPDX-License-Identifier: Apache-2.0
"""The state of torch's modules and optimisers as trees of whole tensors, see `snapshot`.

Every process of a group may hold a part of a tensor, a DTensor of `torch.distributed`. Those are told apart
by what they can do: the class itself costs an import that nobody needs who trains alone.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def in_parts(tensor: Tensor) -> bool:
    """True if this process holds a part of it only."""
    return hasattr(tensor, "full_tensor")


def whole(tensor: Tensor) -> Tensor:
    """All of it, on the CPU if it was in parts: then every process of the group asks for it at the same time,
    and the first one gets it, the others nothing."""
    if not in_parts(tensor):
        return tensor
    full: Tensor = tensor.full_tensor()
    return full.cpu() if torch.distributed.get_rank() == 0 else torch.empty(0)


def copy_of(tensor: Tensor) -> Tensor:
    """A copy of all of it on the CPU; see `whole`."""
    return whole(tensor.detach()).to("cpu", copy=True)


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
    # Not its address, which is 0 for every part without a row: ranks would ask for different tensors.
    return mine.untyped_storage()._cdata, mine.storage_offset(), tensor.shape, tensor.stride()


def optimizer_state(optimizer: torch.optim.Optimizer) -> dict[int, dict[str, torch.Tensor]]:
    """A copy on the CPU of what it knows of each parameter, in order; rates are not its own."""
    known: dict[int, dict[str, Any]] = optimizer.state_dict()["state"]
    copies = {}
    for number, values in known.items():
        copies[number] = {name: copy_of(torch.as_tensor(value)) for name, value in values.items()}
    return copies


def restore_optimizer(optimizer: torch.optim.Optimizer, state: dict[int, dict[str, torch.Tensor]]) -> None:
    """Sets it to what `optimizer_state` gave of one for the same parameters."""
    parameters: list[Tensor] = []
    for group in optimizer.param_groups:
        parameters += group["params"]
    parts: dict[int, dict[str, Tensor]] = {}
    for number, values in state.items():
        parts[number] = dict(values)
        for name, value in values.items():
            if value.dim():  # the number of steps has no dimension and is the same for every process
                parts[number][name] = part_of(value, parameters[number])
    optimizer.load_state_dict({"state": parts, "param_groups": optimizer.state_dict()["param_groups"]})


def copied(module: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {name: copy_of(tensor) for name, tensor in module.state_dict().items()}
