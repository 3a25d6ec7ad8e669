# SPDX-License-Identifier: Apache-2.0
"""Inputs and outputs of environments, datasets and policies, and checks that they fit each other."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from accerl_lerobot.errors import InputError

if TYPE_CHECKING:
    from accerl_lerobot.envs import EnvironmentSpec

logger = logging.getLogger(__name__)

STATE, ENV_STATE, ACTION = "observation.state", "observation.environment_state", "action"
TEXT_FIELDS = ("tokenizer_", "text_encoder_", "text_tokenizer_", "vlm_", "qwen_")
"""Beginnings of the fields of LeRobot's policy configs that only policies with an instruction have."""
OUTSIDE_SHARE, OUTSIDE_SLACK = 0.05, 0.01
"""Share of a dataset's actions to be warned of that lie outside the bounds by this part of their width."""
RESIZERS = (
    "resize_imgs_with_padding",
    "image_resolution",
    "resize_shape",
    "image_resize_shape",
    "resize_images_to",
)
"""Fields of LeRobot's policy configs: where one is set, the policy resizes its images by itself."""


Shapes = dict[str, tuple[int, ...]]
"""Shapes of features by LeRobot's names; images are (channels, height, width)."""


@dataclass(frozen=True, kw_only=True)
class Features:
    """Inputs and outputs of an environment, a dataset or a policy, by LeRobot's names."""

    shapes: Shapes
    any_size: bool = False  # images of any height and width fit
    fps: float | None = None  # control rate in Hz; None: not known
    labelled_fps: tuple[float, ...] = ()  # see `EnvironmentSpec.labelled_fps`
    tasks: tuple[str, ...] = ()  # instructions; empty: not known
    unusable: dict[str, str] = field(default_factory=dict)  # name → why no policy can read it
    reads_text: bool = False  # True for a policy that is given an instruction


def env_features(spec: EnvironmentSpec) -> Features:
    """Features that an environment offers."""
    shapes: Shapes = {}
    for name, (height, width, channels) in spec.images.items():
        shapes[name] = (channels, height, width)
    shapes[STATE] = (spec.state_dim,)
    shapes[ACTION] = (spec.action_dim,)
    labels = spec.labelled_fps
    return Features(shapes=shapes, fps=spec.fps, labelled_fps=labels, tasks=spec.instructions)


def policy_features(policy: Any) -> Features:
    """Features that a policy needs, from LeRobot's config of it."""
    features = (policy.input_features or {}) | (policy.output_features or {})
    text = any(name.startswith(TEXT_FIELDS) for name in vars(policy))
    return Features(shapes=_shapes(features), any_size=resizes(policy), reads_text=text)


def resizes(policy: Any) -> bool:
    """True if a policy resizes its images by itself, by LeRobot's config of it."""
    return any(getattr(policy, field, None) for field in RESIZERS)


def pads(policy: Any) -> bool:
    """True if a policy pads states and actions and goes without some of its cameras, as SmolVLA and π0 do."""
    return hasattr(policy, "max_state_dim") and hasattr(policy, "empty_cameras")


def fine_tuned_features(policy: Any, dataset: Features) -> Features:
    """Features that a policy needs once it is fine-tuned on a dataset.

    One that pads takes the dataset's states and actions, and of its cameras those that are there; LeRobot
    wants one's cameras to be among the other's.
    """
    needed = policy_features(policy)
    read = cameras(needed.shapes)
    recorded = cameras(dataset.shapes)
    matching = read <= recorded or recorded <= read
    if not (pads(policy) and read & recorded and matching):
        return needed
    shapes = {name: dataset.shapes[name] for name in needed.shapes if name in dataset.shapes}
    return replace(needed, shapes=shapes)


def cameras(shapes: Shapes) -> set[str]:
    """Names of the images among some features."""
    return {name for name, shape in shapes.items() if len(shape) == 3}


def dataset_features(meta: Any) -> Features:
    """Features of a LeRobotDataset, which a policy trained on it needs."""
    shapes = dataset_shapes(meta)
    unusable: dict[str, str] = {}
    if meta.camera_keys:
        shapes.pop(ENV_STATE, None)  # see `demos.guarded_train`
    for name in (STATE, ACTION):
        parts = [key for key in meta.features if key.startswith(f"{name}.")]
        if parts and name not in shapes:
            hint = f"join them into one {name} with LeRobot's add_features"
            unusable[name] = f"it is in parts ({', '.join(parts)}); {hint}"
    tasks = tuple(map(str, meta.tasks.index))
    return Features(shapes=shapes, fps=meta.fps, tasks=tasks, unusable=unusable)


