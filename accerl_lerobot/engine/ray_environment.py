# SPDX-License-Identifier: Apache-2.0
"""Environment variables that Ray and its workers read, set before Ray is imported: it reads them once.

Every run gets a Ray of its own, which nobody else can talk to: it listens on the loopback interface only, and
asks for a token. That lies in a folder which only this user can enter, beside Ray's sockets and logs, and
goes when this process ends. No process has it in its environment, which whatever is started would inherit.

A run that joins a cluster (``launch.address``) takes the user's token and leaves the rest as it is there.
"""

from __future__ import annotations

import functools
import os
import secrets
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from accerl_lerobot import guardian

WORKERS = {
    # Several CPU workers share the cores: spinning threads would cost more than they give.
    "OMP_NUM_THREADS": "1",
    "OMP_WAIT_POLICY": "PASSIVE",
    "TOKENIZERS_PARALLELISM": "false",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
}


PRIVATE = {
    # Ray 2.60 moves a node at 127.0.0.1 to the machine's address and then listens on every interface, unless
    # it is told that there is no cluster to be part of. The name is historical: it is read on all systems.
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
}
_NO_TOKEN = {"HF_TOKEN": "", "HUGGING_FACE_HUB_TOKEN": "", "HF_TOKEN_PATH": os.devnull}
TOKENLESS = {"runtime_env": {"env_vars": _NO_TOKEN}}
"""Options of an actor that runs other people's environments: the Hub's token is not in its process, and not
found by the client in it. No wall: what runs as the same user can read what that user can."""


RAY_PROCESSES = {
    "gcs_server": ("/ray/gcs/gcs_server",),
    "raylet": ("/ray/raylet/raylet",),
    "dashboard agent": ("/dashboard/agent.py", "ray::DashboardAgent"),
    "runtime env agent": ("/runtime_env/agent/main.py", "ray::RuntimeEnvAgent"),
    "log monitor": ("/_private/log_monitor.py",),
}
"""Ray's own processes → how their command lines begin, without and with a title of their own."""
NEEDED = ("gcs_server", "raylet", "dashboard agent", "runtime env agent")
"""Processes among these without which Ray does not work: a raylet ends with its agents."""


def kind_of(command: Sequence[str]) -> str | None:
    """Which of `RAY_PROCESSES` a command line is of."""
    begin = " ".join(command[:3])
    return next((kind for kind, words in RAY_PROCESSES.items() if any(w in begin for w in words)), None)


PASSED_ON = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE")
"""Environment variables that workers on other nodes get besides `WORKERS`, where they are set here."""
_AUTH = ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH")


def prepare(joins: bool = False) -> None:
    """Sets what is not set yet; a token only if none is configured and Ray has not been imported.

    Args:
        joins: whether a cluster is joined; its token is the user's.
    """
    for key, value in WORKERS.items():
        os.environ.setdefault(key, value)
    if joins:
        if "ray" not in sys.modules and has_token():
            os.environ.setdefault("RAY_AUTH_MODE", "token")
        return
    if not os.environ.get("RAY_TMPDIR"):
        # Sockets and logs: Ray's own choice is a folder that every user of the machine may write to.
        os.environ["RAY_TMPDIR"] = str(private_folder())
    if "ray" in sys.modules:
        return
    for key, value in PRIVATE.items():
        os.environ.setdefault(key, value)
    if not any(os.environ.get(k) for k in _AUTH):
        os.environ["RAY_AUTH_MODE"] = "token"
        os.environ["RAY_AUTH_TOKEN_PATH"] = str(write_token())


def check_private() -> None:
    """Refuses to start a Ray of our own that others could talk to.

    Raises:
        RuntimeError: Ray has been imported before `prepare`, by whoever has written this program.
    """
    if not all(os.environ.get(key) for key in PRIVATE) or not any(os.environ.get(key) for key in _AUTH):
        remedy = "start a new process, or call ray_environment.prepare() before Ray is imported"
        raise RuntimeError(f"Ray has been imported, and would be open to others if started now: {remedy}")


def has_token() -> bool:
    """True if there is a token of the user's where Ray looks for one."""
    if os.environ.get("RAY_AUTH_TOKEN"):
        return True
    path = os.environ.get("RAY_AUTH_TOKEN_PATH") or Path.home() / ".ray" / "auth_token"
    return Path(path).is_file()


def without_token() -> dict[str, str]:
    """This environment as somebody has it who knows no token."""
    home = str(private_folder())  # or Ray would look into this user's
    return {k: v for k, v in os.environ.items() if k not in _AUTH} | {
        "RAY_AUTH_MODE": "disabled",
        "HOME": home,
    }


def passed_on() -> dict[str, str]:
    """Environment of workers on nodes that were not started from here."""
    return {name: os.environ[name] for name in (*WORKERS, *PASSED_ON) if name in os.environ}


def write_token() -> Path:
    """A new token in this process's private folder, never open to others."""
    path = private_folder() / "token"
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(handle, "w") as file:
        file.write(secrets.token_hex(32))
    return path


@functools.cache
def private_folder() -> Path:
    """A folder of mode 0700 from its beginning, which its guardian removes when this process has ended."""
    temporary = tempfile.gettempdir()
    # A socket's path has 107 bytes at most, and Ray's part of it takes up to 70.
    folder = Path(tempfile.mkdtemp(prefix="accerl-", dir=temporary if len(temporary) <= 16 else "/tmp"))
    guardian.remove(folder)
    return folder
