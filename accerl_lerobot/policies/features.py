# SPDX-License-Identifier: Apache-2.0
"""Inputs and outputs of environments, datasets and policies, and checks that they fit each other."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from accerl_lerobot.errors import InputError

if TYPE_CHECKING:
    from accerl_lerobot.envs import WorldSpec

logger = logging.getLogger(__name__)

STATE, ENV_STATE, ACTION = "observation.state", "observation.environment_state", "action"
RESIZERS = ("resize_imgs_with_padding", "image_resolution", "resize_shape")
"""Fields of LeRobot's policy configs: where one is set, the policy resizes its images by itself."""


@dataclass(frozen=True, kw_only=True)
class Features:
    """Inputs and outputs of an environment, a dataset or a policy, by LeRobot's names."""

    shapes: dict[str, tuple[int, ...]]  # name → shape; images are (channels, height, width)
    any_size: bool = False  # images of any height and width fit
    fps: float | None = None  # control rate in Hz; None: not known
    labelled_fps: tuple[float, ...] = ()  # see `WorldSpec.labelled_fps`
    tasks: tuple[str, ...] = ()  # instructions; empty: not known


def env_features(spec: WorldSpec) -> Features:
    """Features that an environment offers."""
    shapes: dict[str, tuple[int, ...]] = {name: (c, h, w) for name, (h, w, c) in spec.images.items()}
    shapes |= {STATE: (spec.state_dim,), ACTION: (spec.action_dim,)}
    labels = spec.labelled_fps
    return Features(shapes=shapes, fps=spec.fps, labelled_fps=labels, tasks=spec.instructions)


def policy_features(policy: Any) -> Features:
    """Features that a policy needs, from LeRobot's config of it."""
    features = (policy.input_features or {}) | (policy.output_features or {})
    return Features(shapes=_shapes(features), any_size=resizes(policy))


def resizes(policy: Any) -> bool:
    """True if a policy resizes its images by itself, by LeRobot's config of it."""
    return any(getattr(policy, field, None) for field in RESIZERS)


def pads(policy: Any) -> bool:
    """True if a policy pads states and actions and goes without some of its cameras, as SmolVLA and π0 do."""
    return hasattr(policy, "max_state_dim") and hasattr(policy, "empty_cameras")


def fine_tuned_features(policy: Any, dataset: Features, renames: dict[str, str]) -> Features:
    """Features that a policy needs once it is fine-tuned on a dataset; `renames` is dataset name → its name.

    One that pads takes the dataset's states and actions, and of its cameras those that are there; without
    `renames` LeRobot wants one's cameras to be among the other's.
    """
    needed = policy_features(policy)
    there = {renames.get(name, name): shape for name, shape in dataset.shapes.items()}
    mine, theirs = ({k for k, s in shapes.items() if len(s) == 3} for shapes in (needed.shapes, there))
    if not pads(policy) or not mine & theirs or not (renames or mine <= theirs or theirs <= mine):
        return needed
    return replace(needed, shapes={name: there[name] for name in needed.shapes if name in there})


def dataset_features(meta: Any) -> Features:
    """Features of a LeRobotDataset, which a policy trained on it needs."""
    from lerobot.utils.feature_utils import dataset_to_policy_features

    shapes = _shapes(dataset_to_policy_features(meta.features))
    if meta.camera_keys:
        shapes.pop(ENV_STATE, None)  # see `demos.guarded_train`
    return Features(shapes=shapes, fps=meta.fps, tasks=tuple(map(str, meta.tasks.index)))


def _shapes(features: dict[str, Any]) -> dict[str, tuple[int, ...]]:
    """Shapes of the features that policies read or write."""
    named = {k: f for k, f in features.items() if f.type.name == "VISUAL" or k in (STATE, ENV_STATE, ACTION)}
    return {k: tuple(f.shape) for k, f in named.items() if ".empty_camera_" not in k}


def check_features(
    needed: Features,
    offered: Features,
    rename_map: dict[str, str],
    field: str,
    value: object,
    offerer: str = "environment",
) -> None:
    """Compares what a policy, or the policy that a dataset makes, needs with what is offered to it.

    `rename_map` is offered name → needed name; the error names `field` and its `value`.
    """
    renames = "policy.rename_map"
    sources = {name for name in offered.shapes if name != ACTION}
    if unknown := sorted(rename_map.keys() - sources):
        names = ", ".join(sorted(sources))
        raise InputError(renames, unknown[0], f"the {offerer} has no such feature; it offers {names}")
    shapes: dict[str, tuple[int, ...]] = {}
    for name, shape in offered.shapes.items():
        new = rename_map.get(name, name)
        if new in shapes:
            raise InputError(renames, rename_map, f"two features of the {offerer} would be {new}")
        shapes[new] = shape
    for name, shape in needed.shapes.items():
        image = len(shape) == 3
        if name not in shapes:
            same = [k for k, other in shapes.items() if len(other) == len(shape) and k != ACTION]
            offers = ", ".join(same) or "none"
            remedy = "; choose env.camera (env.images of gym), or map names with policy.rename_map" * image
            raise InputError(field, value, f"no {name} in the {offerer}, which offers {offers}{remedy}")
        skip = 1 if image and needed.any_size else len(shape)
        if shapes[name][:skip] != shape[:skip]:
            remedy = "give both one image size" if image else "choose parties that were made for each other"
            sizes = f"its {name} is {shape}, but {shapes[name]} in the {offerer}"
            raise InputError(field, value, f"{sizes}; {remedy}")
    rates = (offered.fps, *offered.labelled_fps) if offered.fps else ()
    if needed.fps and rates and not any(math.isclose(needed.fps, rate) for rate in rates):
        why = f"recorded at {needed.fps:g} Hz, but the environment runs at {offered.fps:g} Hz"
        remedy = "its actions would be executed at another rate; use a dataset of this rate"
        raise InputError(field, value, f"{why}: {remedy}, or with env.type=gym set env.fps")
    known = {_plain(text) for text in needed.tasks}
    missing = [text for text in offered.tasks if _plain(text) not in known]
    if known and missing:
        has = ", ".join(map(repr, needed.tasks[:4])) + (" …" if len(needed.tasks) > 4 else "")
        message = f"no episode of {', '.join(map(repr, missing[:4]))}, the environment's task: it has {has}"
        if len(missing) == len(offered.tasks):
            raise InputError(field, value, f"{message}; choose env.task accordingly")
        logger.warning("%s=%r: %s", field, value, message)


def _plain(text: str) -> str:
    """An instruction without what does not count: letter case, spaces and a full stop."""
    return " ".join(text.lower().split()).rstrip(".")
