# SPDX-License-Identifier: Apache-2.0
"""A LeRobot reward model that tells successes in place of the one beside a world model.

It is given what a dream has to show, the frames before and after a chunk, by LeRobot's own names and through
its own preprocessor, and must answer with a probability. Whoever reads more than that, the robot's state, the
task's text or a longer film, is refused.

Shapes: B pairs, V cameras, H×W pixels.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
    from accerl_lerobot.world_model.config import StandInConfig
    from accerl_lerobot.world_model.contract import WorldModelSpec

CONFIG, WEIGHTS = "config.json", "model.safetensors"
FILES = ("*.json", "*.safetensors")
"""Files that are fetched of a reward model on the Hub."""
PREPROCESSOR = "*_preprocessor.json"
IMAGES = "observation.image"
BACKBONE = "model_name"
"""Key of a classifier's config that names another model."""
TEXT = "task_key"
"""Attribute of the configs of models that read the task's text."""
BLANK = 2
"""Pairs of grey frames on which it is tried before any work."""


class Threshold:
    """Threshold of a success; where a `SuccessPairsRewardModel` keeps it, too.

    Args:
        threshold: P above which a frame does, in [0, 1].
    """

    def __init__(self, threshold: float) -> None:
        self.threshold = threshold


class StandIn(nn.Module):
    """Probabilities as of `SuccessPairsRewardModel.said`, from another reward model.

    Args:
        model: LeRobot's.
        preprocess: its own, from a batch to a batch.
        cameras: feature that it reads → its place in V, and the size (H, W) that it wants.
        pairs: whether it looks at the frame before, too.
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
    def said(self, before: Tensor, after: Tensor) -> Tensor:
        """P(success), (B,), of frames (B, V, 3, H, W) in [0, 1]."""
        batch: dict[str, Any] = {}
        for name, (v, size) in self.cameras.items():
            shown = [_sized(frames[:, v], size) for frames in ((before, after) if self.pairs else (after,))]
            batch[name] = torch.stack(shown, 1) if self.pairs else shown[0]
        ready = self.preprocess(batch)
        predict = getattr(self.model, "predict", None)
        if predict is None:
            said = self.model.compute_reward(ready)
        else:  # a classifier's reward is its verdict at ½; before that it has a probability
            said = predict([ready[name] for name in self.cameras]).probabilities
        probability: Tensor = said.float()
        return probability


SuccessModel = SuccessPairsRewardModel | StandIn
"""Whatever tells successes."""


def device_of(success: SuccessModel) -> torch.device:
    """Where it lives."""
    return next(success.parameters()).device


def load_stand_in(
    config: StandInConfig, spec: WorldModelSpec, room: str, device: torch.device | None = None
) -> StandIn:
    """Loads a reward model and makes sure that a dream can be shown to it.

    Args:
        config: which, and where from; its ``path`` is set.
        spec: of what is dreamt.
        room: that named it, for the error.
        device: where it is to live; None: the CPU.

    Raises:
        InputError: there is none, it is not to be trusted, it reads what dreams do not have, or what it
            answers is no probability.
    """
    from lerobot.configs.rewards import RewardModelConfig

    origin = Origin(f"{room}.path", config.path)
    discover(config.discover_packages_path, room)
    folder = _folder(config, origin)
    fetched = not Path(str(config.path)).expanduser().exists()
    content = read_json(safe_join(folder, CONFIG, origin), origin)
    check_origin(content.get(BACKBONE), None, f"{CONFIG}: {BACKBONE}", origin, fetched)
    importlib.import_module("lerobot.rewards.factory")  # registers LeRobot's own
    known = sorted(RewardModelConfig.get_known_choices())
    if content.get("type") not in known:
        remedy = f"{str(content.get('type'))[:60]!r}; use one of {', '.join(known)}"
        raise origin.refuse(f"{CONFIG}: type", f"{remedy}, or name its package: {room}.{DISCOVER}")
    try:
        settings = RewardModelConfig.from_pretrained(folder)
    except Exception as error:  # LeRobot takes the file at its word, and may fail over any of it
        raise origin.refuse(CONFIG, f"not one of this LeRobot's reward models ({brief(error)})") from error
    settings.device = str(device or "cpu")
    cameras, pairs = _cameras(settings, spec, origin), _pairs(settings, spec, origin)
    made = _load(settings, folder, origin, config.code_revision)
    stand_in = StandIn(
        made, _preprocessor(settings, folder, origin, fetched), cameras, pairs, config.threshold or 0.5
    )
    _try(stand_in.eval().requires_grad_(False), spec, origin)
    return stand_in


def rehearse_stand_in(config: StandInConfig, spec: WorldModelSpec, room: str) -> None:
    """Loads one and has it judge in a child process with limits, see `isolation`; its ``path`` is set.

    Raises:
        InputError: see `load_stand_in`.
    """
    origin = Origin(f"{room}.path", config.path)
    discover(config.discover_packages_path, room)
    importlib.import_module("lerobot.rewards.factory")  # before the fork: the caller needs it too

    def load() -> None:
        load_stand_in(config, spec, room)

    rehearse(load, _folder(config, origin), origin)


def _folder(config: StandInConfig, origin: Origin) -> Path:
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
    """See `StandIn`; models that name no feature see all cameras as they are."""
    if hasattr(settings, TEXT):
        raise origin.refuse(f"{CONFIG}: {TEXT}", "it reads the task's text, and successes are told by frames")
    found = {}
    for name, feature in settings.input_features.items():
        if not name.startswith(IMAGES):
            why = "it reads this, and successes are told by the frames before and after a chunk alone"
            raise origin.refuse(f"{CONFIG}: input_features.{name[:60]}", why)
        if name not in spec.cameras:
            why = f"it reads this camera, and dreams show {', '.join(spec.cameras)}"
            raise origin.refuse(f"{CONFIG}: input_features.{name[:60]}", why)
        if len(feature.shape) != 3:
            raise origin.refuse(f"{CONFIG}: input_features.{name[:60]}", "a shape (3, H, W) is wanted")
        _, height, width = feature.shape
        found[name] = (spec.cameras.index(name), (int(height), int(width)))
    return found or {name: (v, spec.image_size) for v, name in enumerate(spec.cameras)}


def _pairs(settings: Any, spec: WorldModelSpec, origin: Origin) -> bool:
    """True if it looks at two frames a chunk apart; or else at one."""
    looks = settings.observation_delta_indices
    if looks is None or list(looks) == [0]:
        return False
    if len(looks) != 2 or looks[1] - looks[0] != spec.chunk:
        why = f"it looks at frames {list(looks)[:8]}, and a chunk's dream shows two, {spec.chunk} steps apart"
        raise origin.refuse(CONFIG, why)
    return True


def _load(settings: Any, folder: Path, origin: Origin, code_revision: str | None) -> Any:
    from lerobot.rewards.factory import get_reward_model_class

    check_not_pickled(folder, WEIGHTS, origin)
    stored = [name for name, _ in read_tensors(safe_join(folder, WEIGHTS, origin), origin)]
    try:
        with guarded(origin.field.removesuffix(".path"), code_revision):
            made = get_reward_model_class(settings.type).from_pretrained(folder, config=settings)
    except Exception as error:  # whatever its own code does with what its files say
        if (ours := input_error(error)) is not None:
            raise ours from error
        raise origin.refuse(WEIGHTS, f"its reward model cannot be loaded ({brief(error)})") from error
    # LeRobot lets weights be missing, and cannot do otherwise: where a network has one layer under two names,
    # a file with one of them is taken for incomplete.
    state = made.state_dict()
    there = {state[name].data_ptr() for name in stored if name in state}
    lacking = [name for name, tensor in state.items() if tensor.data_ptr() not in there]
    if wrong := [*lacking, *(name for name in stored if name not in state)]:
        raise origin.refuse(
            WEIGHTS, f"they are not those of its config: {wrong[0][:80]} is in one of them only"
        )
    return made.to(settings.device)


def _preprocessor(settings: Any, folder: Path, origin: Origin, fetched: bool) -> Any:
    """Preprocessor that lerobot-train saved beside the weights, with the statistics it normalises by."""
    from lerobot.processor import PolicyProcessorPipeline
    from lerobot.rewards.factory import make_reward_pre_post_processors

    found = sorted(folder.glob(PREPROCESSOR))
    try:
        if not found and not hasattr(settings, "normalization_mapping"):
            return make_reward_pre_post_processors(settings)[0]
        if len(found) != 1:
            raise origin.refuse(PREPROCESSOR, f"{len(found)} there, and lerobot-train saves one; give that")
        check_processor(folder, found[0].name, origin, fetched=fetched)
        device = {"device_processor": {"device": settings.device}}
        return PolicyProcessorPipeline.from_pretrained(folder, found[0].name, overrides=device)
    except InputError:
        raise
    except Exception as error:  # a step's own code, given what the file says
        raise origin.refuse(PREPROCESSOR, f"cannot be loaded ({brief(error)})") from error


def _try(stand_in: StandIn, spec: WorldModelSpec, origin: Origin) -> None:
    grey = torch.full((BLANK, len(spec.cameras), 3, *spec.image_size), 0.5, device=device_of(stand_in))
    try:
        said = stand_in.said(grey, grey)
    except Exception as error:  # it reads something that dreams do not have
        raise origin.refuse(CONFIG, f"it cannot judge the frames of a dream ({brief(error)})") from error
    if said.shape != (BLANK,) or not bool(((said >= 0) & (said <= 1)).all()):
        shown = said.flatten()[:4].tolist()
        why = f"its answer to {BLANK} frames is {shown} of shape {tuple(said.shape)}, not a probability each"
        raise origin.refuse(CONFIG, why)


def _sized(frames: Tensor, size: tuple[int, int]) -> Tensor:
    if frames.shape[-2:] == size:
        return frames
    return functional.interpolate(frames, size=size, mode="bilinear", antialias=True).clamp(0, 1)
