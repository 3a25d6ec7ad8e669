# SPDX-License-Identifier: Apache-2.0
"""Files of LIBERO's package: names and texts of tasks, recorded starts, where the meshes are.

Read without importing LIBERO, which asks the terminal for folders and imports torch.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import io
import logging
import os
import pickletools
import zipfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import yaml

from accerl_lerobot.checkpoint.layout import write_atomically
from accerl_lerobot.checkpoint.safety import brief
from accerl_lerobot.errors import InputError, expanded

REMEDY = "hf download lerobot/libero-assets --repo-type=dataset --local-dir=FOLDER, and name the folder"
"""How to get LIBERO's meshes and textures where a run cannot."""
SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10", "libero_90")


def package() -> Path:
    """Folder of the installed ``libero.libero``, found without importing it: that would ask the terminal."""
    spec = find_spec("libero")
    if spec is None or not spec.submodule_search_locations:
        hint = "the package libero is not installed; pip install 'accerl-lerobot[libero]'"
        raise InputError("env.type", "libero", hint)
    return Path(next(iter(spec.submodule_search_locations))) / "libero"


@functools.cache
def _names() -> dict[str, list[str]]:
    """Names of each suite's tasks; LIBERO's own table, read without importing LIBERO and torch with it."""
    text = (package() / "benchmark" / "libero_suite_task_map.py").read_text()
    value = next(node.value for node in ast.parse(text).body if isinstance(node, ast.Assign))
    return ast.literal_eval(value)


@functools.cache
def suites() -> dict[str, tuple[str, ...]]:
    """Tasks of each suite, ``suite/number``."""
    return {suite: tuple(f"{suite}/{i}" for i in range(len(_names()[suite]))) for suite in SUITES}


def task_name(task: str) -> str:
    """LIBERO's own name of ``suite/number``."""
    suite, number = task.split("/")
    return _names()[suite][int(number)]


def instruction(task: str) -> str:
    """Text of a task, as LeRobot's environment and datasets have it."""
    name = task_name(task)
    scene = name.find("SCENE")
    words = name[scene:].split("_")[1:] if scene >= 0 else name.split("_")
    return " ".join(words)


def configure() -> None:
    """Writes the file without which the first import of LIBERO asks the terminal where its data is."""
    given = Path(os.environ.get("LIBERO_CONFIG_PATH", "~/.libero")).expanduser()
    if (given / "config.yaml").is_file() or find_spec("libero") is None:
        return
    root = package()
    folders = {"bddl_files": "bddl_files", "init_states": "init_files", "assets": "assets"}
    paths = {"benchmark_root": str(root), "datasets": str(root.parent / "datasets")}
    paths |= {key: str(root / folder) for key, folder in folders.items()}
    ours = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser() / "accerl-lerobot" / "libero"
    ours.mkdir(parents=True, exist_ok=True)
    if not (file := ours / "config.yaml").is_file() or yaml.safe_load(file.read_text()) != paths:
        write_atomically(file, yaml.safe_dump(paths))
    os.environ["LIBERO_CONFIG_PATH"] = str(ours)


def recorded_states(task: str) -> np.ndarray:
    """The 50 standard start states of a task, one after another: time, positions and velocities, float64.

    LIBERO ships each as the pickle of one array. Its numbers are the longest text of the stream, which is
    read and not executed.
    """
    file = package() / "init_files" / task.split("/")[0] / f"{task_name(task)}.pruned_init"
    with zipfile.ZipFile(file) as archive:
        opcodes = pickletools.genops(archive.read("archive/data.pkl"))
        numbers = max((arg for _, arg, _ in opcodes if isinstance(arg, str | bytes)), key=len)
    return np.frombuffer(numbers.encode("latin-1") if isinstance(numbers, str) else numbers, "<f8")


def bddl_file(task: str) -> Path:
    """LIBERO's description of a task: objects, regions, goal."""
    return package() / "bddl_files" / task.split("/")[0] / f"{task_name(task)}.bddl"


def assets_folder(given: str) -> Path:
    """Folder of meshes and textures: the one named, the installed package's, or a copy of the Hub's.

    Raises:
        InputError: it is none, or there is none and the Hub could not be asked.
    """
    if given:
        folder = expanded(given, "env.assets").absolute()
        if not (folder / "scenes").is_dir():
            raise InputError("env.assets", given, "no folder of LIBERO's assets: it holds no scenes/")
        return folder
    if (local := package() / "assets").is_dir():
        return local
    from libero.libero.utils.download_utils import download_assets_from_huggingface

    try:
        folder = Path(download_assets_from_huggingface())
    except Exception as error:
        why = f"LIBERO's meshes are not installed, and the Hub did not give them ({brief(error)})"
        raise InputError("env.assets", given, f"{why}; {REMEDY}") from error
    if not (folder / "scenes").is_dir():
        raise InputError("env.assets", given, f"{folder} is incomplete; remove it, and it is fetched again")
    return folder


def load_libero(assets: str) -> None:
    """Imports LIBERO, which asks nothing and prints nothing, with the meshes of this folder; see above."""
    configure()
    logging.getLogger("robosuite_logs").setLevel(logging.ERROR)  # asks for a file of macros that nobody needs
    with contextlib.redirect_stdout(io.StringIO()):
        import libero.libero as package
        import libero.libero.envs

        package._assets_path_cache = str(assets_folder(assets))
