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
"""Proof that a policy's weights are the file's.

LeRobot loads non-strictly, and π0's loaders print what went wrong and return whatever did load over random
weights. So every tensor of the policy is compared with the file once it is there.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.family import Model

NAMED = 3
"""Tensors of a kind that an error names."""


def verify_weights(policy: Any, model: type[Model], file: Path, path: str | None) -> None:
    """Compares all tensors with the file.

    Args:
        policy: LeRobot's, as loaded.
        model: knows which of its tensors a file may lack.
        file: the safetensors.
        path: what the user called the checkpoint.

    Raises:
        InputError: a tensor is missing, unexpected, of another shape, or differs.
    """
    try:
        stored = _as_loaded(load_file(file), policy)
    except (OSError, SafetensorError) as error:
        remedy = f"the weights did not load ({' '.join(str(error).split())})"
        raise InputError("policy.path", path, remedy) from error
    loaded = policy.state_dict()
    # Nor is a tensor missing that a policy holds under several names: savers keep one of them.
    held = {loaded[k].data_ptr() for k in stored.keys() & loaded.keys()}
    absent = loaded.keys() - stored.keys() - set(model.unread)
    missing = sorted(k for k in absent if loaded[k].data_ptr() not in held)
    unexpected = sorted(stored.keys() - loaded.keys())
    if missing or unexpected:
        counts = f"{len(missing)} tensors missing {missing[:NAMED]}, {len(unexpected)} unexpected "
        remedy = f"{counts}{unexpected[:NAMED]}; config.json and {file.name} disagree"
        raise InputError("policy.path", path, f"the weights did not load: {remedy}")
    for name, tensor in stored.items():
        mine = loaded[name].cpu()
        if mine.shape != tensor.shape:
            sizes = f"{tuple(tensor.shape)} in the file, {tuple(mine.shape)} in the policy"
            remedy = f"the weights did not load: size mismatch for {name}, {sizes}"
            raise InputError("policy.path", path, remedy)
        if not torch.equal(mine, tensor.to(mine.dtype)):
            remedy = f"the weights did not load: {name} differs from the file, or holds a NaN"
            raise InputError("policy.path", path, remedy)


def _as_loaded(stored: dict[str, Tensor], policy: Any) -> dict[str, Tensor]:
    """The file's tensors under the names that LeRobot's loader of this policy gives them.

    π0's reads files of openpi as well: without the leading ``model.``, with other names for some layers, and
    with the input embedding left out where it equals the output layer. It takes the one for the other also
    where both are there, if they come in the wrong order; such a file is refused.
    """
    rename = getattr(policy, "_fix_pytorch_state_dict_keys", None)
    if rename is None:
        return stored
    renamed = _prefixed(rename(stored, policy.config))
    return renamed | {k: v for k, v in _prefixed(stored).items() if k in renamed}


def _prefixed(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    return {k if k.startswith("model.") else f"model.{k}": v for k, v in tensors.items()}
