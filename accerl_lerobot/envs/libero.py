# SPDX-License-Identifier: Apache-2.0
"""LIBERO (Liu et al., 2023): its config, and the files of its package.

The files (names and texts of tasks, recorded starts, meshes) are read without importing LIBERO, which asks
the terminal for folders and imports torch. Importing this module loads neither MuJoCo nor LIBERO.
"""

from __future__ import annotations

import ast
import contextlib
import functools
import io
import logging
import pickletools
import re
import zipfile
from dataclasses import dataclass
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal
from unittest.mock import patch

import numpy as np

from accerl_lerobot.config.ranges import Range
from accerl_lerobot.envs.base import EnvConfig, SuiteConfig
from accerl_lerobot.errors import InputError, expanded, in_one_line

ASSETS = "lerobot/libero-assets"
FETCH = f"hf download {ASSETS} --repo-type=dataset --local-dir=FOLDER, and name the folder"
"""How to get LIBERO's meshes and textures where a run cannot."""
LEROBOT_NAMES = {"agentview": "image", "robot0_eye_in_hand": "image2"}
"""LeRobot's names of the two cameras that policies see."""
LIMITS = {"libero_spatial": 280, "libero_object": 280, "libero_goal": 300, "libero_10": 520, "libero_90": 400}
"""Suites → LeRobot's episode limits in env steps."""


def package() -> Path:
    """Folder of the installed ``libero.libero``, found without importing it: that would ask the terminal."""
    if find_spec("libero") is None:
        hint = "the package libero is not installed; pip install 'accerl-lerobot[libero]'"
        raise InputError("env.type", "libero", hint)
    return Path(str(files("libero"))) / "libero"


@functools.cache
def _names() -> dict[str, list[str]]:
    """Names of each suite's tasks: LIBERO's own table, read without importing LIBERO and torch with it."""
    text = (package() / "benchmark" / "libero_suite_task_map.py").read_text()
    _, _, table = text.partition("=")
    return ast.literal_eval(table.strip())


@functools.cache
def suites() -> dict[str, tuple[str, ...]]:
    """Tasks of each suite, ``suite/number``."""
    tasks = {}
    for suite in LIMITS:
        numbers = range(len(_names()[suite]))
        tasks[suite] = tuple(f"{suite}/{number}" for number in numbers)
    return tasks


def task_file(task: str, folder: str, suffix: str) -> Path:
    """A file of a task: its description (objects, regions, goal) or its recorded starts."""
    suite, number = task.split("/")
    return package() / folder / suite / f"{_names()[suite][int(number)]}{suffix}"


def bddl_file(task: str) -> Path:
    """LIBERO's description of a task: objects, regions, goal."""
    return task_file(task, "bddl_files", ".bddl")


def instruction(task: str) -> str:
    """Text of a task, as LeRobot's environment and datasets have it."""
    name = re.sub(r".*SCENE\d+_", "", bddl_file(task).stem)
    return name.replace("_", " ")


def recorded_states(task: str) -> np.ndarray:
    """The 50 standard start states of a task, one after another: time, positions and velocities, float64.

    LIBERO ships each as the pickle of one array. Its numbers are the longest text of the stream, which is
    read and not executed.
    """
    with zipfile.ZipFile(task_file(task, "init_files", ".pruned_init")) as archive:
        opcodes = pickletools.genops(archive.read("archive/data.pkl"))
        texts = [argument for _, argument, _ in opcodes if isinstance(argument, str | bytes)]
    numbers = max(texts, key=len)
    if isinstance(numbers, str):
        numbers = numbers.encode("latin-1")
    return np.frombuffer(numbers, "<f8")


def assets_folder(given: str) -> Path:
    """Folder of meshes and textures: `given` if it is named, the installed package's, or a copy of the Hub's.

    Raises:
        InputError: it is none, or there is none and the Hub could not be asked.
    """
    if given:
        folder = expanded(given, "env.assets").absolute()
        if not (folder / "scenes").is_dir():
            raise InputError("env.assets", given, "no folder of LIBERO's assets: it holds no scenes/")
        return folder
    folder = package() / "assets"
    if folder.is_dir():
        return folder
    from huggingface_hub import snapshot_download

    try:
        return Path(snapshot_download(ASSETS, repo_type="dataset"))
    except Exception as error:
        why = f"LIBERO's meshes are not installed, and the Hub did not give them ({in_one_line(error)})"
        raise InputError("env.assets", given, f"{why}; {FETCH}") from error


def load_libero(assets: str) -> None:
    """Import LIBERO with the meshes of `assets_folder`; it asks nothing and prints nothing."""
    logging.getLogger("robosuite_logs").setLevel(logging.ERROR)  # asks for a file of macros that nobody needs
    no = patch("builtins.input", return_value="n")  # the first import asks for another folder of datasets
    with no, contextlib.redirect_stdout(io.StringIO()):
        import libero.libero as imported
        import libero.libero.envs

        imported._assets_path_cache = str(assets_folder(assets))


@EnvConfig.register_subclass("libero")
@dataclass(frozen=True, kw_only=True)
class LiberoConfig(SuiteConfig):
    """Which LIBERO tasks, seen how.

    Evaluation begins at the 50 recorded states of a task, demonstrations and exploration at placements drawn
    from the task's own regions, so that no evaluated start is trained on.
    """

    starts = 50
    expert = "accerl_lerobot.demos.libero_expert:libero_expert"
    environment = "accerl_lerobot.envs.libero_simulator:LiberoEnvironment"
    groups = staticmethod(suites)
    CAMERAS = (*LEROBOT_NAMES, "frontview", "birdview", "sideview", "galleryview", "robot0_robotview")

    task: str = "libero_object"
    """Suites (libero_spatial, libero_object, libero_goal, libero_10, libero_90), or single tasks such as
    libero_object/3 with LIBERO's numbers, separated by commas."""
    camera: str = "agentview,robot0_eye_in_hand"
    """Camera names separated by commas. These two become ``observation.images.image`` and ``.image2``, as in
    LeRobot, others ``observation.images.<name>``."""
    image_size: Annotated[int, Range("[32, 480]")] = 256
    """Height and width of every image in pixels."""
    max_steps: Annotated[int, Range("[0, 1000]")] = 0
    """Episode limit in env steps. 0: LeRobot's, which is 280 for libero_spatial and libero_object, 300 for
    libero_goal, 520 for libero_10, 400 for libero_90; of several suites the largest."""
    rendering: Literal["stock", "fast"] = "stock"
    """``stock`` (LeRobot's pixels) or ``fast`` (no shadows, reflections or multisampling, and coarser meshes:
    several times faster in software)."""
    assets: str = ""
    """Folder of LIBERO's meshes and textures; if empty, the installed package's or, where it has none, a copy
    of those on the Hub."""
    environment_state: bool = False
    """True if observations hold ``observation.environment_state``: joints and hand of the robot, positions
    of the objects that the task is about, distances between all these, and the share of `max_steps` gone. For
    ``algorithm.type=chunk_critic``."""

    @property
    def time_limit(self) -> int:
        return self.max_steps or max(LIMITS[task.split("/")[0]] for task in self.tasks)
