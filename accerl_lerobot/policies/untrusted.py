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
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import draccus
import numpy as np
import torch
from torch import nn
from torch.overrides import TorchFunctionMode

from accerl_lerobot.checkpoint.layout import (
    BACKBONE,
    CONFIG_FOLDERS,
    PREPROCESSOR,
    STEP_FOLDERS,
    check_names,
)  # fmt: skip
from accerl_lerobot.checkpoint.safety import (
    HUB_ID,
    FileSource,
    brief,
    check_not_pickled,
    file_size,
    read_json,
    safe_join,
    tensor_shapes,
)  # fmt: skip
from accerl_lerobot.errors import InputError, causes

CONFIG, WEIGHTS = "config.json", "model.safetensors"
ADAPTER_CONFIG, ADAPTER = "adapter_config.json", "adapter_model.safetensors"
OURS, VALUE_HEAD, FAMILY = "accerl.json", "value_head.safetensors", "family.safetensors"
FILES = ("*.json", WEIGHTS, ADAPTER, "*processor_step_*.safetensors", VALUE_HEAD, FAMILY, f"{BACKBONE}/*")
"""Files that are fetched of a checkpoint on the Hub."""
PROCESSORS = (PREPROCESSOR, "policy_postprocessor.json")
BEFORE_PROCESSORS = re.compile(r"(un)?normalize_\w+\.buffer_")
"""Names of statistics among the weights of a policy that LeRobot saved before it had processors."""
MIGRATION = "lerobot.processor.migrate_policy_normalization"
LARGE = 2**16  # numbers of a tensor that is not filled, see `Unfilled`
FILLS = frozenset((
    "normal_", "uniform_", "zero_", "fill_", "erfinv_", "trunc_normal_", "constant_", "ones_", "zeros_",
    "kaiming_uniform_", "kaiming_normal_", "xavier_uniform_", "xavier_normal_", "orthogonal_",
))  # fmt: skip


def fetched_checkpoint(path: str, revision: str | None, field: str) -> Path:
    """Where a checkpoint's files are, once checked; those of a Hub repository are fetched."""
    from huggingface_hub import snapshot_download

    from accerl_lerobot.hub.errors import guard_client

    guard_client()
    folder = Path(path).expanduser()
    local = folder.exists()
    if not local and not path.startswith((".", "/", "~")):
        try:
            folder = Path(snapshot_download(path, revision=revision, allow_patterns=list(FILES)))
        except (OSError, ValueError) as error:
            hint = f"not a directory here and not loadable from the Hub ({brief(error)})"
            raise InputError(field, path, hint) from error
    if not (folder / CONFIG).is_file():
        raise InputError(field, path, "no config.json there; give the folder named pretrained_model")
    check_checkpoint(folder, FileSource(field, path), fetched=not local)
    return folder


def check_checkpoint(folder: Path, origin: FileSource, *, fetched: bool = False) -> None:
    """Checks all files of a LeRobot checkpoint that are read, before they are.

    One that was `fetched` from the Hub must not name folders of this machine.
    """
    config = read_json(safe_join(folder, CONFIG, origin), origin)
    for key, own in CONFIG_FOLDERS.items():
        check_name(config.get(key), folder / own, f"{CONFIG}: {key}", origin)
    for name in PROCESSORS:
        if safe_join(folder, name, origin).exists():
            check_processor(folder, name, origin)
    weights = ADAPTER if is_adapter(folder) else WEIGHTS
    check_not_pickled(folder, weights, origin)
    for name in (weights, VALUE_HEAD, FAMILY):
        if safe_join(folder, name, origin).exists():
            shapes = tensor_shapes(folder / name, origin)
            if not (folder / PREPROCESSOR).exists() and any(map(BEFORE_PROCESSORS.match, shapes)):
                convert = f"python -m {MIGRATION} --pretrained-path={origin.value} --output-dir=NEW"
                why = "holds the statistics, as LeRobot saved them before it had processors"
                raise origin.refuse(name, f"{why}; convert it, and use what {convert} writes")
    if safe_join(folder, OURS, origin).exists():
        check_ours(read_json(folder / OURS, origin), origin)
    _check_beside(folder, origin)
    if fetched:
        check_names(folder, origin)


def is_adapter(folder: Path) -> bool:
    """True for an adapter of LeRobot's PEFT training, which is loaded on top of another checkpoint."""
    if not (folder / ADAPTER_CONFIG).is_file():
        return False
    config = read_json(folder / CONFIG, FileSource("path", str(folder)))
    return bool(config.get("use_peft")) or not (folder / WEIGHTS).is_file()


def check_ours(ours: dict[str, Any], origin: FileSource) -> None:
    for key in ("sampler", "rename_map"):
        if not isinstance(ours.get(key, {}), dict):
            raise origin.refuse(f"{OURS}: {key}", "a mapping is wanted; remove the file to start without it")


