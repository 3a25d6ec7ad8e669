# SPDX-License-Identifier: Apache-2.0
"""Imports by name at the time of need: entries of our own tables, and packages that a user names."""

from __future__ import annotations

import importlib
from typing import Any

from accerl_lerobot.checkpoint.safety import brief
from accerl_lerobot.errors import InputError

DISCOVER = "discover_packages_path"
"""LeRobot's name for the field that names a package whose import registers new types."""


def imported(path: str) -> Any:
    """Object behind a table's ``module:name``."""
    module, _, name = path.partition(":")
    return getattr(importlib.import_module(module), name)


def discover(package: str | None, section: str = "") -> None:
    """Imports a package that registers types; None does nothing. `section` is that of the field."""
    if package is None:
        return
    field = f"{section}.{DISCOVER}" if section else DISCOVER
    if not all(part.isidentifier() for part in package.split(".")):
        raise InputError(field, package, "use the name of a package as Python imports it, e.g. my_models")
    try:
        importlib.import_module(package)
    except (Exception, SystemExit) as error:  # it is somebody's code, which may do anything
        why = f"{type(error).__name__}: {brief(error)}"
        raise InputError(field, package, f"cannot be imported ({why})") from error
