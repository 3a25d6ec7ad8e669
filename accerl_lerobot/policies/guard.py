# SPDX-License-Identifier: Apache-2.0
"""Loading what is anybody's: no code of theirs is run, and nothing is unpickled.

LeRobot 0.6.1 has transformers run code from the Hub in places (`trust_remote_code=True` without a revision).
Where transformers is not told, it asks the terminal; without safetensors it unpickles. `guarded` stands at
the functions through which all of that goes, whoever calls them.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.overrides import TorchFunctionMode

from accerl_lerobot.errors import InputError

LARGE = 2**16
"""Numbers of a tensor that is not filled, see `Unfilled`."""
FILLS = frozenset((
    "normal_", "uniform_", "zero_", "fill_", "erfinv_", "trunc_normal_", "constant_", "ones_", "zeros_",
    "kaiming_uniform_", "kaiming_normal_", "xavier_uniform_", "xavier_normal_", "orthogonal_",
))  # fmt: skip


@contextlib.contextmanager
def guarded(room: str, code_revision: str | None = None) -> Iterator[None]:
    """While it lasts, transformers runs no code that comes with a model, and PyTorch unpickles nothing.

    Args:
        room: ``policy`` or ``sft``, for the error.
        code_revision: commit of the one Hub repository whose code may be run; None: none may.
    """
    from transformers import dynamic_module_utils as dynamic

    fetch, look, load = dynamic.get_cached_module_file, dynamic.check_imports, torch.load
    timeout = dynamic.TIME_OUT_REMOTE_CODE

    def fetch_pinned(name: Any, *arguments: Any, **options: Any) -> Any:
        pinned = {} if code_revision is None else {"revision": code_revision}
        return fetch(name, *arguments, **options | pinned)

    def look_first(file: Any) -> Any:  # transformers does so before it copies code to where it is run
        snapshot = Path(file).parent
        pinned = code_revision is not None and f"snapshots/{code_revision}/" in Path(file).as_posix()
        if not pinned:
            remedy = (
                "code that came with a model, which would run with your rights; read it, then name its commit"
            )
            say = f"{remedy}: {room}.trust_remote_code=true and {room}.code_revision"
            raise InputError(f"{room}.trust_remote_code", f"{snapshot.name}/{Path(file).name}", say)
        return look(file)

    def load_known(file: Any, *arguments: Any, **options: Any) -> Any:
        # torchvision's weights are fetched into this folder by PyTorch, and compared with their hash.
        known = isinstance(file, (str, Path)) and Path(file).resolve().is_relative_to(
            Path(torch.hub.get_dir()).resolve()
        )
        if not known:
            remedy = "a pickle, which may run code when it is loaded; convert it to safetensors"
            raise InputError(f"{room}.path", str(file)[:200], f"{remedy} where you trust it")
        return load(file, *arguments, **options | {"weights_only": True})

    dynamic.get_cached_module_file, dynamic.check_imports = fetch_pinned, look_first
    dynamic.TIME_OUT_REMOTE_CODE = 0  # or it would ask the terminal
    torch.load = load_known
    try:
        yield
    finally:
        dynamic.get_cached_module_file, dynamic.check_imports = fetch, look
        dynamic.TIME_OUT_REMOTE_CODE = timeout
        torch.load = load


class Unfilled(TorchFunctionMode):
    """While it lasts, large parameters of networks that are built are zeros: that takes no memory or time.

    A checkpoint has all of them, or it is refused.
    """

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if getattr(func, "__name__", "") in FILLS:
            tensor = args[0] if args else kwargs["tensor"]
            if isinstance(tensor, nn.Parameter) and tensor.numel() > LARGE:
                return tensor
        made = func(*args, **kwargs)
        if func is torch.empty and made.numel() > LARGE and made.device.type == "cpu":
            zeros = np.zeros(made.nbytes, np.uint8)  # pages that nothing is written to are not there
            return torch.from_numpy(zeros).view(made.dtype).view(made.shape)
        return made


def input_error(error: BaseException) -> InputError | None:
    """The `InputError` that another error wraps, if there is one."""
    link: BaseException | None = error
    while link is not None:
        if isinstance(link, InputError):
            return link
        link = link.__cause__ or link.__context__
    return None
