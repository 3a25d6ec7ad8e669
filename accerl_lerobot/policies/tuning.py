# SPDX-License-Identifier: Apache-2.0
"""The trained part of a policy's weights, and low-rank adapters merged into plain weights."""

from __future__ import annotations

import re
from typing import Any

from torch import Tensor, nn

from accerl_lerobot.checkpoint.tensors import whole
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import TuningConfig
from accerl_lerobot.policies.family import Model


def tune(policy: Any, model: Model, config: TuningConfig) -> None:
    """Sets what is trainable in `policy`; puts low-rank adapters in, for ``lora``.

    Raises:
        InputError: the policy has no expert, or ``lora`` targets nothing in it.
    """
    if config.mode == "full":
        policy.requires_grad_(True)
    elif config.mode == "expert":
        if model.backbone is None:
            remedy = f"{policy.name} has no action expert apart from a backbone; use full or lora"
            raise InputError("policy.tuning.mode", "expert", remedy)
        for name, parameter in policy.named_parameters():
            parameter.requires_grad_(not name.startswith(model.backbone))
    elif config.mode == "lora":
        _inject(policy, config)
    for name, parameter in policy.named_parameters():
        if name.startswith(model.idle):
            parameter.requires_grad_(False)


def subtract_adapters(policy: nn.Module) -> None:
    """Takes low-rank adapters out of weights that they were added to already, and sets them to nothing."""
    from peft.tuners.lora import Linear

    for layer in (module for module in policy.modules() if isinstance(module, Linear)):
        weight = layer.base_layer.weight
        weight -= layer.get_delta_weight("default").to(weight)
        layer.lora_B["default"].weight.zero_()


def merged_state_dict(policy: nn.Module) -> dict[str, Tensor] | None:
    """The weights with low-rank adapters added in, under their plain names; None where there are none."""
    if not any(".lora_" in name for name, _ in policy.named_parameters()):
        return None
    from peft.tuners.lora import Linear

    # Under every name: a module that a policy holds twice is in its state twice.
    modules = policy.named_modules(remove_duplicate=False)
    layers = {name: m for name, m in modules if isinstance(m, Linear)}
    state = {k: v for k, v in policy.state_dict().items() if ".lora_" not in k}
    for name, layer in layers.items():
        weight = state[f"{name}.base_layer.weight"]
        state[f"{name}.base_layer.weight"] = weight + layer.get_delta_weight("default").to(weight)
    return {k.replace(".base_layer.", "."): whole(v.detach()).cpu().contiguous() for k, v in state.items()}


def _inject(policy: Any, config: TuningConfig) -> None:
    from peft import LoraConfig, inject_adapter_in_model

    targets = config.targets or (policy._get_default_peft_targets() or {}).get("target_modules")
    if targets is None:
        remedy = f"LeRobot names no default for {policy.name}; give a regular expression of module names"
        raise InputError("policy.tuning.targets", None, remedy)
    # Not its subclasses: attention reads the weight of its own without calling it, past any adapter.
    linear = [name for name, module in policy.named_modules() if type(module) is nn.Linear]
    matching = [name for name in linear if re.fullmatch(targets, name)]
    if not matching:
        some = ", ".join(linear[:: max(1, len(linear) // 3)][:3])
        remedy = f"matches none of the policy's {len(linear)} linear layers, such as {some}"
        raise InputError("policy.tuning.targets", targets, remedy)
    policy.requires_grad_(False)
    lora = LoraConfig(r=config.rank, lora_alpha=config.alpha, target_modules=matching, lora_dropout=0.0)
    inject_adapter_in_model(lora, policy)
