# SPDX-License-Identifier: Apache-2.0
"""Checkpoints in LeRobot's own format, with what is ours beside it, so that stock `lerobot-eval` runs them.

Ours are ``value_head.safetensors``, ``family.safetensors``, and the folder `layout.BACKBONE`
with a backbone's config and tokenisers, which LeRobot looks up by Hub id or absolute path. The folder goes
first when one of our checkpoints is loaded: no Hub, and no gate such as PaliGemma's. Names in the files stay
as they were where they are Hub ids, so that stock LeRobot loads the checkpoint as it loaded the original;
local paths are set to the folder by `layout.relocate`.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

from safetensors.torch import save_file
from torch import Tensor, nn

from accerl_lerobot.checkpoint.layout import BACKBONE, BACKBONE_FILES, BACKBONE_WEIGHTS, FAST, relocate
from accerl_lerobot.checkpoint.safety import FileSource, matching_files
from accerl_lerobot.checkpoint.tensors import copy_of, place
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import TuningConfig
from accerl_lerobot.policies.processing import Processing


def tune(policy: Any, config: TuningConfig, backbone: str | None = None, idle: tuple[str, ...] = ()) -> None:
    """Sets what is trainable in `policy`; puts low-rank adapters in, for ``lora``.

    `backbone` begins the names of its vision-language backbone's parameters, `idle` of those without a use.

    Raises:
        InputError: the policy has no expert, or ``lora`` targets nothing in it.
    """
    if config.mode == "full":
        policy.requires_grad_(True)
    elif config.mode == "expert":
        if backbone is None:
            hint = f"{policy.name} has no action expert apart from a backbone; use full or lora"
            raise InputError("policy.tuning.mode", "expert", hint)
        for name, parameter in policy.named_parameters():
            parameter.requires_grad_(not name.startswith(backbone))
    elif config.mode == "lora":
        _inject(policy, config)
    for name, parameter in policy.named_parameters():
        if name.startswith(idle):
            parameter.requires_grad_(False)


def _inject(policy: Any, config: TuningConfig) -> None:
    from peft import LoraConfig, inject_adapter_in_model

    targets = config.targets
    if targets is None:
        defaults = policy._get_default_peft_targets() or {}
        targets = defaults.get("target_modules")
    if targets is None:
        hint = f"LeRobot names no default for {policy.name}; give a regular expression of module names"
        raise InputError("policy.tuning.targets", None, hint)
    # Not its subclasses: attention reads the weight of its own without calling it, past any adapter.
    linear = [name for name, module in policy.named_modules() if type(module) is nn.Linear]
    matching = [name for name in linear if re.fullmatch(targets, name)]
    if not matching:
        hint = f"matches none of the policy's {len(linear)} linear layers, such as {', '.join(linear[-3:])}"
        raise InputError("policy.tuning.targets", targets, hint)
    policy.requires_grad_(False)
    lora = LoraConfig(r=config.rank, lora_alpha=config.rank, target_modules=matching, lora_dropout=0.0)
    inject_adapter_in_model(lora, policy)


def merged_state_dict(policy: nn.Module) -> dict[str, Tensor]:
    """The weights, with low-rank adapters added in, under their plain names."""
    state = {name: tensor for name, tensor in policy.state_dict().items() if ".lora_" not in name}
    # Under every name: a module that a policy holds twice is in its state twice.
    for name, layer in policy.named_modules(remove_duplicate=False):
        if hasattr(layer, "get_delta_weight"):  # a low-rank adapter of peft's
            base = f"{name}.base_layer.weight"
            delta = layer.get_delta_weight("default")
            state[base] = state[base] + delta.to(state[base])
    return {name.replace(".base_layer.", "."): tensor.detach() for name, tensor in state.items()}


Weights = dict[str, dict[str, Tensor]]
"""All of an adapter's by part and by the names that LeRobot gives them, on the CPU."""


def copy_state(module: nn.Module) -> dict[str, Tensor]:
    """A copy of `merged_state_dict` on the CPU, to be saved while the module is trained on.

    What shared its memory shares it again, so that it is written once.
    """
    copies: dict[tuple[object, ...], Tensor] = {}  # by the place of the tensor that is copied
    named: dict[str, Tensor] = {}
    for name, tensor in merged_state_dict(module).items():
        at = place(tensor)
        if at not in copies:
            copies[at] = copy_of(tensor).contiguous()
        named[name] = copies[at]
    return named


def save_pretrained(policy: Any, processing: Processing, directory: Path, weights: Weights) -> None:
    """Writes LeRobot's ``pretrained_model`` layout, and ours beside it."""
    directory.mkdir(parents=True, exist_ok=True)
    _save_backbone(policy.config, processing.preprocessor, directory)
    policy.save_pretrained(directory, state_dict=weights["policy"])
    processing.preprocessor.save_pretrained(directory)
    processing.postprocessor.save_pretrained(directory)
    relocate(directory, directory)
    for name, tensors in weights.items():
        if tensors and name != "policy":
            save_file(tensors, directory / f"{name}.safetensors")


def _save_backbone(lerobot_config: Any, preprocessor: Any, directory: Path) -> None:
    """Writes the backbone folder of a checkpoint in `directory`, unless its backbone is on the Hub."""
    if not hasattr(lerobot_config, "vlm_model_name"):
        folders = {"input_tokenizer": BACKBONE, "action_tokenizer": FAST}
        for step in preprocessor.steps:
            for name, folder in folders.items():
                tokenizer = getattr(step, name, None)
                if tokenizer is not None:
                    tokenizer.save_pretrained(directory / folder)
        return
    source = Path(lerobot_config.vlm_model_name)
    target = directory / BACKBONE
    if source.is_absolute() and source.resolve() != target.resolve():
        wanted: tuple[str, ...] = BACKBONE_FILES
        if getattr(lerobot_config, "load_vlm_weights", True):  # else the policy's own file holds them
            wanted += BACKBONE_WEIGHTS
        target.mkdir(exist_ok=True)
        files = matching_files(source, wanted, FileSource("policy.path", str(source)))
        for name, file in files.items():
            shutil.copyfile(file, target / name)
