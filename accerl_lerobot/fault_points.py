# SPDX-License-Identifier: Apache-2.0
"""A hook at named places in the workers, where `benchmarks/fault_injection.py` makes something go wrong.

Without the environment variable, a point is a comparison with None.
"""

from __future__ import annotations

import importlib
import os
from pathlib import Path
from typing import Any

HANDLER = "ACCERL_FAULT_HANDLER"
"""Environment variable that names a module; its ``handle(name, path)`` is called at every point."""


def fault_point(name: str, path: Path | None = None) -> bool:
    """Mark a place where a fault can be injected; `path` was just written there.

    Returns True if the value computed there is to be made non-finite.
    """
    return _handle is not None and bool(_handle(name, path))


_module = os.environ.get(HANDLER)
_handle: Any = importlib.import_module(_module).handle if _module else None
