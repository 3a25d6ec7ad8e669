# SPDX-License-Identifier: Apache-2.0
"""Checkpoints in LeRobot's own format, with what is ours beside it, so that stock `lerobot-eval` runs them.

Ours are ``accerl.json``, ``value_head.safetensors``, ``family.safetensors``, and the folder `layout.BACKBONE`
with a backbone's config and tokenisers, which LeRobot looks up by Hub id or absolute path. The folder goes
first when one of our checkpoints is loaded: no Hub, and no gate such as PaliGemma's. Names in the files stay
as they were where they are Hub ids, so that stock LeRobot loads the checkpoint as it loaded the original;
local paths are set to the folder by `layout.relocate`.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import draccus
from safetensors.torch import save_file
from torch import Tensor

from accerl_lerobot.checkpoint.layout import BACKBONE, FAST, relocate
from accerl_lerobot.checkpoint.tensors import place, whole
from accerl_lerobot.policies.config import PolicyConfig, SamplerConfig
from accerl_lerobot.policies.guard import FAMILY, OURS, VALUE_HEAD
from accerl_lerobot.policies.tuning import merged_state_dict

if TYPE_CHECKING:
    from accerl_lerobot.policies.adapter import LeRobotAdapter


class Weights(NamedTuple):
    """All of an adapter's, on the CPU, under the names that LeRobot gives them."""

    policy: dict[str, Tensor]
    value_head: dict[str, Tensor]
    family: dict[str, Tensor]


def copy_weights(adapter: LeRobotAdapter) -> Weights:
    """A copy to be saved while the adapter is trained on."""
    modules = (adapter.value_head, adapter.family)
    policy = merged_state_dict(adapter.policy) or adapter.policy.state_dict()
    return Weights(_copied(policy), *(_copied(module.state_dict()) for module in modules))


def save_pretrained(
    adapter: LeRobotAdapter, directory: Path, config: PolicyConfig, weights: Weights | None = None
) -> None:
    """Writes LeRobot's ``pretrained_model`` layout, and what is ours beside it, into `directory`.

    Args:
        config: what the adapter was loaded by.
        weights: from `copy_weights`; None: the adapter's current ones.
    """
    weights = weights or copy_weights(adapter)
    directory.mkdir(parents=True, exist_ok=True)
    _save_backbone(adapter.policy.config, adapter.processing.preprocessor, directory)
    adapter.policy.save_pretrained(directory, state_dict=weights.policy)
    adapter.processing.preprocessor.save_pretrained(directory)
    adapter.processing.postprocessor.save_pretrained(directory)
    relocate(directory, directory)
    for name, tensors in ((VALUE_HEAD, weights.value_head), (FAMILY, weights.family)):
        if tensors:
            save_file(tensors, directory / name)
    ours = {
        "sampler": draccus.encode(adapter.family.sampler, SamplerConfig),
        "value_head": asdict(config.value_head),
        "rename_map": config.rename_map,
    }
    (directory / OURS).write_text(json.dumps(ours, indent=2) + "\n")


def _save_backbone(lerobot_config: Any, preprocessor: Any, directory: Path) -> None:
    """Writes the backbone folder of a checkpoint in `directory`, unless its backbone is on the Hub."""
    if not hasattr(lerobot_config, "vlm_model_name"):
        for step in preprocessor.steps:
            if (tokenizer := getattr(step, "input_tokenizer", None)) is not None:
                tokenizer.save_pretrained(directory / BACKBONE)
            if (tokenizer := getattr(step, "action_tokenizer", None)) is not None:
                tokenizer.save_pretrained(directory / FAST)
        return
    source = Path(lerobot_config.vlm_model_name)
    if source.is_absolute() and source.resolve() != (directory / BACKBONE).resolve():
        # The policy's own file holds the backbone's weights, unless LeRobot builds it from the backbone's.
        weights = () if lerobot_config.load_vlm_weights else ("*.safetensors", "*.bin", "*.pt", "*.pth")
        ignore = shutil.ignore_patterns(*weights)
        shutil.copytree(source, directory / BACKBONE, ignore=ignore, dirs_exist_ok=True)


def _copied(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Copies on the CPU; what shared its memory shares it again, so that it is written once."""
    places = {name: place(t) for name, t in tensors.items()}
    kept = {places[name]: t for name, t in tensors.items()}
    copies = {at: whole(t.detach()).to("cpu", copy=True).contiguous() for at, t in kept.items()}
    return {name: copies[at] for name, at in places.items()}
