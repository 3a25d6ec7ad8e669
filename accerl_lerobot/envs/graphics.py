# SPDX-License-Identifier: Apache-2.0
"""Drawing with MuJoCo, and the OpenGL that environments draw with where there is no display.

MuJoCo and dm_control read ``MUJOCO_GL`` once, when they are imported, so `start_graphics` is called before an
environment's package is imported.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import importlib
import os
import re
import sys
import weakref
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from accerl_lerobot.errors import InputError, causes

_LIBRARIES = {
    "egl": ("libEGL.so.1", "libEGL.so"),
    "osmesa": ("libOSMesa.so.8", "libOSMesa.so.6", "libOSMesa.so"),
}
_GPU_NODES = ("/dev/nvidia0", "/dev/dri/renderD128")
HINT = (
    "without a display an offscreen OpenGL is needed: apt-get install -y libosmesa6 (MUJOCO_GL=osmesa) "
    "or apt-get install -y libegl1 libgl1-mesa-dri libgles2 (MUJOCO_GL=egl)"
)
_ABOUT_DRAWING = re.compile("OpenGL|gladLoad|glGetError|EGL|(?i:osmesa|glfw|framebuffer)|X11|DISPLAY")
_open: weakref.WeakSet[Any] = weakref.WeakSet()


def choose_backend() -> str | None:
    """The backend for a headless Linux machine: EGL where there is a GPU, else OSMesa, else EGL.

    None where MuJoCo's own default is right (a display, or not Linux), and where neither is installed.
    """
    if not _headless():
        return None
    order = ["osmesa", "egl"]
    if any(Path(node).exists() for node in _GPU_NODES):
        order.reverse()
    for backend in order:
        for library in _LIBRARIES[backend]:
            with contextlib.suppress(OSError):
                ctypes.CDLL(library)
                return backend
    return None


def start_graphics() -> None:
    """Set ``MUJOCO_GL`` to a backend that works here, unless it is set."""
    # One thread of software rendering per environment: several environments share the cores then.
    os.environ.setdefault("LP_NUM_THREADS", "1")
    if os.environ.get("MUJOCO_GL") or find_spec("mujoco") is None:
        return
    chosen = choose_backend()
    if chosen is None:
        return
    os.environ["MUJOCO_GL"] = chosen
    if "mujoco" in sys.modules:
        # MuJoCo was imported before, without a backend; only this module of it reads the variable.
        importlib.reload(sys.modules["mujoco"].gl_context)


def import_mujoco() -> ModuleType:
    """Import MuJoCo with a backend that works here; respects ``MUJOCO_GL`` if it is set."""
    start_graphics()
    given = os.environ.get("MUJOCO_GL", "")
    if given.lower() not in _LIBRARIES and _headless():
        raise InputError("MUJOCO_GL", given, HINT)
    return importlib.import_module("mujoco")


def drawing_error(error: BaseException) -> InputError | None:
    """The one line for an error that says that nothing can be drawn here; None for other errors."""
    about = next((str(link) for link in causes(error) if _ABOUT_DRAWING.search(str(link))), None)
    if about is None:
        return None
    given = os.environ.get("MUJOCO_GL", "")
    return InputError("MUJOCO_GL", given, f"the environment cannot draw ({about[:160]}); {HINT}")


class Renderers:
    """Draws a MuJoCo model; keeps one `mujoco.Renderer` for each size of image."""

    def __init__(self, model: Any) -> None:
        self._model = model
        self._by_size: dict[tuple[int, int], Any] = {}

    def draw(self, height: int, width: int, *scene: Any) -> np.ndarray:
        """Image, uint8 (height, width, 3); `scene` are arguments of ``Renderer.update_scene``."""
        if (height, width) not in self._by_size:
            # The framebuffer is exactly as large as the image.
            self._model.vis.global_.offheight = height
            self._model.vis.global_.offwidth = width
            created = import_mujoco().Renderer(self._model, height, width)
            close_at_exit(created)
            self._by_size[height, width] = created
        renderer = self._by_size[height, width]
        renderer.update_scene(*scene)
        return renderer.render()

    def close(self) -> None:
        for renderer in self._by_size.values():
            renderer.close()


def draw_fast(model: Any) -> None:
    """Has MuJoCo draw no shadows and reflections, and without multisampling."""
    quality = model.vis.quality
    quality.offsamples = 0
    quality.shadowsize = 0
    model.light_castshadow[:] = 0
    model.mat_reflectance[:] = 0


def diverged(data: Any) -> bool:
    """True if MuJoCo met non-finite numbers in this episode and silently reset itself."""
    warning = import_mujoco().mjtWarning
    bad = (warning.mjWARN_BADQPOS, warning.mjWARN_BADQVEL, warning.mjWARN_BADQACC)
    return any(data.warning.number[kind] for kind in bad)


def close_at_exit(drawing: Any) -> None:
    """Have `drawing` closed when the interpreter ends, unless it is gone by then; call it once it has drawn.

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
