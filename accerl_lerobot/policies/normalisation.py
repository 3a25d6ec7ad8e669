# SPDX-License-Identifier: Apache-2.0
"""Statistics that a checkpoint's processors normalise by.

LeRobot passes a tensor on as it is where a normaliser has no statistics under its name. Here such a
checkpoint is refused, and one whose statistics do not fit what the policy reads.
"""

from __future__ import annotations

import json
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from accerl_lerobot.checkpoint.layout import PREPROCESSOR
from accerl_lerobot.checkpoint.safety import FileSource, read_tensors, tensor_shapes
from accerl_lerobot.policies.features import ACTION, STATE, STATISTICS, pads, policy_features
from accerl_lerobot.policies.untrusted import PROCESSORS

logger = logging.getLogger(__name__)

NORMALISERS = ("normalizer_processor", "unnormalizer_processor")
FINE_TUNE = "fine-tuning it on a dataset (sft.init_path) computes new ones"


def stored_steps(folder: Path, name: str = PREPROCESSOR) -> list[dict[str, Any]]:
    """Steps of a processor that has been checked; none if the file is missing."""
    return json.loads((folder / name).read_text())["steps"] if (folder / name).is_file() else []


def correct_inputs(lerobot_config: Any, folder: Path, origin: FileSource) -> None:
    """Gives a policy that pads the inputs that it was trained on, by the statistics that it normalises by.

    LeRobot's fine-tuning leaves those of the policy that it started from in ``config.json``, whatever states
    and cameras the dataset had.
    """
    if not pads(lerobot_config):
        return
    seen: dict[str, tuple[int, ...]] = {}
    renames: dict[str, str] = {}
    for step in stored_steps(folder):
        renames |= step.get("config", {}).get("rename_map", {})
        if step["registry_name"] == "normalizer_processor" and "state_file" in step:
            for key, (_, shape) in tensor_shapes(folder / step["state_file"], origin).items():
                name, _, statistic = key.rpartition(".")
                if statistic == "mean":
                    seen[renames.get(name, name)] = shape
    inputs = lerobot_config.input_features
    shapes = policy_features(lerobot_config).shapes
    cameras = {name for name, shape in shapes.items() if len(shape) == 3}
    if cameras & seen.keys():
        for name in cameras - seen.keys():
            del inputs[name]
    if STATE in inputs and STATE in seen:
        inputs[STATE] = replace(inputs[STATE], shape=seen[STATE])


def check_statistics(
    lerobot_config: Any, folder: Path, origin: FileSource, *, replaced: bool = False
) -> None:
    """Checks the numbers that a checkpoint's processors normalise by against the policy's features.

    If they are `replaced` by those of a training to come, they have to be finite only.
    """
    features = {**(lerobot_config.input_features or {}), **(lerobot_config.output_features or {})}
    for processor in PROCESSORS:
        originals: dict[str, str] = {}
        for step in stored_steps(folder, processor):
            options, file = step.get("config", {}), step.get("state_file")
            for old, new in options.get("rename_map", {}).items():
                originals[new] = old
            state = dict(read_tensors(folder / file, origin)) if file is not None else {}
            if step["registry_name"] not in NORMALISERS or replaced:
                continue
            for key in _normalised(step["registry_name"], options, features):
                mode = options.get("norm_map", {}).get(features[key].type.value)
                # Of an input that LeRobot's trainer renamed it took no statistics: it was trained as it is.
                if mode in STATISTICS and f"{originals.get(key)}.{STATISTICS[mode][0]}" not in state:
                    _check_feature(key, features[key], mode, state, origin, file or processor)


def _normalised(step: str, options: dict[str, Any], features: dict[str, Any]) -> list[str]:
    """Names of the features that a step changes when the policy acts."""
    if step == "unnormalizer_processor":
        return [ACTION] if ACTION in features else []
    chosen = options.get("normalize_observation_keys") or options.get("features", {})
    return [key for key in features if key in chosen and key != ACTION and ".empty_camera_" not in key]


def _check_feature(
    key: str, feature: Any, mode: str, state: dict[str, Tensor], origin: FileSource, file: str
) -> None:
    picture, names = feature.type.name == "VISUAL", STATISTICS[mode]
    found = [state[f"{key}.{name}"] for name in names if f"{key}.{name}" in state]
    if len(found) < 2:
        has = sorted({name.rpartition(".")[0] for name in state})
        why = f"no {' and '.join(names)} of {key}, by which the policy normalises"
        why += f"; it has {', '.join(has[:6]) or 'none'}"
        if picture and not any("image" in name for name in has):
            logger.warning("%s; pictures go in as they are", origin.refuse(file, why))
            return
        raise origin.refuse(file, f"{why}; {FINE_TUNE}")
    for name, value in zip(names, found, strict=True):
        if not _fits(value, tuple(feature.shape), picture):
            sizes = f"of shape {tuple(value.shape)}, where the policy has {tuple(feature.shape)}"
            raise origin.refuse(file, f"{key}.{name} is {sizes}; {FINE_TUNE}")
    low, high = found
    spread = high if mode == "MEAN_STD" else high - low
    if (spread < 0).any() or (picture and not spread.all()):
        divisor = "std" if mode == "MEAN_STD" else " to ".join(names)
        raise origin.refuse(file, f"{divisor} of {key} is not above 0, and is divided by; {FINE_TUNE}")


def _fits(value: Tensor, shape: tuple[int, ...], picture: bool) -> bool:
    """True if a statistic can be applied to a feature of this shape; one of a picture is for each channel."""
    if picture and value.ndim == 1:
        value = value.reshape(-1, 1, 1)
    try:
        return torch.broadcast_shapes(value.shape, shape) == shape
    except RuntimeError:
        return False
