# SPDX-License-Identifier: Apache-2.0
"""Policies from untrusted sources: their files are checked, no code of theirs runs, nothing is unpickled.

LeRobot imports and calls whatever a processor's ``class`` names, with the arguments that stand beside it, and
joins ``state_file`` to the folder as it is. Names of backbones and tokenisers may be folders of this machine.
LeRobot 0.6.1 has transformers run code from the Hub in places (`trust_remote_code=True` without a revision);
where transformers is not told, it asks the terminal, and without safetensors it unpickles. `guarded` wraps
the functions through which all of that goes, whoever is the caller.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import draccus
import numpy as np
import torch
from torch import nn
from torch.overrides import TorchFunctionMode

from accerl_lerobot.checkpoint.layout import BACKBONE, PREPROCESSOR, check_names
from accerl_lerobot.checkpoint.safety import FileSource, check_folder, read_json, safe_join, texts_in
from accerl_lerobot.errors import InputError, causes, expanded, in_one_line, input_error

CONFIG, WEIGHTS = "config.json", "model.safetensors"
ADAPTER_CONFIG, ADAPTER = "adapter_config.json", "adapter_model.safetensors"
FILES = (
    "*.json", WEIGHTS, ADAPTER, "*processor_step_*.safetensors", "value_head.safetensors",
    "family.safetensors", f"{BACKBONE}/*",
)  # fmt: skip
"""Files that are fetched of a checkpoint on the Hub."""
PROCESSORS = (PREPROCESSOR, "policy_postprocessor.json")
LARGE = 2**16  # numbers of a tensor that is not filled, see `Unfilled`
FILLS = {"normal_", "uniform_", "zero_", "fill_", "erfinv_", "constant_", "kaiming_uniform_"}
"""Functions in which all of `torch.nn.init` ends."""


def fetched_checkpoint(path: str, revision: str | None, field: str) -> Path:
    """Where a checkpoint's files are, once checked; those of a Hub repository are fetched."""
    from huggingface_hub import snapshot_download

    folder = expanded(path, field)
    local = folder.exists()
    if not local and not path.startswith((".", "/", "~")):
        try:
            fetched = snapshot_download(path, revision=revision, allow_patterns=list(FILES))
            folder = Path(fetched)
        except (OSError, ValueError) as error:
            hint = f"not a directory here and not loadable from the Hub ({in_one_line(error)})"
            raise InputError(field, path, hint) from error
    if not (folder / CONFIG).is_file():
        raise InputError(field, path, "no config.json there; give the folder named pretrained_model")
    source = FileSource(field, path)
    with refusing(source, "not a checkpoint that LeRobot has saved"):
        check_checkpoint(folder, source, fetched=not local)
    return folder


def check_checkpoint(folder: Path, source: FileSource, *, fetched: bool = False) -> None:
    """Checks links, processors, configs and the kind of weights of a checkpoint, before they are read.

    One that was `fetched` from the Hub must not name folders of this machine.
    """
    check_folder(folder, source)
    for name in PROCESSORS:
        if (folder / name).exists():
            check_processor(folder, name, source)
    for path in sorted(folder.rglob(CONFIG)):
        for key, text in texts_in(read_json(path, source)):
            if "attn_implementation" in key and "/" in text:
                name = path.relative_to(folder).as_posix()
                raise source.refuse(name, f"{key} names code on the Hub; use sdpa or eager")
    weights = ADAPTER if is_adapter(folder) else WEIGHTS
    if not (folder / weights).is_file():
        raise source.refuse(weights, "is missing; give a folder with the weights as safetensors")
    if fetched:
        check_names(folder, source)


def is_adapter(folder: Path) -> bool:
    """True for an adapter of LeRobot's PEFT training, which is loaded on top of another checkpoint."""
    return (folder / ADAPTER_CONFIG).is_file() and not (folder / WEIGHTS).is_file()


def check_processor(folder: Path, name: str, source: FileSource) -> None:
    """Checks a processor file: only LeRobot's registered steps, with state files in this folder."""
    for step in read_json(folder / name, source).get("steps", []):
        if not isinstance(step.get("registry_name"), str) or "class" in step:
            named = str(step.get("class"))[:60]
            hint = "only steps with a registry_name are loaded: LeRobot would import and call this class"
            raise source.refuse(f"{name}: {named}", hint)
        if "state_file" in step:
            safe_join(folder, step["state_file"], source)


@contextlib.contextmanager
def refusing(source: FileSource, what: str) -> Iterator[None]:
    """Makes one line of whatever is raised: LeRobot takes files at their word, and may fail over any."""
    try:
        yield
    except Exception as error:
        ours = input_error(error)
        if ours is not None:
            raise ours from None
        if isinstance(error, ImportError):
            what = "a package that it needs is missing"
        first: BaseException = error  # draccus wraps the error that tells why
        if isinstance(error, draccus.utils.DraccusException):
            *_, first = causes(error)
        raise InputError(source.field, source.value, f"{what} ({in_one_line(first)})") from error


@contextlib.contextmanager
def guarded(section: str, commit: str | None = None) -> Iterator[None]:
    """While it lasts, transformers runs no code that comes with a model, and PyTorch unpickles nothing.

    `commit` is that of the one Hub repository whose code may be run; `section` is for the error.
    """
    from transformers import dynamic_module_utils as dynamic

    fetch = dynamic.get_cached_module_file
    look = dynamic.check_imports
    load = torch.load

    def fetch_pinned(name: Any, *arguments: Any, **options: Any) -> Any:
        if commit is not None:
            options["revision"] = commit
        return fetch(name, *arguments, **options)

    def look_first(file: Any) -> Any:  # transformers does so before it copies code to where it is run
        path = Path(file)
        if commit is not None and f"snapshots/{commit}/" in path.as_posix():
            return look(file)
        hint = "code that came with a model, which would run with your rights; read it, then name its commit"
        field = f"{section}.trust_remote_code"
        raise InputError(field, f"{path.parent.name}/{path.name}", f"{hint} in {field}")

    def load_known(file: Any, *arguments: Any, **options: Any) -> Any:
        # torchvision's weights are fetched into this folder by PyTorch, and compared with their hash.
        home = Path(torch.hub.get_dir()).resolve()
        if isinstance(file, (str, Path)) and Path(file).resolve().is_relative_to(home):
            options["weights_only"] = True
            return load(file, *arguments, **options)
        hint = "a pickle, which may run code when it is loaded; convert it to safetensors where you trust it"
        raise InputError(f"{section}.path", str(file)[:200], hint)

    wrapped: dict[str, Any] = {
        "get_cached_module_file": fetch_pinned,
        "check_imports": look_first,
        "TIME_OUT_REMOTE_CODE": 0,  # otherwise it would ask the terminal
    }
    with patch.multiple(dynamic, **wrapped), patch.object(torch, "load", load_known):
        yield


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
