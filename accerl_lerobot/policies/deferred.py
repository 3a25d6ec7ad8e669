# SPDX-License-Identifier: Apache-2.0
"""Import one of LeRobot's policies without the code of all others.

``lerobot.policies`` imports the config of each policy type, and with it that type's whole package: models and
processors that pull in diffusers and much of transformers, a third of the time in which a process starts.
Here such a package runs its own code when somebody asks it for something.

Only in processes that are all ours, the command line's and its workers: LeRobot's processors are found by
names that such code registers, and a user's own code may look for any of them.
"""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
import os
import re
import sys
import threading
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from types import ModuleType
from typing import Any

PARENT = "lerobot.policies"
OURS = "ACCERL_ONE_POLICY"  # environment variable of processes that are all ours
_lock = threading.RLock()


class _Package(ModuleType):
    """A package whose code has not run; its modules can be imported."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name != "__all__":
            raise AttributeError(name)
        run(self)
        return getattr(self, name)


def run(package: ModuleType) -> None:
    """Runs the code of a package that was deferred."""
    with _lock:
        if isinstance(package, _Package):
            package.__class__ = ModuleType  # type: ignore[assignment]
            loader: Any = package.__loader__
            SourceFileLoader.exec_module(loader, package)


class _Loader(SourceFileLoader):
    def exec_module(self, module: ModuleType) -> None:
        module.__class__ = _Package


class _Finder:
    @staticmethod
    def find_spec(name: str, path: Sequence[str] | None, target: Any = None) -> ModuleSpec | None:
        if name.rpartition(".")[0] != PARENT:
            return None
        spec = PathFinder.find_spec(name, path)
        if spec and spec.submodule_search_locations and spec.origin:
            spec.loader = _Loader(name, spec.origin)
        return spec


def import_policies(wanted: str | None) -> None:
    """Imports ``lerobot.policies``, and runs the package of one policy type, or of all."""
    importlib.import_module(PARENT)
    for name in [name for name in sys.modules if name.rpartition(".")[0] == PARENT]:
        if wanted is None or name == f"{PARENT}.{wanted}":
            run(sys.modules[name])


def _distributions() -> dict[str, list[str]]:
    """``importlib.metadata.packages_distributions``, but lists of installed files are read as text."""
    found: dict[str, list[str]] = {}
    for distribution in importlib.metadata.distributions():
        files = f"\n{distribution.read_text('RECORD')}"
        for name in set(re.findall(r"\n(\w+)(?:/|\.py,|\.cpython)", files)):
            found.setdefault(name, []).append(distribution.metadata["Name"])
    return found


if os.environ.get(OURS):  # now, as much of LeRobot imports the policies or diffusers
    # transformers and diffusers each ask for them. Python's own function takes five times as long.
    importlib.metadata.packages_distributions = functools.cache(_distributions)
    sys.meta_path.insert(0, _Finder)
