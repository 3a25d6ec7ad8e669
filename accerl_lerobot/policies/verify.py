# SPDX-License-Identifier: Apache-2.0
"""Weights of a policy, read from a checkpoint tensor by tensor.

LeRobot's own loaders hold the file beside the network, take what fits and leave the rest at random, some of
them after printing what went wrong. Here the two have to hold the same tensors, of the same shapes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from accerl_lerobot.checkpoint.safety import Origin, read_tensors, tensor_shapes
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.family import Model

NAMED = 3
"""Tensors of a kind that an error names."""


class _Name(str):
    """The name of a tensor in its place, for LeRobot's functions that rename the keys of a dict."""

    def clone(self) -> _Name:
        return self


@torch.no_grad()
def load_weights(policy: Any, model: type[Model], file: Path, path: str | None, *, read: bool = True) -> None:
    """Fills a policy from a file.

    Args:
        policy: LeRobot's, just built.
        model: knows which of its tensors a file may lack.
        file: the safetensors.
        path: what the user called the checkpoint.
        read: False: only names and shapes are compared.

    Raises:
        InputError: a tensor is missing, unexpected, of another shape, or holds NaN or infinity.
    """
    origin = Origin("policy.path", path)
    shapes = {name: shape for name, (_, shape) in tensor_shapes(file, origin).items()}
    mine, stored = policy.state_dict(), _names(shapes, policy)
    # Nor is a tensor missing that a policy holds under several names: savers keep one of them.
    held = {mine[k].data_ptr() for k in stored.keys() & mine.keys()}
    absent = mine.keys() - stored.keys() - set(model.unread)
    missing = sorted(k for k in absent if mine[k].data_ptr() not in held)
    unexpected = sorted(stored.keys() - mine.keys())
    if missing or unexpected:
        counts = f"{len(missing)} tensors missing {missing[:NAMED]}, {len(unexpected)} unexpected "
        remedy = f"{counts}{unexpected[:NAMED]}; config.json and {file.name} disagree"
        raise InputError("policy.path", path, f"the weights did not load: {remedy}")
    places: dict[str, list[str]] = {}
    for name, theirs in stored.items():
        if mine[name].shape != shapes[theirs]:
            sizes = f"{shapes[theirs]} in the file, {tuple(mine[name].shape)} in the policy"
            remedy = f"the weights did not load: size mismatch for {name}, {sizes}"
            raise InputError("policy.path", path, remedy)
        places.setdefault(theirs, []).append(name)
    if read:
        for theirs, tensor in read_tensors(file, origin):
            for name in places.get(theirs, ()):
                mine[name].copy_(tensor)


def _names(shapes: dict[str, Any], policy: Any) -> dict[str, str]:
    """Name of a policy's tensor → name in the file, as LeRobot's loader of this policy has it.

    π0's reads files of openpi as well: without the leading ``model.``, with other names for some layers, and
    with the input embedding left out where it equals the output layer.
    """
    stored: dict[str, str] = {name: _Name(name) for name in shapes}
    rename = getattr(policy, "_fix_pytorch_state_dict_keys", None)
    if rename is None:
        return stored
    renamed = _prefixed(rename(stored, policy.config))
    # What a file has under its own name goes before what is taken for it.
    return renamed | {k: v for k, v in _prefixed(stored).items() if k in renamed}


def _prefixed(names: dict[str, str]) -> dict[str, str]:
    return {k if k.startswith("model.") else f"model.{k}": v for k, v in names.items()}
