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
    texts_in,
)  # fmt: skip
from accerl_lerobot.errors import InputError, causes, expanded

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

    folder = expanded(path, field)
    local = folder.exists()
    if not local and not path.startswith((".", "/", "~")):
        try:
            folder = Path(snapshot_download(path, revision=revision, allow_patterns=list(FILES)))
        except (OSError, ValueError) as error:
            hint = f"not a directory here and not loadable from the Hub ({brief(error)})"
            raise InputError(field, path, hint) from error
    if not (folder / CONFIG).is_file():
        raise InputError(field, path, "no config.json there; give the folder named pretrained_model")
    try:
        check_checkpoint(folder, FileSource(field, path), fetched=not local)
    except InputError:
        raise
    except Exception as error:  # its files may hold anything
        raise InputError(field, path, f"not a checkpoint that LeRobot has saved ({brief(error)})") from error
    return folder


def check_checkpoint(folder: Path, origin: FileSource, *, fetched: bool = False) -> None:
    """Checks all files of a LeRobot checkpoint that are read, before they are.

    One that was `fetched` from the Hub must not name folders of this machine.
    """
    for name in (CONFIG, ADAPTER_CONFIG, *PROCESSORS, WEIGHTS, ADAPTER, VALUE_HEAD, FAMILY, OURS, BACKBONE):
        safe_join(folder, name, origin)
    weights = ADAPTER if is_adapter(folder) else WEIGHTS
    config = read_json(folder / CONFIG, origin)
    for key, own in CONFIG_FOLDERS.items():
        check_name(config.get(key), folder / own, f"{CONFIG}: {key}", origin)
    for name in PROCESSORS:
        if (folder / name).exists():
            check_processor(folder, name, origin)
    check_not_pickled(folder, weights, origin)
    stored = tensor_shapes(folder / weights, origin)
    if not (folder / PREPROCESSOR).exists() and any(map(BEFORE_PROCESSORS.match, stored)):
        convert = f"python -m {MIGRATION} --pretrained-path={origin.value} --output-dir=NEW"
        why = "holds the statistics, as LeRobot saved them before it had processors"
        raise origin.refuse(weights, f"{why}; convert it, and use what {convert} writes")
    _check_beside(folder, origin)
    if fetched:
        check_names(folder, origin)


def is_adapter(folder: Path) -> bool:
    """True for an adapter of LeRobot's PEFT training, which is loaded on top of another checkpoint."""
    if not (folder / ADAPTER_CONFIG).is_file():
        return False
    config = read_json(folder / CONFIG, FileSource("path", str(folder)))
    return bool(config.get("use_peft")) or not (folder / WEIGHTS).is_file()


def check_processor(folder: Path, name: str, origin: FileSource) -> None:
    """Checks a processor file: only LeRobot's registered steps, with state files in this folder."""
    for step in read_json(folder / name, origin).get("steps", []):
        kind, options = step.get("registry_name"), dict(step.get("config", {}))
        if not isinstance(kind, str) or "class" in step:
            hint = "only steps with a registry_name are loaded: LeRobot would import and call this class"
            raise origin.refuse(f"{name}: {str(step.get('class'))[:60]}", hint)
        if "state_file" in step:
            safe_join(folder, step["state_file"], origin)
        if kind in STEP_FOLDERS:
            option, own = STEP_FOLDERS[kind]
            check_name(options.get(option), folder / own, f"{name}: {option}", origin)


def check_name(name: Any, own: Path, what: str, origin: FileSource) -> None:
    """Checks that a backbone or tokeniser has the form of a Hub id, or is a folder.

    `own` is the checkpoint's own folder of it; `what` says file and key, for the error.
    """
    if name is None or (isinstance(name, str) and HUB_ID.fullmatch(name)):
        return
    if not isinstance(name, str) or not Path(name).is_absolute():
        raise origin.refuse(what, f"{str(name)[:80]!r} is neither a Hub id nor an absolute path")
    if ".." in Path(name).parts and not own.is_dir():
        raise origin.refuse(what, f"{name[:80]!r} leads elsewhere; name the folder without ..")


def _check_beside(folder: Path, origin: FileSource) -> None:
    """The backbone's own folder: links, what is no file, attention that is compiled code on the Hub."""
    for path in sorted((folder / BACKBONE).rglob("*")):
        name = path.relative_to(folder).as_posix()
        safe_join(folder, name, origin)
        if path.is_dir():
            continue
        file_size(path, origin)
        content = read_json(path, origin) if path.name == CONFIG else {}
        for _, key, text in texts_in(content):
            if "attn_implementation" in key and "/" in text:
                raise origin.refuse(name, f"{key} names code on the Hub; use sdpa or eager")


@contextlib.contextmanager
def guarded(section: str, commit: str | None = None) -> Iterator[None]:
    """While it lasts, transformers runs no code that comes with a model, and PyTorch unpickles nothing.

    `commit` is that of the one Hub repository whose code may be run; `section` is for the error.
    """
    from transformers import dynamic_module_utils as dynamic

    fetch, look, load = dynamic.get_cached_module_file, dynamic.check_imports, torch.load

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
            return load(file, *arguments, **options | {"weights_only": True})
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


def input_error(error: BaseException) -> InputError | None:
    """The `InputError` that another error wraps, if there is one."""
    return next((link for link in causes(error) if isinstance(link, InputError)), None)


def reason(error: BaseException) -> str:
    """An error's words; of one that draccus wraps, those of the error itself."""
    wrapped = isinstance(error, draccus.utils.DraccusException)
    return brief(list(causes(error))[-1] if wrapped else error)
