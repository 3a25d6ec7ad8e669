# SPDX-License-Identifier: Apache-2.0
"""The Ray of a run: a private one on this machine, or the cluster of ``launch.address``.

A private Ray listens on the loopback interface and asks for a token that only this user's processes know. Its
sockets and logs are in a folder that the guardian removes. A run that joins a cluster uses the user's token
and leaves the cluster as it is.

Ray reads its environment when it is imported. So nothing here imports it at the top, and `prepare` is called
before anything does.
"""

from __future__ import annotations

import contextlib
import logging
import os
import secrets
import socket
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

from accerl_lerobot import guardian
from accerl_lerobot.config.parsing import imported
from accerl_lerobot.engines.stopping import handled
from accerl_lerobot.errors import InputError, in_one_line

if TYPE_CHECKING:
    from accerl_lerobot.engines.config import LaunchConfig

logger = logging.getLogger(__name__)

STARTS = 3  # attempts to start a private Ray, which gives up after 30 s; a busy machine may need more
CONNECT_S = 5.0  # timeout for a TCP connection to a cluster

WORKERS = {
    # Several CPU workers share the cores: spinning threads would cost more than they give.
    "OMP_NUM_THREADS": "1",
    "OMP_WAIT_POLICY": "PASSIVE",
    "TOKENIZERS_PARALLELISM": "false",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_IGNORE_UNHANDLED_ERRORS": "1",  # the engine looks at the end of every worker itself
}
FORWARDED = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE", "ACCERL_ONE_POLICY")
"""Environment variables that workers on other nodes get besides `WORKERS`, where they are set here."""
PRIVATE = {
    # Ray 2.60 moves a node at 127.0.0.1 to the machine's address and then listens on every interface, unless
    # it is told that there is no cluster to be part of. The name is historical: it is read on all systems.
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",
    "RAY_worker_niceness": "0",  # Ray's own 15 starves workers on a machine with other work
}
_AUTH = ("RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH")
_NO_TOKEN = {"HF_TOKEN": "", "HUGGING_FACE_HUB_TOKEN": "", "HF_TOKEN_PATH": os.devnull}
NO_HUB_TOKEN = {"runtime_env": {"env_vars": _NO_TOKEN}}
"""Options of an actor that runs other people's environments: the Hub's token is not in its environment, and
its Hub client does not find it. No isolation: the process can still read what this user can."""


def prepare(joins: bool = False) -> None:
    """Set the environment variables that Ray and its workers read; what is set already stays."""
    for key, value in WORKERS.items():
        os.environ.setdefault(key, value)
    if "ray" in sys.modules:
        return
    if joins:
        if has_token():
            os.environ.setdefault("RAY_AUTH_MODE", "token")
        return
    for key, value in PRIVATE.items():
        os.environ.setdefault(key, value)
    if not os.environ.get("RAY_TMPDIR"):
        # Sockets and logs: Ray's own choice is a folder of all users, in which they stay.
        folder = tempfile.mkdtemp(prefix="accerl-", dir="/tmp")
        os.environ["RAY_TMPDIR"] = folder
        guardian.remove(Path(folder))
    if not any(os.environ.get(key) for key in _AUTH):
        os.environ["RAY_AUTH_MODE"] = "token"
        os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)


def has_token() -> bool:
    """True if the user has a token where Ray looks for one."""
    if os.environ.get("RAY_AUTH_TOKEN"):
        return True
    path = os.environ.get("RAY_AUTH_TOKEN_PATH") or Path.home() / ".ray" / "auth_token"
    return Path(path).is_file()


def forwarded_environment() -> dict[str, str]:
    """Environment variables of workers on nodes that were not started from here."""
    return {name: os.environ[name] for name in (*WORKERS, *FORWARDED) if name in os.environ}


def start_ray(launch: LaunchConfig | None = None) -> None:
    """Start a private Ray on this machine, or join the cluster of ``launch.address``."""
    with handled():
        if launch is None or launch.address is None:
            _start_private()
        else:
            _join(launch.address)


def _start_private() -> None:
    import ray

    if not all(os.environ.get(key) for key in PRIVATE) or not any(os.environ.get(key) for key in _AUTH):
        hint = "start a new process, or call ray_session.prepare() before Ray is imported"
        raise RuntimeError(f"Ray has been imported, and would be open to others if started now: {hint}")
    for attempt in range(1, STARTS + 1):
        try:
            ray.init(
                address="local",
                include_dashboard=False,
                _node_ip_address="127.0.0.1",
                log_to_driver=False,
                configure_logging=False,
            )
            return
        except Exception as error:  # Ray raises a plain one when its start-up fails
            ray.shutdown()
            if attempt == STARTS:
                raise RuntimeError(f"Ray did not start: {in_one_line(error)}") from error


def _join(address: str) -> None:
    if not has_token():
        hint = "there is no token; start the cluster with RAY_AUTH_MODE=token, and set RAY_AUTH_TOKEN_PATH"
        raise InputError("launch.address", address, hint)
    import ray
    from ray.exceptions import AuthenticationError

    try:
        if address != "auto":  # Ray would try for minutes
            host, _, port = address.rpartition(":")
            socket.create_connection((host.strip("[]"), int(port)), CONNECT_S).close()
        environment = {"env_vars": forwarded_environment()}
        ray.init(address=address, log_to_driver=False, configure_logging=False, runtime_env=environment)
    except (RuntimeError, OSError, ValueError, AuthenticationError) as error:
        reason = in_one_line(error.__cause__ or error)
        hint = f"this process cannot join it; is it what ray start --head printed? {reason}"
        raise InputError("launch.address", address, hint) from error


@contextlib.contextmanager
def opened(launch: LaunchConfig, now: bool = True) -> Iterator[None]:
    """Ray while the context lasts, beside the import of LeRobot; nothing in the local engine.

    A Ray that is there already is used and left running. With `now` False Ray is started by the first engine.
    """
    if launch.engine == "local":
        yield
        return
    prepare(joins=launch.address is not None)
    import ray

    if ray.is_initialized():
        yield
        return
    try:
        if now:
            with ThreadPoolExecutor(1) as pool:
                pool.submit(imported, "accerl_lerobot.policies.loading:load_adapter")
                start_ray(launch)
        yield
    finally:
        ray.shutdown()
