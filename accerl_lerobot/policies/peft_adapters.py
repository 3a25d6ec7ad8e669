# SPDX-License-Identifier: Apache-2.0
"""Adapters of ``lerobot-train --peft.method_type=…``, which are added to the weights of their policy.

LeRobot keeps such an adapter in a folder without the policy's weights. Here both become one policy, which is
trained and saved as any other.
"""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

from accerl_lerobot.checkpoint.safety import FileSource, read_json, read_tensors, tensor_shapes
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.untrusted import ADAPTER, ADAPTER_CONFIG, fetched_checkpoint, is_adapter


def weights_folder(folder: Path, origin: FileSource) -> Path:
    """The folder with all of a policy's weights: `folder` itself, or, of an adapter, the policy it is for."""
    if not is_adapter(folder):
        return folder
    stored = read_json(folder / ADAPTER_CONFIG, origin)
    base, revision = stored.get("base_model_name_or_path"), stored.get("revision")
    if not base or not isinstance(base, str) or not isinstance(revision, str | None):
        why = "names no policy that the adapter is for; train it anew from a checkpoint"
        raise origin.refuse(f"{ADAPTER_CONFIG}: base_model_name_or_path", why)
    try:
        found = fetched_checkpoint(base, revision, origin.field)
    except InputError as error:
        why = f"{base!r}, the policy that the adapter is for: {error.hint}"
        raise origin.refuse(f"{ADAPTER_CONFIG}: base_model_name_or_path", why) from error
    if is_adapter(found):
        why = f"{base!r} is an adapter itself, which LeRobot does not load; train one on a whole policy"
        raise origin.refuse(f"{ADAPTER_CONFIG}: base_model_name_or_path", why)
    return found


def merged(policy: Any, folder: Path, origin: FileSource) -> Any:
    """The policy with the adapter in `folder` added to its weights; what was trainable in it is again."""
    from peft import PeftModel, get_peft_model_state_dict

    trainable = {name for name, parameter in policy.named_parameters() if parameter.requires_grad}
    stored = tensor_shapes(folder / ADAPTER, origin)
    deque(read_tensors(folder / ADAPTER, origin), maxlen=0)  # refuses NaN
    wrapped = PeftModel.from_pretrained(policy, str(folder), torch_device="cpu")
    if differing := sorted(get_peft_model_state_dict(wrapped).keys() ^ stored.keys()):
        why = f"{len(differing)} tensors are missing or unexpected, such as {differing[0]}"
        raise origin.refuse(ADAPTER, f"{why}; {ADAPTER_CONFIG} and this file disagree")
    policy = wrapped.merge_and_unload()
    for name, parameter in policy.named_parameters():
        parameter.requires_grad_(name in trainable)
    return policy
