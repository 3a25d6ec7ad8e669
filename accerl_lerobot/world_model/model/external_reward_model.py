# SPDX-License-Identifier: Apache-2.0
"""Classifying successes, by the success model beside a world model or by any LeRobot reward model of frames.

A reward model gets the frames before and after a chunk, under LeRobot's names and through its own
preprocessor, and must answer with a probability. One that reads more, such as the robot's state, the task's
text or more frames, is refused.

Shapes: B or M pairs, V cameras, H×W pixels.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from accerl_lerobot.checkpoint.isolation import rehearse
from accerl_lerobot.checkpoint.safety import (
    Origin,
    brief,
    check_not_pickled,
    read_json,
    read_tensors,
    safe_join,
)
from accerl_lerobot.config.imports import DISCOVER, discover
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.guard import check_origin, check_processor, guarded, input_error
from accerl_lerobot.world_model.success_plugin.modeling_success_pairs import SuccessPairsRewardModel

if TYPE_CHECKING:
    from accerl_lerobot.world_model.config import ExternalRewardModelConfig
    from accerl_lerobot.world_model.model.contract import WorldModelSpec

CONFIG, WEIGHTS = "config.json", "model.safetensors"
FILES = ("*.json", "*.safetensors")
"""Files that are fetched of a reward model on the Hub."""
PREPROCESSOR = "*_preprocessor.json"
IMAGES = "observation.image"
BACKBONE = "model_name"
"""Key of a classifier's config that names another model."""
TEXT = "task_key"
"""Attribute of the configs of models that read the task's text."""
TRIAL_PAIRS = 2
"""Pairs of grey frames that it must classify before any work."""


@dataclass
class Threshold:
    """P above which a frame shows a success, where a `SuccessPairsRewardModel` keeps it too."""

    threshold: float


class ExternalRewardModel(nn.Module):
    """A LeRobot reward model with the interface of `SuccessPairsRewardModel.probability`.

    Args:
        model: LeRobot's.
        preprocess: its own, from a batch to a batch.
        cameras: feature that it reads → its index in V, and the size (H, W) that it wants.
        pairs: True if it reads the frame before, too.
        threshold: see `Threshold`.
    """

    def __init__(
        self,
        model: Any,
        preprocess: Any,
        cameras: dict[str, tuple[int, tuple[int, int]]],
        pairs: bool,
        threshold: float,
    ) -> None:
        super().__init__()
        self.model, self.preprocess, self.cameras, self.pairs = model, preprocess, cameras, pairs
        self.config = Threshold(threshold)

    @torch.no_grad()
    def probability(self, before: Tensor, after: Tensor) -> Tensor:
        """P(success), (B,), of frames (B, V, 3, H, W) in [0, 1]."""
        batch: dict[str, Any] = {}
        for name, (v, size) in self.cameras.items():
            images = [
                _resized(frames[:, v], size) for frames in ((before, after) if self.pairs else (after,))
            ]
            batch[name] = torch.stack(images, 1) if self.pairs else images[0]
        ready = self.preprocess(batch)
        predict = getattr(self.model, "predict", None)
        if predict is None:
            answer = self.model.compute_reward(ready)
        else:  # a classifier's reward is its verdict at ½; before that it has a probability
            answer = predict([ready[name] for name in self.cameras]).probabilities
        probability: Tensor = answer.float()
        return probability


SuccessModel = SuccessPairsRewardModel | ExternalRewardModel


def device_of(success: SuccessModel) -> torch.device:
    """Device of its first parameter."""
    return next(success.parameters()).device


def as_floats(frames: np.ndarray, device: torch.device) -> Tensor:
    """uint8 (B, V, H, W, 3) to float (B, V, 3, H, W) in [0, 1], the input of a success model."""
    return torch.from_numpy(frames).movedim(-1, 2).to(device).float() / 255


def probabilities(
    success: SuccessModel, before: np.ndarray, after: np.ndarray, batch: int = 64
) -> np.ndarray:
    """float32 (M,): P that the second frames show a success; frames uint8 (M, V, H, W, 3)."""
    device = device_of(success)
    parts = [
        success.probability(as_floats(before[i : i + batch], device), as_floats(after[i : i + batch], device))
        for i in range(0, len(before), batch)
    ]
    return torch.cat(parts).cpu().numpy() if parts else np.zeros(0, np.float32)


