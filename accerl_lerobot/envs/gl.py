# SPDX-License-Identifier: Apache-2.0
"""An offscreen OpenGL for MuJoCo: pick a backend before the import, and say in one line what is missing.

MuJoCo reads ``MUJOCO_GL`` once, when it is imported: call `import_mujoco` before importing what uses it.
"""

from __future__ import annotations

import atexit
import ctypes
import importlib
import os
import sys
import weakref
from pathlib import Path
from types import ModuleType
from typing import Any

from accerl_lerobot.errors import InputError

_LIBRARIES = {
    "egl": ("libEGL.so.1", "libEGL.so"),
    "osmesa": ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"),
}
_GPU_NODES = ("/dev/nvidia0", "/dev/dri/renderD128")
REMEDY = (
    "install an offscreen OpenGL: apt-get install -y libosmesa6 (MUJOCO_GL=osmesa) "
    "or apt-get install -y libegl1 libgl1-mesa-dri libgles2 (MUJOCO_GL=egl)"
)
_open: weakref.WeakSet[Any] = weakref.WeakSet()


def choose_backend() -> str | None:
    """Names the backend for a headless Linux machine: EGL where there is a GPU, else OSMesa, else EGL.

    Returns:
        ``"egl"``, ``"osmesa"``, or None where MuJoCo's own default is right (a display, or not Linux).

    Raises:
        InputError: neither library is installed.
    """
    if not _headless():
        return None
    order = ("egl", "osmesa") if any(Path(node).exists() for node in _GPU_NODES) else ("osmesa", "egl")
    for backend in order:
        if any(_loads(library) for library in _LIBRARIES[backend]):
            return backend
    raise InputError("MUJOCO_GL", "", REMEDY)


def import_mujoco() -> ModuleType:
    """Imports MuJoCo with a backend that works here; respects ``MUJOCO_GL`` if it is set.

    Raises:
        InputError: the backend's library is missing.
    """
    imported = "mujoco" in sys.modules
    # One software-rendering thread per world: several worlds then share the cores without fighting.
    os.environ.setdefault("LP_NUM_THREADS", "1")
    given = os.environ.get("MUJOCO_GL", "").lower()
    if given and given not in _LIBRARIES and _headless():
        # GLFW without a display takes the whole process down, with no Python error to catch.
        raise InputError("MUJOCO_GL", given, "there is no display: use egl or osmesa, or unset it")
    chosen = None if given else choose_backend()
    if chosen is not None:
        os.environ["MUJOCO_GL"] = chosen
    try:
        mujoco = importlib.import_module("mujoco")
        if imported and chosen is not None:
            # Somebody imported MuJoCo before us, without a backend; only this module reads the variable.
            importlib.reload(mujoco.gl_context)
        return mujoco
    except (ImportError, AttributeError, RuntimeError) as error:
        if isinstance(error, ModuleNotFoundError) and error.name == "mujoco":
            raise
        raise InputError("MUJOCO_GL", os.environ.get("MUJOCO_GL", ""), REMEDY) from error


def new_renderer(model: Any, height: int, width: int) -> Any:
    """A `mujoco.Renderer` whose framebuffer is exactly (height, width).

    Raises:
        InputError: no OpenGL context can be created here.
    """
    mujoco = import_mujoco()
    model.vis.global_.offheight, model.vis.global_.offwidth = height, width
    try:
        renderer = mujoco.Renderer(model, height, width)
    except (ImportError, AttributeError, RuntimeError, mujoco.FatalError) as error:
        raise InputError("MUJOCO_GL", os.environ.get("MUJOCO_GL", ""), REMEDY) from error
    close_at_exit(renderer)
    return renderer


def close_at_exit(drawing: Any) -> None:
    """Has `drawing` closed when the interpreter ends, unless it is gone by then; call it once it has drawn.

    MuJoCo registers EGL's end with its first context, and `atexit` calls the latest function first: ours has
    to be registered after it, or contexts are destroyed in a display that is gone, which prints tracebacks.
    """
    _open.add(drawing)
    atexit.unregister(_close_all)
    atexit.register(_close_all)


def _close_all() -> None:
    for drawing in tuple(_open):
        drawing.close()


def _headless() -> bool:
    return sys.platform == "linux" and not any(os.environ.get(k) for k in ("DISPLAY", "WAYLAND_DISPLAY"))


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
