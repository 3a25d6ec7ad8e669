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
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import draccus
import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

from accerl_lerobot.errors import InputError
from accerl_lerobot.imports import discover
from accerl_lerobot.policies.guard import Budget, guarded, input_error
from accerl_lerobot.safety import Origin, brief, checked_weights, file_size, read_json, safe_join
from accerl_lerobot.world_model.bounds import check_model, check_spec, check_success_model
from accerl_lerobot.world_model.config import LearnableModelConfig
from accerl_lerobot.world_model.contract import LearnableWorldModel, WorldModelSpec, new_learnable
from accerl_lerobot.world_model.success_plugin.modeling_success_pairs import SuccessPairsRewardModel

UNREADABLE = (
    OSError, LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError,
    SafetensorError,
)  # fmt: skip
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


A_RUN = Source(repo_id="the episodes of a run", fingerprint="", learnt=(), held_out=())
"""Last of the sources of what was promoted in one: in no dataset, and what its threshold was set on."""


def save_world_model(
    directory: Path,
    model: LearnableWorldModel,
    success: SuccessPairsRewardModel | None = None,
    sources: Sequence[Source] = (),
) -> None:
    """Writes all of it into a folder that does not exist."""
    directory.mkdir(parents=True)
    spec = asdict(model.spec) | {"provides": sorted(model.spec.provides)}
    content = {"spec": spec, "model": draccus.encode(model.config, LearnableModelConfig)}
    content["sources"] = [asdict(source) for source in sources]
    (directory / CONFIG).write_text(json.dumps(content, indent=2) + "\n")
    # Copies: layers that it has twice, and views, are not to be saved as they are.
    weights = {k: v.clone(memory_format=torch.contiguous_format) for k, v in model.state_dict().items()}
    save_file(weights, directory / WEIGHTS)
    if success is not None:
        # Whoever loads it says where it is to be; where it was may not exist there.
        where, success.config.device = success.config.device, "cpu"
        success.save_pretrained(directory / SUCCESS)
        success.config.device = where


def load_sources(directory: Path, room: str = "") -> tuple[Source, ...]:
    """What a saved world model has learnt from; none if it does not say. `room` is of the ``path``.

    Raises:
        InputError: it says something else.
    """
    origin = _origin(directory, room)
    try:
        said = read_json(safe_join(directory, CONFIG, origin), origin).get("sources", [])
        return tuple(
            Source(
                repo_id=str(one["repo_id"]),
                fingerprint=str(one["fingerprint"]),
                learnt=tuple(map(int, one["learnt"])),
                held_out=tuple(map(int, one["held_out"])),
            )
            for one in said
        )
    except InputError:
        raise
    except UNREADABLE as error:
        remedy = f"its {CONFIG} does not say what it learnt ({brief(error)})"
        raise InputError(origin.field, origin.value, remedy) from error


def find(sources: Iterable[Source], fingerprint: str) -> Source | None:
    """The one that is of this dataset."""
    return next((source for source in sources if source.fingerprint == fingerprint), None)


def load_world_model(
    directory: Path, package: str | None = None, *, room: str = ""
) -> tuple[LearnableWorldModel, SuccessPairsRewardModel | None]:
    """Reads what `save_world_model` wrote; both serve, neither is in training.

    Args:
        directory: the folder.
        package: that registers its type, where that is not one of ours.
        room: of the fields ``path`` and ``discover_packages_path`` that named them, for the error.

    Raises:
        InputError: it is not there, of a type that is not known, its weights are not those of its config, or
            its success model is broken.
    """
    origin = _origin(directory, room)
    discover(package, room)
    content = read_json(safe_join(directory, CONFIG, origin), origin)
    check_spec(content.get("spec"), origin)
    check_model(content.get("model"), LearnableModelConfig.get_known_choices(), origin)
    weights, _ = checked_weights(directory, WEIGHTS, origin)
    try:
        spec = dict(content["spec"])
        spec |= {k: tuple(spec.get(k, ())) for k in ("cameras", "image_size", "tasks")}
        spec |= {"provides": frozenset(spec["provides"])}
        with Budget(file_size(weights, origin), origin.field, origin.value):
            config = draccus.decode(LearnableModelConfig, content["model"])
            model = new_learnable(WorldModelSpec(**spec), config)
        model.load_state_dict(load_file(weights))
    except (*UNREADABLE, draccus.utils.DraccusException) as error:
        if (ours := input_error(error)) is not None:  # draccus wraps what a config refuses
            raise origin.refuse(CONFIG, brief(ours)) from error
        remedy = f"not a world model of accerl world-model ({brief(error)})"
        raise InputError(origin.field, origin.value, remedy) from error
    success = None
    if safe_join(directory, SUCCESS, origin).is_dir():
        success = _success(directory / SUCCESS, replace(origin, value=str(directory / SUCCESS)))
    return model.requires_grad_(False).eval(), success


def _origin(directory: Path, room: str) -> Origin:
    return Origin(f"{room}.path" if room else "path", str(directory))


def _success(directory: Path, origin: Origin) -> SuccessPairsRewardModel:
    check_success_model(read_json(safe_join(directory, CONFIG, origin), origin), origin)
    weights, _ = checked_weights(directory, WEIGHTS, origin)
    try:
        with guarded("path"), Budget(file_size(weights, origin), origin.field, origin.value):
            return SuccessPairsRewardModel.from_pretrained(directory, strict=True).eval()
    except InputError as error:
        raise origin.refuse(CONFIG, brief(error)) from error
    except (*UNREADABLE, draccus.utils.DraccusException) as error:
        raise InputError(
            origin.field, origin.value, f"the success model is broken ({brief(error)})"
        ) from error
