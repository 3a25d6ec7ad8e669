# SPDX-License-Identifier: Apache-2.0
"""World models on disk: configs as JSON, weights as safetensors, the success model in LeRobot's format.

world_model/
  config.json          spec, config of the model, the episodes it is known from, and the checks it failed
  model.safetensors    weights and statistics
  success_model/       a LeRobot reward model
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from pathlib import Path

import draccus
import torch
from lerobot.configs.rewards import RewardModelConfig
from safetensors.torch import save_file

from accerl_lerobot.checkpoint.layout import write_atomically
from accerl_lerobot.checkpoint.safety import FileSource, brief, read_json, read_tensors, safe_join
from accerl_lerobot.config.parsing import DISCOVER, discover
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import task_codes
from accerl_lerobot.policies.untrusted import Unfilled, input_error
from accerl_lerobot.world_model.config import LearnableModelConfig
from accerl_lerobot.world_model.contract import Context, LearnableWorldModel, WorldModelSpec, new_model
from accerl_lerobot.world_model.success_model import SuccessPairsRewardModel

CONFIG, WEIGHTS, SUCCESS = "config.json", "model.safetensors", "success_model"
LEARNT, HELD_OUT = "learnt", "held out"  # roles of episodes: trained on, or not


def save_world_model(
    directory: Path,
    model: LearnableWorldModel,
    success: SuccessPairsRewardModel,
    roles: Mapping[str, str] | None = None,
) -> None:
    """Writes a new folder. `roles` are those of episodes, by their keys."""
    directory.mkdir(parents=True)
    config = draccus.encode(model.config, LearnableModelConfig)
    content = {"spec": asdict(model.spec), "model": config, "episodes": dict(roles or {})}
    (directory / CONFIG).write_text(json.dumps(content, indent=2) + "\n")
    # Copies, as safetensors refuses tensors that share memory.
    weights = {k: v.clone(memory_format=torch.contiguous_format) for k, v in model.state_dict().items()}
    save_file(weights, directory / WEIGHTS)
    # The device of this machine may not exist where the model is loaded.
    device, success.config.device = success.config.device, "cpu"
    success.save_pretrained(directory / SUCCESS)
    success.config.device = device


def note_failed(directory: Path, checks: Iterable[str]) -> None:
    """Adds to a saved world model which checks of its validation failed."""
    path = directory / CONFIG
    content = json.loads(path.read_text()) | {"failed_checks": list(checks)}
    write_atomically(path, json.dumps(content, indent=2) + "\n")


def load_failed(directory: Path, section: str = "") -> list[str] | None:
    """The checks that a saved world model failed; None if it was never validated."""
    origin = _origin(directory, section)
    failed = read_json(safe_join(directory, CONFIG, origin), origin).get("failed_checks")
    if failed is not None and not (
        isinstance(failed, list) and all(isinstance(name, str) for name in failed)
    ):
        raise origin.refuse(f"{CONFIG}: failed_checks", "not one of accerl world-model")
    return failed


def load_roles(directory: Path, section: str = "") -> dict[str, str]:
    """Roles of the episodes that a saved world model was trained and validated on, by their keys."""
    origin = _origin(directory, section)
    roles = read_json(safe_join(directory, CONFIG, origin), origin).get("episodes", {})
    if not isinstance(roles, dict):
        raise origin.refuse(f"{CONFIG}: episodes", "not one of accerl world-model")
    return roles


def load_world_model(
    directory: Path, package: str | None = None, *, section: str = ""
) -> tuple[LearnableWorldModel, SuccessPairsRewardModel]:
    """Reads what `save_world_model` wrote, in eval mode.

    `package` registers the model's type, where that is not one of ours; errors name the config `section`.
    """
    origin = _origin(directory, section)
    discover(package, section)
    content = read_json(safe_join(directory, CONFIG, origin), origin)
    named, known = content.get("model"), sorted(LearnableModelConfig.get_known_choices())
    kind = named.get("type") if isinstance(named, dict) else None
    if kind not in known:
        package_field = origin.field.removesuffix("path") + DISCOVER
        hint = f"use one of {', '.join(known)}, or name its package: {package_field}"
        raise origin.refuse(f"{CONFIG}: model.type", f"{str(kind)[:60]!r}; {hint}")

    def make_model() -> LearnableWorldModel:
        spec = draccus.decode(WorldModelSpec, content.get("spec"))
        return new_model(spec, draccus.decode(LearnableModelConfig, named))

    model = _filled("world model", make_model, directory, origin)
    directory = safe_join(directory, SUCCESS, origin)
    config = read_json(safe_join(directory, CONFIG, origin), origin)
    if (kind := config.get("type")) != SuccessPairsRewardModel.name:
        raise origin.refuse(f"{CONFIG}: type", f"{str(kind)[:60]!r}; use {SuccessPairsRewardModel.name}")
    success = _filled(
        "success model",
        lambda: SuccessPairsRewardModel(draccus.decode(RewardModelConfig, config)),
        directory,
        origin,
    )
    return model, success


def _filled[M: torch.nn.Module](what: str, make: Callable[[], M], directory: Path, origin: FileSource) -> M:
    """A new model with the weights in `directory`."""
    weights = safe_join(directory, WEIGHTS, origin)
    try:
        with Unfilled():
            model = make()
        model.load_state_dict(dict(read_tensors(weights, origin)))
    except Exception as error:  # the files may hold anything
        ours = input_error(error)  # draccus wraps what a config refuses
        if ours is None:
            hint = f"not a {what} of accerl world-model ({brief(error)})"
            raise InputError(origin.field, origin.value, hint) from error
        raise (ours if ours.field == origin.field else origin.refuse(CONFIG, brief(ours))) from error
    return model.requires_grad_(False).eval()


def check_predicts(
    directory: Path, model: LearnableWorldModel, success: SuccessPairsRewardModel, *, section: str = ""
) -> None:
    """Predicts a chunk with a world model that was loaded from `directory`, before a run relies on it."""
    try:
        with torch.random.fork_rng(devices=[]):
            _predict_once(model, success)
    except Exception as error:  # its config may ask for anything
        raise _origin(directory, section).refuse(CONFIG, f"it predicts nothing ({brief(error)})") from error


@torch.no_grad()
def _predict_once(model: LearnableWorldModel, success: SuccessPairsRewardModel) -> None:
    spec = model.spec
    frames = torch.zeros((1, spec.context, len(spec.cameras), *spec.image_size, 3), dtype=torch.uint8)
    robot, commanded = torch.zeros(1, spec.context, spec.state_dim), torch.zeros(1, spec.action_dim)
    actions = torch.zeros(1, spec.context - 1, spec.chunk, spec.action_dim)
    tasks = spec.tasks[:1] or ("",)
    state = model.begin(Context(frames, robot, actions, commanded, robot[:, -1]), tasks)
    prediction = model.step(state, torch.zeros(1, spec.chunk, spec.action_dim), [0])
    success.probabilities(frames[:, -1].numpy(), prediction.frames.numpy(), task_codes(tasks))


def _origin(directory: Path, section: str) -> FileSource:
    return FileSource(f"{section}.path" if section else "path", str(directory))
