# SPDX-License-Identifier: Apache-2.0
"""LeRobot's MetaWorld tables (instructions, difficulty groups, experts), read without importing LeRobot.

They are one JSON file inside the LeRobot package; importing ``lerobot.envs`` to reach it would cost a rollout
worker four seconds and several hundred megabytes.
"""

from __future__ import annotations

import difflib
import functools
import importlib.util
import json
from pathlib import Path
from typing import Any

from accerl_lerobot.errors import InputError


@functools.cache
def _tables() -> dict[str, Any]:
    spec = importlib.util.find_spec("lerobot")
    if spec is None or not spec.submodule_search_locations:
        raise ModuleNotFoundError("LeRobot is not installed: pip install lerobot[metaworld]", name="lerobot")
    path = Path(spec.submodule_search_locations[0]) / "envs" / "metaworld_config.json"
    return json.loads(path.read_text())


def all_tasks() -> tuple[str, ...]:
    """All 50 names, sorted."""
    return tuple(sorted(_tables()["TASK_DESCRIPTIONS"]))


def groups() -> dict[str, tuple[str, ...]]:
    """LeRobot's difficulty groups, plus ``all``."""
    return {k: tuple(v) for k, v in _tables()["DIFFICULTY_TO_TASKS"].items()} | {"all": all_tasks()}


def description(task: str) -> str:
    """The instruction text of `task`, as LeRobot's own datasets have it."""
    return _tables()["TASK_DESCRIPTIONS"][task]


def expert_name(task: str) -> str:
    """Class name in ``metaworld.policies`` of the scripted expert for `task`."""
    return _tables()["TASK_POLICY_MAPPING"][task]


def resolve(text: str, field: str = "env.task") -> tuple[str, ...]:
    """Expands comma-separated names and groups; keeps the order, drops repetitions.

    Example:
        >>> resolve("drawer-open-v3, door-open-v3")
        ('drawer-open-v3', 'door-open-v3')

    Raises:
        InputError: a name is neither a task nor a group, or there is none.
    """
    known, named = set(all_tasks()), groups()
    found: dict[str, None] = {}
    for name in (part.strip() for part in text.split(",")):
        if name in named:
            found |= dict.fromkeys(named[name])
        elif name in known:
            found[name] = None
        else:
            raise InputError(field, text, _remedy(name, sorted(known), list(named)))
    return tuple(found)


def _remedy(name: str, tasks: list[str], group_names: list[str]) -> str:
    wanted = name.replace("metaworld-", "").replace("-v2", "-v3")
    close = difflib.get_close_matches(wanted, tasks, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(close)}? Otherwise " if close else ""
    return (
        f"{name!r} is not a MetaWorld task; {hint}use names such as drawer-open-v3, separated by commas, "
        f"or a group: {', '.join(group_names)}"
    )
