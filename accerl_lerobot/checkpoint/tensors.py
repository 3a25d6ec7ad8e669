# SPDX-License-Identifier: Apache-2.0
"""The state of torch's modules and optimisers as trees of whole tensors, see `snapshot`.

Every process of a group may hold a part of a tensor, a DTensor of `torch.distributed`. It is recognised by
its methods: importing its class takes time, and a single process does not need it.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn


def in_parts(tensor: Tensor) -> bool:
    """True if this process holds only a part of the tensor."""
    return hasattr(tensor, "full_tensor")


def whole(tensor: Tensor) -> Tensor:
    """The whole tensor. One in parts is gathered on the CPU of the first process of the group.

    All processes of the group call this at the same time for a tensor in parts. The others get an empty one.
    """
    if not in_parts(tensor):
        return tensor
    full: Tensor = tensor.full_tensor()
    if torch.distributed.get_rank() == 0:
        return full.cpu()
    return torch.empty(0)


def copy_of(tensor: Tensor) -> Tensor:
    """A copy of the whole tensor on the CPU, see `whole`."""
    return whole(tensor.detach()).to("cpu", copy=True)


def part_of(tensor: Tensor, like: Tensor) -> Tensor:
    """The part of a whole `tensor` that corresponds to the part `like`, on the device of `like`."""
    tensor = tensor.to(like.device)
    if not in_parts(like):
        return tensor
    from torch.distributed.tensor import distribute_tensor

    # Without a source: every process has the whole, so that nothing is sent.
    return distribute_tensor(tensor, like.device_mesh, like.placements, src_data_rank=None)


def place(tensor: Tensor) -> tuple[object, ...]:
    """Equal for tensors that are the same memory, seen in the same way."""
    local = tensor.to_local() if in_parts(tensor) else tensor
    # Not its address, which is 0 for every part without a row: ranks would ask for different tensors.
    storage = local.untyped_storage()._cdata
    return storage, local.storage_offset(), tensor.shape, tensor.stride()


def optimizer_state(optimizer: torch.optim.Optimizer) -> dict[str, dict[str, torch.Tensor]]:
    """A copy on the CPU of an optimiser's state, by the number of the parameter; without learning rates.

    All of it is float32, which NumPy knows: of a parameter in bfloat16 it is in bfloat16.
    """
    known: dict[int, dict[str, Any]] = optimizer.state_dict()["state"]
    copies: dict[str, dict[str, Tensor]] = {}
    for number, values in known.items():
        copies[str(number)] = {
            name: copy_of(torch.as_tensor(value)).float() for name, value in values.items()
        }
    return copies


def restore_optimizer(optimizer: torch.optim.Optimizer, state: dict[str, dict[str, torch.Tensor]]) -> None:
    """Restore what `optimizer_state` has returned for the same parameters."""
    parameters: list[Tensor] = []
    for group in optimizer.param_groups:
        parameters += group["params"]
    parts: dict[int, dict[str, Tensor]] = {}
    for text, values in state.items():
        number = int(text)
        parts[number] = dict(values)
        for name, value in values.items():
            if value.dim():  # the number of steps has no dimension and is the same for every process
                parts[number][name] = part_of(value, parameters[number])
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": parts, "param_groups": groups})


def copied(module: torch.nn.Module) -> dict[str, torch.Tensor]:
    """A copy on the CPU of a module's state, by name."""
    copies = {}
    for name, tensor in module.state_dict().items():
        copies[name] = copy_of(tensor)
    return copies


def fixed(values: Tensor) -> nn.Parameter:
    """A float32 parameter without gradient: numbers that are saved and published, and not learned."""
    return nn.Parameter(values.detach().clone().float(), requires_grad=False)


@torch.no_grad()
def follow(slow: nn.Module, fast: nn.Module, share: float) -> None:
    """Moves the parameters of a slow copy by this share of the way to those of `fast`."""
    for target, source in zip(slow.parameters(), fast.parameters(), strict=True):
        target.lerp_(source, share)
