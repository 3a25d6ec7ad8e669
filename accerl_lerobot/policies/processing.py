# SPDX-License-Identifier: Apache-2.0
"""LeRobot's processors of a checkpoint: names, tokenisers and the numbers that they normalise by.

LeRobot passes a tensor on as it is where a normaliser has no statistics under its name. Here such a
checkpoint is refused.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs.types import FeatureType, NormalizationMode
from lerobot.policies.factory import make_pre_post_processors
from lerobot.processor import NormalizerProcessorStep, UnnormalizerProcessorStep
from torch import Tensor, nn

from accerl_lerobot.checkpoint.layout import CONFIG_FOLDERS, PREPROCESSOR, STEP_FOLDERS
from accerl_lerobot.checkpoint.safety import FileSource, tensor_shapes
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Observations
from accerl_lerobot.policies.features import ACTION, STATE, Shapes, cameras, pads, policy_features
from accerl_lerobot.policies.untrusted import CONFIG

logger = logging.getLogger(__name__)

IMAGES = "observation.image"  # begins ``observation.images.<camera>``; LeRobot's name for a lone camera
CONSTANT = 1e-6  # environment units in one normalised unit, below which an action counts as constant
ACTION_TOKENIZER = "action_tokenizer_processor"
STATISTICS = {
    NormalizationMode.MEAN_STD: ("mean", "std"),
    NormalizationMode.MIN_MAX: ("min", "max"),
    NormalizationMode.QUANTILES: ("q01", "q99"),
    NormalizationMode.QUANTILE10: ("q10", "q90"),
}
"""LeRobot's modes of normalisation → the statistics that they read."""