def load_external_reward_model(
    config: ExternalRewardModelConfig, spec: WorldModelSpec, section: str, device: torch.device | None = None
) -> ExternalRewardModel:
    """Loads the reward model in ``config.path`` and tries it on frames of this spec.

    Args:
        config: its ``path`` is set.
        spec: of the world model.
        section: config section that named it, for errors.
        device: None: the CPU.

    Raises:
        InputError: it is missing, not trusted, reads what world models do not predict, or does not answer
            with a probability.
    """
    from lerobot.configs.rewards import RewardModelConfig

    origin = Origin(f"{section}.path", config.path)
    discover(config.discover_packages_path, section)
    folder = _folder(config, origin)
    fetched = not Path(str(config.path)).expanduser().exists()
    content = read_json(safe_join(folder, CONFIG, origin), origin)
    check_origin(content.get(BACKBONE), None, f"{CONFIG}: {BACKBONE}", origin, fetched)
    importlib.import_module("lerobot.rewards.factory")  # registers LeRobot's own
    known = sorted(RewardModelConfig.get_known_choices())
    if content.get("type") not in known:
        remedy = f"{str(content.get('type'))[:60]!r}; use one of {', '.join(known)}"
        raise origin.refuse(f"{CONFIG}: type", f"{remedy}, or name its package: {section}.{DISCOVER}")
    try:
        settings = RewardModelConfig.from_pretrained(folder)
    except Exception as error:  # LeRobot takes the file at its word, and may fail over any of it
        raise origin.refuse(CONFIG, f"not one of this LeRobot's reward models ({brief(error)})") from error
    settings.device = str(device or "cpu")
    cameras, pairs = _cameras(settings, spec, origin), _pairs(settings, spec, origin)
    model = _load(settings, folder, origin, config.code_revision)
    preprocess = _preprocessor(settings, folder, origin, fetched)
    external = ExternalRewardModel(model, preprocess, cameras, pairs, config.threshold or 0.5)
    _try(external.eval().requires_grad_(False), spec, origin)
    return external


def rehearse_external_reward_model(
    config: ExternalRewardModelConfig, spec: WorldModelSpec, section: str
) -> None:
    """Does the same in a child process with limits, see `isolation`.

    Raises:
        InputError: see `load_external_reward_model`.
    """
    origin = Origin(f"{section}.path", config.path)
    discover(config.discover_packages_path, section)
    importlib.import_module("lerobot.rewards.factory")  # before the fork: the caller needs it too

    def load() -> None:
        load_external_reward_model(config, spec, section)

    rehearse(load, _folder(config, origin), origin)


def _folder(config: ExternalRewardModelConfig, origin: Origin) -> Path:
    path = str(config.path)
    folder = Path(path).expanduser()
    if not folder.exists() and not path.startswith((".", "/", "~")):
        from huggingface_hub import snapshot_download

        from accerl_lerobot.hub.errors import guard_client

        guard_client()
        try:
            folder = Path(snapshot_download(path, revision=config.revision, allow_patterns=list(FILES)))
        except (OSError, ValueError) as error:
            remedy = f"not a folder here and not loadable from the Hub ({brief(error)})"
            raise InputError(origin.field, path, remedy) from error
    return folder


def _cameras(settings: Any, spec: WorldModelSpec, origin: Origin) -> dict[str, tuple[int, tuple[int, int]]]:
    """See `ExternalRewardModel`; models that name no feature get all cameras as they are."""
    if hasattr(settings, TEXT):
        raise origin.refuse(f"{CONFIG}: {TEXT}", "it reads the task's text, and only frames are classified")
    cameras = {}
    for name, feature in settings.input_features.items():
        if not name.startswith(IMAGES):
            why = "it reads this, and only the frames before and after a chunk are classified"
            raise origin.refuse(f"{CONFIG}: input_features.{name[:60]}", why)
        if name not in spec.cameras:
            why = f"it reads this camera, and the world model has {', '.join(spec.cameras)}"
            raise origin.refuse(f"{CONFIG}: input_features.{name[:60]}", why)
        if len(feature.shape) != 3:
            raise origin.refuse(f"{CONFIG}: input_features.{name[:60]}", "a shape (3, H, W) is wanted")
        _, height, width = feature.shape
        cameras[name] = (spec.cameras.index(name), (int(height), int(width)))
    return cameras or {name: (v, spec.image_size) for v, name in enumerate(spec.cameras)}


