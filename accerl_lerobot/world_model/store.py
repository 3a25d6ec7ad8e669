# SPDX-License-Identifier: Apache-2.0
"""World models on disk: configs as JSON, weights as safetensors, the success model in LeRobot's format.

world_model/
  config.json          spec, config of the model, and the episodes it was trained on
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
from accerl_lerobot.config.parsing import DISCOVER, discover
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.guard import Unfilled, guarded, input_error
from accerl_lerobot.world_model.config import LearnableModelConfig
from accerl_lerobot.world_model.contract import (
    Context,
    LearnableWorldModel,
    WorldModelSpec,
    learnable_class,
)
from accerl_lerobot.world_model.success_plugin.modeling_success_pairs import SuccessPairsRewardModel

UNREADABLE = (
    OSError, LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError,
    SafetensorError,
)  # fmt: skip
CONFIG, WEIGHTS, SUCCESS = "config.json", "model.safetensors", "success_model"
MAX_TASK_NAME = 200


@dataclass(frozen=True, kw_only=True)
class Source:
    """A dataset, and the episodes of it that a world model was trained on."""

    repo_id: str
    fingerprint: str
    """See `data.fingerprint`."""
    learnt: tuple[int, ...]
    """Indices of episodes that it was trained on."""
    held_out: tuple[int, ...]
    """Indices of episodes that were held out."""


OWN_RUN = Source(repo_id="the episodes of a run", fingerprint="", learnt=(), held_out=())
"""Last source of a model promoted in a run: its episodes are in no dataset, and set the threshold."""


def save_world_model(
    directory: Path,
    model: LearnableWorldModel,
    success: SuccessPairsRewardModel | None = None,
    sources: Sequence[Source] = (),
) -> None:
    """Writes a new folder."""
    directory.mkdir(parents=True)
    spec = asdict(model.spec) | {"provides": sorted(model.spec.provides)}
    content = {"spec": spec, "model": draccus.encode(model.config, LearnableModelConfig)}
    content["sources"] = [asdict(source) for source in sources]
    (directory / CONFIG).write_text(json.dumps(content, indent=2) + "\n")
    # Copies, as safetensors refuses tensors that share memory.
    weights = {k: v.clone(memory_format=torch.contiguous_format) for k, v in model.state_dict().items()}
    save_file(weights, directory / WEIGHTS)
    if success is not None:
        # The device of this machine may not exist where the model is loaded.
        device, success.config.device = success.config.device, "cpu"
        success.save_pretrained(directory / SUCCESS)
        success.config.device = device


def load_sources(directory: Path, section: str = "") -> tuple[Source, ...]:
    """Datasets that a saved world model was trained on; errors name the ``path`` of this config section.

    Raises:
        InputError: the file is malformed.
    """
    origin = _origin(directory, section)
    try:
        listed = read_json(safe_join(directory, CONFIG, origin), origin).get("sources", [])
        return tuple(
            Source(
                repo_id=str(one["repo_id"]),
                fingerprint=str(one["fingerprint"]),
                learnt=tuple(map(int, one["learnt"])),
                held_out=tuple(map(int, one["held_out"])),
            )
            for one in listed
        )
    except InputError:
        raise
    except UNREADABLE as error:
        remedy = f"its {CONFIG} does not say what it was trained on ({brief(error)})"
        raise InputError(origin.field, origin.value, remedy) from error


def find_source(sources: Iterable[Source], fingerprint: str) -> Source | None:
    """The source with this fingerprint."""
    return next((source for source in sources if source.fingerprint == fingerprint), None)


def load_world_model(
    directory: Path, package: str | None = None, *, section: str = ""
) -> tuple[LearnableWorldModel, SuccessPairsRewardModel | None]:
    """Reads what `save_world_model` wrote, in eval mode.

    `package` registers the model's type, where that is not one of ours; errors name the config `section`.

    Raises:
        InputError: it is missing, of an unknown type, its weights do not match its config, or its success
            model is broken.
    """
    origin = _origin(directory, section)
    discover(package, section)
    content = read_json(safe_join(directory, CONFIG, origin), origin)
    spec = _spec(content.get("spec"), origin)
    _check_type(content.get("model"), origin)
    weights = _weights(directory, origin)
    try:
        made = draccus.decode(LearnableModelConfig, content["model"])
        with Unfilled():
            model = learnable_class(made)(spec, made)
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


def rehearse_world_model(directory: Path, package: str | None = None, *, section: str = "") -> None:
    """Loads a world model and predicts a chunk in a child process with limits, see `isolation`.

    Raises:
        InputError: it cannot be loaded, or does not predict what its spec says.
    """
    origin = _origin(directory, section)
    discover(package, section)  # before the fork: the caller needs it too
    read_json(safe_join(directory, CONFIG, origin), origin)
    rehearse(lambda: _predict_once(*load_world_model(directory, package, section=section)), directory, origin)


@torch.no_grad()
def _predict_once(model: LearnableWorldModel, success: SuccessPairsRewardModel | None) -> None:
    spec = model.spec
    frames = torch.zeros((1, spec.context, len(spec.cameras), *spec.image_size, 3), dtype=torch.uint8)
    robot, commanded = torch.zeros(1, spec.context, spec.state_dim), torch.zeros(1, spec.action_dim)
    actions = torch.zeros(1, spec.context - 1, spec.chunk, spec.action_dim)
    state = model.begin(Context(frames, robot, actions, commanded, robot[:, -1]), spec.tasks[:1] or ("",))
    prediction = model.step(state, torch.zeros(1, spec.chunk, spec.action_dim), [0])
    if success is not None:
        before, after = (x.movedim(-1, -3).float() / 255 for x in (frames[:, -1], prediction.frames))
        success.probability(before, after)


def _spec(content: object, origin: Origin) -> WorldModelSpec:
    """Reads the spec; cameras' names are checked, as they become parts of paths."""
    try:
        fields = dict(cast(Any, content))
        sizes = {name: fields[name] for name in ("state_dim", "action_dim", "chunk", "fps", "context")}
        lists = {name: fields.get(name, []) for name in ("cameras", "image_size", "tasks", "provides")}
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
    if any(not name.isprintable() or len(name) > MAX_TASK_NAME for name in spec.tasks):
        wanted = f"names of at most {MAX_TASK_NAME} printable characters are wanted"
        raise origin.refuse(f"{CONFIG}: spec.tasks", wanted)
    if min(spec.action_dim, spec.chunk, spec.fps, spec.context, *spec.image_size, len(spec.cameras)) < 1:
        raise origin.refuse(f"{CONFIG}: spec", "sizes of at least 1, and a camera, are wanted")
    return spec


def _check_type(model: object, origin: Origin) -> None:
    kind = model.get("type") if isinstance(model, dict) else None
    if kind is None:
        raise origin.refuse(f"{CONFIG}: model.type", "it has none, as earlier versions wrote; train it again")
    known = sorted(LearnableModelConfig.get_known_choices())
    if kind not in known:
        remedy = f"{str(kind)[:60]!r}; use one of {', '.join(known)}, or name its package"
        package = origin.field.removesuffix("path") + DISCOVER
        raise origin.refuse(f"{CONFIG}: model.type", f"{remedy}: {package}")


def _weights(directory: Path, origin: Origin) -> Path:
    check_not_pickled(directory, WEIGHTS, origin)
    return safe_join(directory, WEIGHTS, origin)


def _origin(directory: Path, section: str) -> Origin:
    return Origin(f"{section}.path" if section else "path", str(directory))


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
