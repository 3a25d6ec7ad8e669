# SPDX-License-Identifier: Apache-2.0
"""A world model on disk: configs as JSON, weights as safetensors, the success model in LeRobot's format.

world_model/
  config.json          what world it is of, how it dreams, and which episodes it has learnt from
  model.safetensors    weights and statistics
  success_model/       a LeRobot reward model
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast

import draccus
import torch
from safetensors import SafetensorError
from safetensors.torch import save_file

from accerl_lerobot.checkpoint.isolation import rehearse
from accerl_lerobot.checkpoint.safety import (
    Origin,
    brief,
    check_name,
    check_not_pickled,
    read_json,
    read_tensors,
    safe_join,
)
from accerl_lerobot.config.imports import DISCOVER, discover
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.guard import Unfilled, guarded, input_error
from accerl_lerobot.world_model.config import LearnableModelConfig
from accerl_lerobot.world_model.contract import Context, LearnableWorldModel, WorldModelSpec, new_learnable
from accerl_lerobot.world_model.success_plugin.modeling_success_pairs import SuccessPairsRewardModel

UNREADABLE = (
    OSError, LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError,
    SafetensorError,
)  # fmt: skip
CONFIG, WEIGHTS, SUCCESS = "config.json", "model.safetensors", "success_model"
NAME_MOST = 200
"""Characters of a task's name."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """Which episodes of which dataset a world model knows."""

    repo_id: str
    fingerprint: str
    """Fingerprint of the dataset, whatever it is called, see `dataset.fingerprint`."""
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
    """Sources that a saved world model has learnt from; none if it does not say. `room` is of the ``path``.

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
    spec = _spec(content.get("spec"), origin)
    _check_type(content.get("model"), origin)
    weights = _weights(directory, origin)
    try:
        with Unfilled():
            model = new_learnable(spec, draccus.decode(LearnableModelConfig, content["model"]))
        model.load_state_dict(dict(read_tensors(weights, origin)))
    except (*UNREADABLE, draccus.utils.DraccusException) as error:
        if (ours := input_error(error)) is not None:  # draccus wraps what a config refuses
            raise ours if ours.field == origin.field else origin.refuse(CONFIG, brief(ours)) from error
        remedy = f"not a world model of accerl world-model ({brief(error)})"
        raise InputError(origin.field, origin.value, remedy) from error
    success = None
    if safe_join(directory, SUCCESS, origin).is_dir():
        success = _success(directory / SUCCESS, replace(origin, value=str(directory / SUCCESS)))
    return model.requires_grad_(False).eval(), success


def rehearse_world_model(directory: Path, package: str | None = None, *, room: str = "") -> None:
    """Loads a world model and imagines a chunk in a child process with limits, see `isolation`.

    Raises:
        InputError: it cannot be loaded, or does not imagine what its spec says.
    """
    origin = _origin(directory, room)
    discover(package, room)  # before the fork: the caller needs it too
    read_json(safe_join(directory, CONFIG, origin), origin)
    rehearse(lambda: _imagine_once(*load_world_model(directory, package, room=room)), directory, origin)


@torch.no_grad()
def _imagine_once(model: LearnableWorldModel, success: SuccessPairsRewardModel | None) -> None:
    spec = model.spec
    frames = torch.zeros((1, spec.context, len(spec.cameras), *spec.image_size, 3), dtype=torch.uint8)
    robot, moved = torch.zeros(1, spec.context, spec.state_dim), torch.zeros(1, spec.action_dim)
    made = torch.zeros(1, spec.context - 1, spec.chunk, spec.action_dim)
    tasks = spec.tasks[:1] or ("",)
    state = model.begin(Context(frames, robot, made, moved, robot[:, -1]), tasks)
    dream = model.step(state, torch.zeros(1, spec.chunk, spec.action_dim), [0])
    if success is not None:
        before, after = (x.movedim(-1, -3).float() / 255 for x in (frames[:, -1], dream.frames))
        success.said(before, after)


def _spec(content: object, origin: Origin) -> WorldModelSpec:
    """Spec in the file; cameras' names become parts of paths."""
    try:
        said = dict(cast(Any, content))
        sizes = {name: said[name] for name in ("state_dim", "action_dim", "chunk", "fps", "context")}
        lists = {name: said.get(name, []) for name in ("cameras", "image_size", "tasks", "provides")}
        spec = WorldModelSpec(
            **{name: draccus.decode(int, size) for name, size in sizes.items()},
            cameras=tuple(draccus.decode(list[str], lists["cameras"])),
            image_size=draccus.decode(tuple[int, int], lists["image_size"]),
            tasks=tuple(draccus.decode(list[str], lists["tasks"])),
            provides=frozenset(draccus.decode(list[str], lists["provides"])),
        )
    except (*UNREADABLE, draccus.utils.DraccusException) as error:
        raise origin.refuse(f"{CONFIG}: spec", f"not one of accerl world-model ({brief(error)})") from error
    for camera in spec.cameras:
        check_name(camera, f"{CONFIG}: spec.cameras", origin)
    if any(not name.isprintable() or len(name) > NAME_MOST for name in spec.tasks):
        wanted = f"names of at most {NAME_MOST} printable characters are wanted"
        raise origin.refuse(f"{CONFIG}: spec.tasks", wanted)
    if min(spec.action_dim, spec.chunk, spec.fps, spec.context, *spec.image_size, len(spec.cameras)) < 1:
        raise origin.refuse(f"{CONFIG}: spec", "sizes of at least 1, and a camera, are wanted")
    return spec


def _check_type(model: object, origin: Origin) -> None:
    kind = model.get("type") if isinstance(model, dict) else None
    if kind is None:
        raise origin.refuse(f"{CONFIG}: model.type", "it has none, as earlier versions wrote; learn it again")
    known = sorted(LearnableModelConfig.get_known_choices())
    if kind not in known:
        remedy = f"{str(kind)[:60]!r}; use one of {', '.join(known)}, or name its package"
        package = origin.field.removesuffix("path") + DISCOVER
        raise origin.refuse(f"{CONFIG}: model.type", f"{remedy}: {package}")


def _weights(directory: Path, origin: Origin) -> Path:
    check_not_pickled(directory, WEIGHTS, origin)
    return safe_join(directory, WEIGHTS, origin)


def _origin(directory: Path, room: str) -> Origin:
    return Origin(f"{room}.path" if room else "path", str(directory))


def _success(directory: Path, origin: Origin) -> SuccessPairsRewardModel:
    kind = read_json(safe_join(directory, CONFIG, origin), origin).get("type")
    if kind != "success_pairs":
        raise origin.refuse(f"{CONFIG}: type", f"{str(kind)[:60]!r}; use success_pairs")
    weights = _weights(directory, origin)
    try:
        with guarded("path"), Unfilled():
            success = SuccessPairsRewardModel.from_pretrained(directory, strict=True).eval()
        deque(read_tensors(weights, origin), maxlen=0)
    except InputError as error:
        raise error if error.field == origin.field else origin.refuse(CONFIG, brief(error)) from error
    except (*UNREADABLE, draccus.utils.DraccusException) as error:
        raise InputError(
            origin.field, origin.value, f"the success model is broken ({brief(error)})"
        ) from error
    return success
