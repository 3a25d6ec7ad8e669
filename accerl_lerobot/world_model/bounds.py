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
"""Upper bounds on what a world model's files say of it, where its weights do not give any."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from accerl_lerobot.imports import DISCOVER
from accerl_lerobot.safety import Origin, check_name, check_number
from accerl_lerobot.world_model.config import PIXELS

CONFIG = "config.json"
SPEC = {
    "state_dim": (0, 65_536),
    "action_dim": (1, 65_536),
    "chunk": (1, 4096),
    "fps": (1, 10_000),
    "context": (1, 64),
}
"""Field of a `WorldModelSpec` → its smallest and largest value."""
CONTEXT = {"context": (1, 64)}
MODEL = {"steps": (1, 1000), "heads": (2, 64)}
NETWORK = {"space_to_depth": (1, 64), "blocks": (1, 64), "condition": (1, 16_384), "planes": (0, 1024)}
CAMERAS_MOST, SIDE_MOST, LEVELS_MOST, WIDTH_MOST = 16, 2048, 8, 16_384
TASKS_MOST, NAME_MOST = 4096, 200


def check_spec(spec: Any, origin: Origin) -> None:
    """The room ``spec`` of its ``config.json``.

    Raises:
        InputError: it is not one, or larger than any world.
    """
    mapping = _mapping(spec, "spec", origin)
    _numbers(mapping, SPEC, "spec", origin, needed=True)
    cameras, provides = mapping.get("cameras"), mapping.get("provides")
    if not isinstance(cameras, list) or not 0 < len(cameras) <= CAMERAS_MOST:
        raise origin.refuse(f"{CONFIG}: spec.cameras", f"a list of 1 to {CAMERAS_MOST} names is wanted")
    for camera in cameras:
        check_name(camera, f"{CONFIG}: spec.cameras", origin)
    tasks = mapping.get("tasks", [])
    if not isinstance(tasks, list) or len(tasks) > TASKS_MOST or not all(map(_is_name, tasks)):
        wanted = f"a list of at most {TASKS_MOST} names of at most {NAME_MOST} printable characters is wanted"
        raise origin.refuse(f"{CONFIG}: spec.tasks", wanted)
    if not isinstance(provides, list) or not all(isinstance(name, str) for name in provides):
        raise origin.refuse(f"{CONFIG}: spec.provides", "a list of names is wanted")
    _sides(mapping.get("image_size"), 2, SIDE_MOST, "spec.image_size", origin)


def check_model(model: Any, known: Iterable[str], origin: Origin) -> None:
    """The room ``model`` of its ``config.json``; what it leaves out has a default.

    Args:
        model: what it says; of a class that is not ours, its config has to look at the rest.
        known: types that are registered.
        origin: where it came from.

    Raises:
        InputError: it is not one, of no known type, or asks for more layers than such a model has.
    """
    mapping = _mapping(model, "model", origin)
    kind, names = mapping.get("type"), sorted(known)
    if kind is None:
        raise origin.refuse(f"{CONFIG}: model.type", "it has none, as earlier versions wrote; learn it again")
    if kind not in names:
        remedy = f"{str(kind)[:60]!r}; use one of {', '.join(names)}, or name its package"
        package = origin.field.removesuffix("path") + DISCOVER
        raise origin.refuse(f"{CONFIG}: model.type", f"{remedy}: {package}")
    _numbers(mapping, CONTEXT, "model", origin)
    if kind != PIXELS:
        return
    _numbers(mapping, MODEL, "model", origin)
    network = _mapping(mapping.get("network", {}), "model.network", origin)
    _numbers(network, NETWORK, "model.network", origin)
    if "channels" in network:
        _sides(network["channels"], None, WIDTH_MOST, "model.network.channels", origin)


def check_success_model(config: dict[str, Any], origin: Origin) -> None:
    """The ``config.json`` of its success model.

    Raises:
        InputError: it is of another type, or asks for more layers than such a model has.
    """
    if config.get("type") != "success_pairs":
        raise origin.refuse(f"{CONFIG}: type", f"{str(config.get('type'))[:60]!r}; use success_pairs")
    _numbers(config, {"chunk": (1, 4096), "hidden": (1, WIDTH_MOST), "shift": (0, 256)}, "", origin)
    if "channels" in config:
        _sides(config["channels"], None, WIDTH_MOST, "channels", origin)


def _is_name(value: object) -> bool:
    return isinstance(value, str) and 0 < len(value) <= NAME_MOST and value.isprintable()


def _mapping(value: Any, what: str, origin: Origin) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise origin.refuse(
            f"{CONFIG}: {what}", "not a world model of accerl world-model; a mapping is wanted"
        )
    return value


def _numbers(
    mapping: dict[str, Any],
    bounds: dict[str, tuple[int, int]],
    room: str,
    origin: Origin,
    needed: bool = False,
) -> None:
    for key, (low, high) in bounds.items():
        if key in mapping or needed:
            value, where = mapping.get(key), f"{CONFIG}: {room}.{key}"
            if not isinstance(value, int):
                raise origin.refuse(where, f"{str(value)[:40]!r}; use a whole number")
            check_number(value, low, high, where, origin)


def _sides(sizes: Any, count: int | None, most: int, what: str, origin: Origin) -> None:
    where = f"{CONFIG}: {what}"
    if (
        not isinstance(sizes, list)
        or len(sizes) != (count or len(sizes))
        or not 0 < len(sizes) <= LEVELS_MOST
    ):
        raise origin.refuse(where, f"a list of {count or f'1 to {LEVELS_MOST}'} sizes is wanted")
    for size in sizes:
        if not isinstance(size, int):
            raise origin.refuse(where, f"{str(size)[:40]!r}; use whole numbers")
        check_number(size, 1, most, where, origin)