@dataclass
class Processing:
    """LeRobot's pre- and post-processor, which tokenise and normalise, fed with raw observations."""

    preprocessor: Any
    postprocessor: Any
    device: torch.device
    rename_map: dict[str, str]
    width: int = 0  # of the actions that the postprocessor has statistics of; 0: it has none

    def prepare(self, observations: Observations, tasks: Sequence[str]) -> dict[str, Tensor]:
        """Normalised and tokenised observations."""
        return self.preprocessor({"task": list(tasks), **self.tensors(observations)})

    def tensors(self, observations: Observations) -> dict[str, Tensor]:
        """By the policy's names; images go from uint8 (..., H, W, 3) to float (..., 3, H, W) in [0, 1]."""
        batch: dict[str, Tensor] = {}
        for key, array in observations.items():
            tensor = torch.from_numpy(np.ascontiguousarray(array)).to(self.device)
            if key.startswith(IMAGES):
                tensor = tensor.movedim(-1, -3).contiguous().float() / 255.0
            batch[self.rename_map.get(key, key)] = tensor
        return batch

    def unnormalise(self, chunk: Tensor) -> Tensor:
        """(B, K, A) from normalised to environment units.

        A policy that pads its actions has statistics of the padding, too, which its postprocessor removes.
        """
        padding = max(0, self.width - chunk.shape[-1])
        return self.postprocessor(nn.functional.pad(chunk, (0, padding)))

    def units(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Place of a normalised 0 in environment units, and length of a normalised 1, like `rows` (K, A)."""
        ends = torch.stack([torch.zeros_like(rows), torch.ones_like(rows)])
        zero, one = self.unnormalise(ends.to(self.device)).to(rows)
        return zero, one - zero

    def normalise(self, chunk: Tensor) -> Tensor:
        """(B, K, A) from environment to normalised units; every normalisation that LeRobot has is affine.

        An action that is constant in the policy's dataset has no scale; it is 0.
        """
        zero, scale = self.units(chunk[0])
        varies = scale.abs() > CONSTANT
        divisor = torch.where(varies, scale, 1)
        return torch.where(varies, (chunk - zero) / divisor, 0)


def load_processors(policy_config: Any, folder: Path, rename_map: dict[str, str]) -> Processing:
    """The processors of a checkpoint that has been checked; `policy_config` is LeRobot's, with its device."""
    device = policy_config.device
    steps = stored_steps(folder)
    kinds = [step["registry_name"] for step in steps]
    overrides: dict[str, dict[str, Any]] = {"device_processor": {"device": device}}
    for kind, (option, own) in STEP_FOLDERS.items():
        if kind in kinds and (folder / own).is_dir():
            overrides[kind] = {option: str((folder / own).resolve())}
    if ACTION_TOKENIZER in kinds:  # LeRobot does not save these two of its options
        options = overrides.setdefault(ACTION_TOKENIZER, {})
        options["paligemma_tokenizer_name"] = policy_config.text_tokenizer_name
        options["fast_skip_tokens"] = policy_config.fast_skip_tokens
    pre, post = make_pre_post_processors(
        policy_config, pretrained_path=str(folder), preprocessor_overrides=overrides
    )
    for loaded, step in zip(pre.steps, steps, strict=True):
        kind = step["registry_name"]
        if kind in STEP_FOLDERS:  # what is saved has the names that the checkpoint has
            option, _ = STEP_FOLDERS[kind]
            setattr(loaded, option, step["config"].get(option))
    return Processing(pre, post, torch.device(device), rename_map, _statistics_width(post))


def _statistics_width(postprocessor: Any) -> int:
    """Number of actions that a postprocessor has statistics of; 0 if it has none."""
    width = 0
    for step in postprocessor.steps:
        for name, tensor in step.state_dict().items():
            if name.startswith(ACTION):
                width = max([width, *tensor.shape[-1:]])
    return width


def use_own_files(policy_config: Any, folder: Path, source: FileSource) -> dict[str, str]:
    """Points LeRobot's policy config at the backbone and tokenisers in a checkpoint's folder.

    Returns:
        The tokenisers' former names by their fields, which what is saved has again.
    """
    former: dict[str, str] = {}
    for field, own in CONFIG_FOLDERS.items():
        name = getattr(policy_config, field, None)
        if name is None:
            continue
        if field != "vlm_model_name":
            former[field] = name
        if (folder / own).is_dir():
            setattr(policy_config, field, str((folder / own).resolve()))
        elif Path(name).is_absolute() and not Path(name).is_dir():
            hint = f"its files were in {name}, which is gone; put a copy into {own}/ beside {CONFIG}"
            raise InputError(source.field, source.value, hint)
    return former


def stored_steps(folder: Path) -> list[dict[str, Any]]:
    """Steps of a preprocessor that has been checked; none if the file is missing."""
    file = folder / PREPROCESSOR
    if not file.is_file():
        return []
    return json.loads(file.read_text())["steps"]


def correct_inputs(policy_config: Any, folder: Path, source: FileSource) -> None:
    """Gives a policy that pads the inputs that it was trained on, by the statistics that it normalises by.

    LeRobot's fine-tuning leaves those of the policy that it started from in ``config.json``, whatever states
    and cameras the dataset had.
    """
    if not pads(policy_config):
        return
    seen: Shapes = {}
    renames: dict[str, str] = {}
    padded = False
    for step in stored_steps(folder):
        options = step.get("config", {})
        renames |= options.get("rename_map", {})
        padded |= "max_state_dim" in options
        if step["registry_name"] == "normalizer_processor" and "state_file" in step:
            shapes = tensor_shapes(folder / step["state_file"], source)
            for key, (_, shape) in shapes.items():
                name = key.removesuffix(".mean")
                seen[renames.get(name, name)] = shape
            if padded:  # a state that a step before has padded has statistics of the padding, too
                seen.pop(STATE, None)
    inputs = policy_config.input_features
    needed = cameras(policy_features(policy_config).shapes)
    if needed & seen.keys():
        for name in needed - seen.keys():
            del inputs[name]
    if STATE in inputs and STATE in seen:
        inputs[STATE] = replace(inputs[STATE], shape=seen[STATE])


def check_statistics(
    processing: Processing, policy_config: Any, source: FileSource, *, replaced: bool = False
) -> None:
    """Refuses processors that lack numbers that they normalise by, or hold NaN.

    None are needed if they are `replaced` by those of a training to come.
    """
    features = (policy_config.input_features or {}) | (policy_config.output_features or {})
    for step in (*processing.preprocessor.steps, *processing.postprocessor.steps):
        state = step.state_dict()
        for name, tensor in state.items():
            if not torch.isfinite(tensor).all():
                raise source.refuse(name, "its processors hold NaN or infinity; train it again")
        if replaced or type(step) not in (NormalizerProcessorStep, UnnormalizerProcessorStep):
            continue
        chosen = {ACTION}
        if isinstance(step, NormalizerProcessorStep):
            keys = step.normalize_observation_keys  # None: all
            chosen = set(step.features if keys is None else keys) - chosen
        for name in sorted(chosen & features.keys()):
            mode = step.norm_map.get(features[name].type)
            needed = STATISTICS.get(mode, ())
            complete = all(f"{name}.{statistic}" in state for statistic in needed)
            if complete or ".empty_camera_" in name:
                continue
            has = ", ".join(sorted(step.stats)[:6]) or "none"
            why = f"no {' and '.join(needed)} of it, by which the policy normalises; it has {has}"
            if features[name].type != FeatureType.VISUAL:
                hint = "fine-tuning it on a dataset (sft.init_path) computes new ones"
                raise source.refuse(name, f"{why}; {hint}")
            logger.warning("%s; pictures go in as they are", source.refuse(name, why))