def _pairs(settings: Any, spec: WorldModelSpec, origin: Origin) -> bool:
    """True if it reads two frames a chunk apart, False if it reads one."""
    deltas = settings.observation_delta_indices
    if deltas is None or list(deltas) == [0]:
        return False
    if len(deltas) != 2 or deltas[1] - deltas[0] != spec.chunk:
        why = f"it reads frames {list(deltas)[:8]}, and a chunk has two, {spec.chunk} steps apart"
        raise origin.refuse(CONFIG, why)
    return True


def _load(settings: Any, folder: Path, origin: Origin, code_revision: str | None) -> Any:
    from lerobot.rewards.factory import get_reward_model_class

    check_not_pickled(folder, WEIGHTS, origin)
    stored = [name for name, _ in read_tensors(safe_join(folder, WEIGHTS, origin), origin)]
    try:
        with guarded(origin.field.removesuffix(".path"), code_revision):
            model = get_reward_model_class(settings.type).from_pretrained(folder, config=settings)
    except Exception as error:  # third-party code on untrusted files
        if (ours := input_error(error)) is not None:
            raise ours from error
        raise origin.refuse(WEIGHTS, f"its reward model cannot be loaded ({brief(error)})") from error
    # LeRobot does not check for missing weights. A layer under two names may be stored under one of them.
    state = model.state_dict()
    loaded = {state[name].data_ptr() for name in stored if name in state}
    lacking = [name for name, tensor in state.items() if tensor.data_ptr() not in loaded]
    if wrong := [*lacking, *(name for name in stored if name not in state)]:
        raise origin.refuse(
            WEIGHTS, f"they are not those of its config: {wrong[0][:80]} is in one of them only"
        )
    return model.to(settings.device)


def _preprocessor(settings: Any, folder: Path, origin: Origin, fetched: bool) -> Any:
    """Loads the preprocessor that lerobot-train saved with the weights, with its statistics."""
    from lerobot.processor import PolicyProcessorPipeline
    from lerobot.rewards.factory import make_reward_pre_post_processors

    files = sorted(folder.glob(PREPROCESSOR))
    try:
        if not files and not hasattr(settings, "normalization_mapping"):
            return make_reward_pre_post_processors(settings)[0]
        if len(files) != 1:
            raise origin.refuse(PREPROCESSOR, f"{len(files)} there, and lerobot-train saves one; give that")
        check_processor(folder, files[0].name, origin, fetched=fetched)
        device = {"device_processor": {"device": settings.device}}
        return PolicyProcessorPipeline.from_pretrained(folder, files[0].name, overrides=device)
    except InputError:
        raise
    except Exception as error:  # third-party code on untrusted files
        raise origin.refuse(PREPROCESSOR, f"cannot be loaded ({brief(error)})") from error


def _try(external: ExternalRewardModel, spec: WorldModelSpec, origin: Origin) -> None:
    size = (TRIAL_PAIRS, len(spec.cameras), 3, *spec.image_size)
    grey = torch.full(size, 0.5, device=device_of(external))
    try:
        answer = external.probability(grey, grey)
    except Exception as error:  # it reads something else
        raise origin.refuse(CONFIG, f"it cannot classify predicted frames ({brief(error)})") from error
    if answer.shape != (TRIAL_PAIRS,) or not bool(((answer >= 0) & (answer <= 1)).all()):
        values, shape = answer.flatten()[:4].tolist(), tuple(answer.shape)
        why = f"its answer to {TRIAL_PAIRS} frames is {values} of shape {shape}, not a probability each"
        raise origin.refuse(CONFIG, why)


def _resized(frames: Tensor, size: tuple[int, int]) -> Tensor:
    if frames.shape[-2:] == size:
        return frames
    return functional.interpolate(frames, size=size, mode="bilinear", antialias=True).clamp(0, 1)