def dataset_shapes(meta: Any) -> Shapes:
    """Shapes of a LeRobotDataset's features; images are (channels, height, width)."""
    from lerobot.utils.feature_utils import dataset_to_policy_features

    return _shapes(dataset_to_policy_features(meta.features))


def _shapes(features: dict[str, Any]) -> Shapes:
    """Shapes of the features that policies read or write."""
    shapes: Shapes = {}
    for name, feature in features.items():
        camera = feature.type.name == "VISUAL" and ".empty_camera_" not in name
        if camera or name in (STATE, ENV_STATE, ACTION):
            shapes[name] = tuple(feature.shape)
    return shapes


def check_features(
    needed: Features,
    offered: Features,
    rename_map: dict[str, str],
    field: str,
    value: object,
    offerer: str = "environment",
    hint: str = "",
) -> None:
    """Compares what a policy, or the policy that a dataset makes, needs with what is offered to it.

    `rename_map` is offered name → needed name; the error names `field` and its `value`, and ends with `hint`
    where an image is missing.
    """
    renames = "policy.rename_map"
    shapes: Shapes = {}
    for name, shape in offered.shapes.items():
        new = rename_map.get(name, name)
        if new in shapes:
            raise InputError(renames, rename_map, f"two features of the {offerer} would be {new}")
        shapes[new] = shape
    names = ", ".join(name for name in offered.shapes if name != ACTION) or "none"
    for name in sorted(rename_map.keys() - offered.shapes.keys()):
        raise InputError(renames, name, f"the {offerer} has no such feature; it offers {names}")
    for name, shape in needed.shapes.items():
        image = len(shape) == 3
        if name in offered.unusable:
            raise InputError(field, value, f"no {name} in the {offerer}: {offered.unusable[name]}")
        if name not in shapes:
            why = f"no {name} in the {offerer}, which offers {names}"
            if image:
                why += "; choose env.camera (env.images of gym), or map names with policy.rename_map" + hint
            raise InputError(field, value, why)
        compared = 1 if image and needed.any_size else None  # the channels
        if shapes[name][:compared] != shape[:compared]:
            advice = "give both one image size" if image else "choose parties that were made for each other"
            sizes = f"its {name} is {shape}, but {shapes[name]} in the {offerer}"
            raise InputError(field, value, f"{sizes}; {advice}")
    if needed.fps and offered.fps:
        rates = (offered.fps, *offered.labelled_fps)
        if not any(math.isclose(needed.fps, rate) for rate in rates):
            why = f"recorded at {needed.fps:g} Hz, but the environment runs at {offered.fps:g} Hz"
            advice = "its actions would be executed at another rate; use a dataset of this rate"
            raise InputError(field, value, f"{why}: {advice}, or with env.type=gym set env.fps")
    if needed.reads_text and offerer == "environment" and not offered.tasks:
        why = "the policy reads an instruction, and the environment gives none; name it in env.task"
        logger.warning("%s=%r: %s", field, value, why)
    _check_tasks(needed.tasks, offered.tasks, field, value)


def _check_tasks(needed: tuple[str, ...], offered: tuple[str, ...], field: str, value: object) -> None:
    """Compares a dataset's instructions with an environment's."""
    missing = [text for text in offered if text not in needed]
    if not needed or not missing:
        return
    has = ", ".join(map(repr, needed[:4]))
    lacks = ", ".join(map(repr, missing[:4]))
    message = f"no episode of {lacks}, the environment's task: it has {has}"
    known = {_plain(text) for text in needed}
    if known.isdisjoint(map(_plain, offered)):
        tool = "lerobot-edit-dataset --operation.type=modify_tasks"
        raise InputError(field, value, f"{message}; choose env.task accordingly, or change them with {tool}")
    logger.warning("%s=%r: %s; policies tell texts apart", field, value, message)


def check_actions(actions: np.ndarray, spec: EnvironmentSpec, field: str, value: object) -> None:
    """Warns where many of a dataset's actions (N, A) lie outside the range that the environment executes."""
    slack = OUTSIDE_SLACK * (spec.action_high - spec.action_low)
    below = actions < spec.action_low - slack
    above = actions > spec.action_high + slack
    share = (below | above).mean(0)
    i = int(share.argmax())
    if share[i] < OUTSIDE_SHARE:
        return
    column = actions[:, i]
    logger.warning(
        "%s=%r: %.0f%% of its actions lie outside the environment's bounds, which cut them off: number %d is "
        "from %.4g to %.4g in the dataset, and %.4g to %.4g in the environment; are both in the same unit?",
        field, value, 100 * share[i], i, column.min(), column.max(), spec.action_low[i], spec.action_high[i],
    )  # fmt: skip


def _plain(text: str) -> str:
    """An instruction without what does not count: letter case, spaces and a full stop."""
    words = text.lower().split()
    return " ".join(words).rstrip(".")