def check_processor(folder: Path, name: str, origin: FileSource) -> None:
    """Checks a processor file: only LeRobot's registered steps, with state files in this folder."""
    steps = read_json(folder / name, origin).get("steps")
    if not isinstance(steps, list):
        raise origin.refuse(name, "a list of steps is wanted")
    for step in steps:
        if not isinstance(step, dict) or not isinstance(step.get("config", {}), dict):
            raise origin.refuse(name, "a step is a mapping with a mapping named config")
        kind = step.get("registry_name")
        if not isinstance(kind, str) or "class" in step:
            hint = "only steps with a registry_name are loaded: LeRobot would import and call this class"
            raise origin.refuse(f"{name}: {str(step.get('class'))[:60]}", hint)
        if "state_file" in step:
            tensor_shapes(safe_join(folder, step["state_file"], origin), origin)
        if kind in STEP_FOLDERS:
            option, own = STEP_FOLDERS[kind]
            named = step.get("config", {}).get(option)
            check_name(named, folder / own, f"{name}: {option}", origin)


def check_name(name: Any, own: Path, what: str, origin: FileSource) -> None:
    """Checks that a backbone or tokeniser has the form of a Hub id, or is a folder.

    `own` is the checkpoint's own folder of it; `what` says file and key, for the error.
    """
    if name is None:
        return
    if not isinstance(name, str) or len(name) > 1024 or "\x00" in name:
        raise origin.refuse(what, "a name is wanted")
    if Path(name).is_absolute():
        if ".." in Path(name).parts and not own.is_dir():
            raise origin.refuse(what, f"{name[:80]!r} leads elsewhere; name the folder without ..")
    elif not HUB_ID.fullmatch(name):
        raise origin.refuse(what, f"{name[:80]!r} is neither a Hub id nor an absolute path")


def _check_beside(folder: Path, origin: FileSource) -> None:
    """The backbone's own folder: links, what is no file, attention that is compiled code on the Hub."""
    for directory, _, files in os.walk(safe_join(folder, BACKBONE, origin)):
        for path in (Path(directory, name) for name in files):
            name = path.relative_to(folder).as_posix()
            file_size(safe_join(folder, name, origin), origin)
            parts: list[Any] = [read_json(path, origin)] if path.name == CONFIG else []
            while parts:
                part = parts.pop()
                for key, value in part.items() if isinstance(part, dict) else ():
                    if "attn_implementation" in key and "/" in str(value):
                        raise origin.refuse(name, f"{key} names code on the Hub; use sdpa or eager")
                parts += part.values() if isinstance(part, dict) else part if isinstance(part, list) else ()


@contextlib.contextmanager
def guarded(section: str, commit: str | None = None) -> Iterator[None]:
    """While it lasts, transformers runs no code that comes with a model, and PyTorch unpickles nothing.

    `commit` is that of the one Hub repository whose code may be run; `section` is for the error.
    """
    from transformers import dynamic_module_utils as dynamic

    fetch, look, load = dynamic.get_cached_module_file, dynamic.check_imports, torch.load

    def fetch_pinned(name: Any, *arguments: Any, **options: Any) -> Any:
        pinned = {} if commit is None else {"revision": commit}
        return fetch(name, *arguments, **options | pinned)

    def look_first(file: Any) -> Any:  # transformers does so before it copies code to where it is run
        snapshot = Path(file).parent
        pinned = commit is not None and f"snapshots/{commit}/" in Path(file).as_posix()
        if not pinned:
            hint = (
                "code that came with a model, which would run with your rights; read it, then name its "
                f"commit in {section}.trust_remote_code"
            )
            raise InputError(f"{section}.trust_remote_code", f"{snapshot.name}/{Path(file).name}", hint)
        return look(file)

    def load_known(file: Any, *arguments: Any, **options: Any) -> Any:
        # torchvision's weights are fetched into this folder by PyTorch, and compared with their hash.
        known = isinstance(file, (str, Path)) and Path(file).resolve().is_relative_to(
            Path(torch.hub.get_dir()).resolve()
        )
        if not known:
            hint = "a pickle, which may run code when it is loaded; convert it to safetensors"
            raise InputError(f"{section}.path", str(file)[:200], f"{hint} where you trust it")
        return load(file, *arguments, **options | {"weights_only": True})

    # Without a time-out of 0 it would ask the terminal.
    wrapped: dict[str, Any] = {
        "get_cached_module_file": fetch_pinned,
        "check_imports": look_first,
        "TIME_OUT_REMOTE_CODE": 0,
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


def input_error(error: BaseException) -> InputError | None:
    """The `InputError` that another error wraps, if there is one."""
    return next((link for link in causes(error) if isinstance(link, InputError)), None)


def reason(error: BaseException) -> str:
    """An error's words; of one that draccus wraps, those of the error itself."""
    wrapped = isinstance(error, draccus.utils.DraccusException)
    return brief(list(causes(error))[-1] if wrapped else error)
