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
"""A world model on disk: configs as JSON, weights as safetensors, the success model in LeRobot's format.

world_model/
  config.json          what world it is of, how it dreams, and which episodes it has learnt from
  model.safetensors    weights and statistics
  success_model/       a LeRobot reward model
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import draccus
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.config import PixelModelConfig
from accerl_lerobot.world_model.contract import WorldModelSpec
from accerl_lerobot.world_model.pixels import PixelWorldModel
from accerl_lerobot.world_model.success_plugin.modeling_success_pairs import SuccessPairsRewardModel

UNREADABLE = (OSError, KeyError, TypeError, ValueError, RuntimeError, SafetensorError)
CONFIG, WEIGHTS, SUCCESS = "config.json", "model.safetensors", "success_model"


@dataclass(frozen=True, kw_only=True)
class Source:
    """Which episodes of which dataset a world model knows."""

    repo_id: str
    fingerprint: str
    """Of the dataset, whatever it is called, see `dataset.fingerprint`."""
    learnt: tuple[int, ...]
    """Indices of episodes that it has learnt from,"""
    held_out: tuple[int, ...]
    """and of those that it was only tried on."""


def save_world_model(
    directory: Path,
    model: PixelWorldModel,
    success: SuccessPairsRewardModel | None = None,
    source: Source | None = None,
) -> None:
    """Writes all of it into a folder that does not exist."""
    directory.mkdir(parents=True)
    spec = asdict(model.spec) | {"provides": sorted(model.spec.provides)}
    content = {"spec": spec, "model": draccus.encode(model.config)}
    content |= {} if source is None else {"source": asdict(source)}
    (directory / CONFIG).write_text(json.dumps(content, indent=2) + "\n")
    save_file({k: v.contiguous() for k, v in model.state_dict().items()}, directory / WEIGHTS)
    if success is not None:
        success.save_pretrained(directory / SUCCESS)


def load_source(directory: Path, field: str = "path") -> Source | None:
    """What a saved world model has learnt from; None if it does not say. `field` is named in the error.

    Raises:
        InputError: it says something else.
    """
    try:
        content = json.loads((directory / CONFIG).read_text()).get("source")
        if content is None:
            return None
        return Source(
            repo_id=str(content["repo_id"]),
            fingerprint=str(content["fingerprint"]),
            learnt=tuple(map(int, content["learnt"])),
            held_out=tuple(map(int, content["held_out"])),
        )
    except UNREADABLE as error:
        raise InputError(
            field, str(directory), f"its {CONFIG} does not say what it learnt ({error})"
        ) from error


def load_world_model(
    directory: Path, field: str = "path"
) -> tuple[PixelWorldModel, SuccessPairsRewardModel | None]:
    """Reads what `save_world_model` wrote; both serve, neither is in training.

    Args:
        directory: the folder.
        field: that named it, for the error.

    Raises:
        InputError: it is not there, its weights are not those of its config, or its success model is broken.
    """
    try:
        content = json.loads((directory / CONFIG).read_text())
        spec = content["spec"]
        spec |= {k: tuple(spec[k]) for k in ("cameras", "image_size")} | {
            "provides": frozenset(spec["provides"])
        }
        model = PixelWorldModel(WorldModelSpec(**spec), draccus.decode(PixelModelConfig, content["model"]))
        model.load_state_dict(load_file(directory / WEIGHTS))
    except (*UNREADABLE, draccus.utils.DraccusException) as error:
        first = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(
            field, str(directory), f"not a world model of accerl world-model ({first})"
        ) from error
    success = None
    if (directory / SUCCESS).is_dir():
        try:
            success = SuccessPairsRewardModel.from_pretrained(directory / SUCCESS, strict=True).eval()
        except (*UNREADABLE, draccus.utils.DraccusException) as error:
            first = (str(error).splitlines() or [type(error).__name__])[0]
            raise InputError(
                field, str(directory / SUCCESS), f"the success model is broken ({first})"
            ) from error
    return model.requires_grad_(False), success
