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
"""What a checkpoint's files say is checked before LeRobot, transformers or PyTorch believe it.

LeRobot imports and calls whatever a processor's ``class`` names, with the arguments that stand beside it, and
joins ``state_file`` to the folder as it is. Names of backbones and tokenisers may be folders of this machine.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from accerl_lerobot.checkpoint import BACKBONE, CONFIG_FOLDERS, PREPROCESSOR, STEP_FOLDERS
from accerl_lerobot.errors import InputError
from accerl_lerobot.safety import (
    HUB_ID,
    MIB,
    Origin,
    brief,
    check_not_pickled,
    check_number,
    check_safetensors,
    check_shape,
    file_size,
    read_json,
    safe_join,
)

CONFIG, WEIGHTS = "config.json", "model.safetensors"
OURS, VALUE_HEAD, FAMILY = "accerl.json", "value_head.safetensors", "family.safetensors"
FILES = ("*.json", WEIGHTS, "policy_*.safetensors", VALUE_HEAD, FAMILY, f"{BACKBONE}/*")
"""What is fetched of a checkpoint on the Hub."""
PROCESSORS = (PREPROCESSOR, "policy_postprocessor.json")
STEPS_MOST, FEATURES_MOST, DEPTH_MOST = 64, 100, 20
BESIDE_MOST, FILES_MOST = 64 * MIB, 1_000
"""Bytes of a file of the backbone's folder, such as a tokeniser, and how many there may be."""
IMAGE_MOST, VECTOR_MOST, SIDE_MOST = 3 * 4096**2, 65_536, 4096
MOST = {
    "n_obs_steps": 64, "chunk_size": 4096, "n_action_steps": 4096, "horizon": 4096, "num_steps": 1000,
    "num_inference_steps": 1000, "num_train_timesteps": 100_000, "tokenizer_max_length": 8192,
    "max_decoding_steps": 8192, "max_action_tokens": 8192, "max_state_dim": 65_536, "max_action_dim": 65_536,
    "num_bins": 65_536, "empty_cameras": 64,
}  # fmt: skip
"""What a policy's config may ask for at most, where it is time or memory and not in the weights."""
SIDES = ("resize_imgs_with_padding", "image_resolution", "crop_shape", "resize_shape", "image_resize")


def fetched_checkpoint(path: str, revision: str | None, field: str) -> Path:
    """Where a checkpoint's files are, once checked; those of a Hub repository are fetched.

    Args:
        path: a folder here, or a Hub id.
        revision: of the latter.
        field: that named it, for the error.

    Raises:
        InputError: there is no checkpoint, or it is not to be trusted, see `check_checkpoint`.
    """
    from huggingface_hub import snapshot_download

    folder = Path(path).expanduser()
    local = folder.exists()
    if not local and not path.startswith((".", "/", "~")):
        try:
            folder = Path(snapshot_download(path, revision=revision, allow_patterns=list(FILES)))
        except (OSError, ValueError) as error:
            remedy = f"not a directory here and not loadable from the Hub ({brief(error)})"
            raise InputError(field, path, remedy) from error
    if not (folder / CONFIG).is_file():
        raise InputError(field, path, "no config.json there; give the folder named pretrained_model")
    check_checkpoint(folder, Origin(field, path), fetched=not local)
    return folder


def check_checkpoint(folder: Path, origin: Origin, *, fetched: bool = False) -> dict[str, Any]:
    """All files of a LeRobot checkpoint that are read, before they are.

    Args:
        folder: the one named ``pretrained_model``.
        origin: what named it.
        fetched: it is from the Hub, and names of this machine's folders have no business in it.

    Returns:
        The content of its ``config.json``.

    Raises:
        InputError: a file is not what it says, leads elsewhere, or asks for what is not there.
    """
    config = read_json(safe_join(folder, CONFIG, origin), origin)
    check_policy_config(config, origin)
    for key, own in CONFIG_FOLDERS.items():
        check_origin(config.get(key), folder / own, f"{CONFIG}: {key}", origin, fetched)
    check_origin(config.get("vision_encoder_name"), None, f"{CONFIG}: vision_encoder_name", origin, fetched)
    for name in PROCESSORS:
        if safe_join(folder, name, origin).exists():
            check_processor(folder, name, origin, fetched=fetched)
    check_not_pickled(folder, WEIGHTS, origin)
    for name in (WEIGHTS, VALUE_HEAD, FAMILY):
        if safe_join(folder, name, origin).exists():
            check_safetensors(folder / name, origin)
    if safe_join(folder, OURS, origin).exists():
        check_ours(read_json(folder / OURS, origin), origin)
    _check_beside(folder, origin)
    return config


