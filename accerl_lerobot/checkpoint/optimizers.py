# SPDX-License-Identifier: Apache-2.0
"""The state of torch's modules and optimisers, as trees of tensors, see `snapshot`."""

from __future__ import annotations

from typing import Any

import torch

from accerl_lerobot.checkpoint.tensors import part_of, whole


def optimizer_state(optimizer: torch.optim.Optimizer) -> dict[int, dict[str, torch.Tensor]]:
    """A copy of what it knows of each parameter, in order; rates are not its own."""
    known: dict[int, dict[str, Any]] = optimizer.state_dict()["state"]
    return {
        place: {name: whole(torch.as_tensor(value).detach()).clone() for name, value in of.items()}
        for place, of in known.items()
    }


def restore_optimizer(optimizer: torch.optim.Optimizer, state: dict[int, dict[str, torch.Tensor]]) -> None:
    """Sets it to what `optimizer_state` gave of one for the same parameters."""
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    mine = {
        # What has no dimension, the number of steps, is everybody's and stays where it is.
        at: {name: part_of(value, parameters[at]) if value.dim() else value for name, value in of.items()}
        for at, of in state.items()
    }
    optimizer.load_state_dict({"state": mine, "param_groups": optimizer.state_dict()["param_groups"]})


def copied(module: torch.nn.Module) -> dict[str, torch.Tensor]:
    """A copy of its weights and buffers."""
    return {name: tensor.detach().clone() for name, tensor in module.state_dict().items()}
