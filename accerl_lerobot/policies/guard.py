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
"""Loading what is anybody's: no code of theirs is run, nothing is unpickled, and memory has a bound.

LeRobot 0.6.1 has transformers run code from the Hub in places (`trust_remote_code=True` without a revision).
Where transformers is not told, it asks the terminal; without safetensors it unpickles. `guarded` stands at
the functions through which all of that goes, whoever calls them.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch.overrides import TorchFunctionMode

from accerl_lerobot.errors import InputError

SLACK, TIMES = 1024**3, 4
"""Bytes that a network may take beside `TIMES` those of its file: what is stored in half precision is float32
here, and some layers are made and thrown away."""
CALLS_MOST = 200_000
"""Tensors that are made while it is built; π0 makes some thousands."""
SIZED = frozenset((torch.empty, torch.zeros, torch.ones, torch.rand, torch.randn, torch.eye, torch.full))
SPANS = frozenset((torch.arange, torch.linspace, torch.randperm))
"""What networks make parameters and buffers with: the sizes are the arguments, or the largest of them is."""


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


class Budget(TorchFunctionMode):
    """While it lasts, networks that are built take no more memory than their file could fill.

    A config of a hundred bytes can ask for a terabyte. Building comes before any comparison with the file, so
    this counts the numbers that are asked for.

    Args:
        stored: bytes of the file with the weights.

    Raises:
        InputError: see above; also when more than `CALLS_MOST` tensors are made.
    """

    def __init__(self, stored: int, field: str, value: str | None) -> None:
        super().__init__()
        self.most, self.taken, self.calls = TIMES * stored + SLACK, 0, 0
        self._field, self._value = field, value

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        if func in SIZED or func in SPANS:
            self.calls += 1
            self.taken += 4 * _numbers(func, args, kwargs)
            if self.taken > self.most or self.calls > CALLS_MOST:
                remedy = (
                    f"its config asks for over {self.taken // 2**20} MiB in {self.calls} tensors, which its"
                )
                raise InputError(self._field, self._value, f"{remedy} weights cannot fill; get it again")
        return func(*args, **kwargs)


def input_error(error: BaseException) -> InputError | None:
    """The `InputError` that another error wraps, if there is one."""
    link: BaseException | None = error
    while link is not None:
        if isinstance(link, InputError):
            return link
        link = link.__cause__ or link.__context__
    return None


def _numbers(func: Any, args: Any, kwargs: dict[str, Any]) -> int:
    """How many are asked for, be it as ``empty(2, 3)``, ``empty((2, 3))`` or ``empty(size=(2, 3))``."""
    sizes = [
        *(args[:1] if func is torch.full else args),
        *(kwargs[k] for k in ("size", "end", "steps") if k in kwargs),
    ]
    flat = [n for size in sizes for n in (size if isinstance(size, (tuple, list)) else [size])]
    whole = [abs(int(n)) for n in flat if isinstance(n, (int, float)) and 1 <= abs(n) < 2**62]
    return max(whole, default=0) if func in SPANS else math.prod(whole)