def check_policy_config(config: dict[str, Any], origin: Origin) -> None:
    """Sizes in a policy's ``config.json`` that its weights do not bound.

    Raises:
        InputError: one is not a size.
    """
    for name in ("input_features", "output_features"):
        features = config.get(name) or {}
        if not isinstance(features, dict) or len(features) > FEATURES_MOST:
            raise origin.refuse(f"{CONFIG}: {name}", f"a mapping of up to {FEATURES_MOST} features is wanted")
        for key, feature in features.items():
            where = f"{CONFIG}: {name}.{key[:60]}"
            if not isinstance(feature, dict):
                raise origin.refuse(where, "a type and a shape are wanted")
            shape = feature.get("shape")
            image = isinstance(shape, list) and len(shape) == 3
            check_shape(shape, IMAGE_MOST if image else VECTOR_MOST, where, origin)
    for key, most in MOST.items():
        if config.get(key) is not None:
            check_number(config[key], 0, most, f"{CONFIG}: {key}", origin)
    for key in SIDES:
        sides = config.get(key)
        for side in sides if isinstance(sides, list) else [] if sides is None else [sides]:
            check_number(side, 1, SIDE_MOST, f"{CONFIG}: {key}", origin)


def check_processor(folder: Path, name: str, origin: Origin, *, fetched: bool = False) -> None:
    """One of a checkpoint's processor files, and the state files it names.

    Raises:
        InputError: a step is not one of LeRobot's registered ones, or names files elsewhere.
    """
    steps = read_json(folder / name, origin).get("steps")
    if not isinstance(steps, list) or len(steps) > STEPS_MOST:
        raise origin.refuse(name, f"a list of up to {STEPS_MOST} steps is wanted")
    for step in steps:
        if not isinstance(step, dict) or not isinstance(step.get("config", {}), dict):
            raise origin.refuse(name, "a step is a mapping with a mapping named config")
        kind = step.get("registry_name")
        if not isinstance(kind, str) or "class" in step:
            remedy = (
                "only steps with a registry_name are loaded: LeRobot would import and call the class that"
            )
            raise origin.refuse(f"{name}: {str(step.get('class'))[:60]}", f"{remedy} stands here")
        if "state_file" in step:
            check_safetensors(safe_join(folder, step["state_file"], origin), origin)
        if kind in STEP_FOLDERS:
            option, own = STEP_FOLDERS[kind]
            named = step.get("config", {}).get(option)
            check_origin(named, folder / own, f"{name}: {option}", origin, fetched)


def check_ours(ours: dict[str, Any], origin: Origin) -> None:
    """The content of ``accerl.json``.

    Raises:
        InputError: it is of another form than `loading.save_pretrained` writes.
    """
    for key in ("sampler", "value_head", "rename_map"):
        if not isinstance(ours.get(key, {}), dict):
            raise origin.refuse(f"{OURS}: {key}", "a mapping is wanted; remove the file to start without it")


def check_origin(name: Any, own: Path | None, what: str, origin: Origin, fetched: bool) -> None:
    """A backbone or tokeniser is the checkpoint's own, the Hub's, or, of a local checkpoint, at a path.

    Args:
        name: what its config says.
        own: the checkpoint's own folder of it, where it may have one.
        what: file and key that say so, for the error.
        origin: what named the checkpoint.
        fetched: it is from the Hub, and folders of this machine are none of its business.

    Raises:
        InputError: it is something else.
    """
    if name is None:
        return
    if not isinstance(name, str) or len(name) > 1024 or "\x00" in name:
        raise origin.refuse(what, "a name is wanted")
    if own is not None and own.is_dir() and Path(name).is_absolute():
        return  # it is not read: the checkpoint's own goes first
    if Path(name).is_absolute():
        if fetched or ".." in Path(name).parts:
            remedy = (
                "a folder of this machine, which a checkpoint from elsewhere may not name; put a copy into"
            )
            raise origin.refuse(what, f"{name[:80]!r}: {remedy} {BACKBONE}/")
    elif not HUB_ID.fullmatch(name):
        raise origin.refuse(what, f"{name[:80]!r} is neither a Hub id nor an absolute path")


def _check_beside(folder: Path, origin: Origin) -> None:
    """The backbone's own folder: sizes, links, and attention that would be fetched as compiled code."""
    for count, path in enumerate(_walk(safe_join(folder, BACKBONE, origin))):
        if count >= FILES_MOST:
            raise origin.refuse(BACKBONE, f"more than {FILES_MOST} files")
        name = path.relative_to(folder).as_posix()
        safe_join(folder, name, origin)
        if path.suffix == ".safetensors":
            check_safetensors(path, origin)
        elif file_size(path, origin) > BESIDE_MOST:
            raise origin.refuse(name, f"more than {BESIDE_MOST} bytes")
        if path.name == CONFIG:
            for key, value in _entries(read_json(path, origin)):
                if "attn_implementation" in key and "/" in str(value):
                    raise origin.refuse(name, f"{key} names code on the Hub; use sdpa or eager")


def _walk(folder: Path) -> Iterator[Path]:
    for directory, _, files in os.walk(folder):
        yield from (Path(directory) / name for name in files)


def _entries(content: Any, depth: int = 0) -> Iterator[tuple[str, Any]]:
    if depth > DEPTH_MOST:
        return
    if isinstance(content, dict):
        for key, value in content.items():
            yield key, value
            yield from _entries(value, depth + 1)
    elif isinstance(content, list):
        for value in content:
            yield from _entries(value, depth + 1)
