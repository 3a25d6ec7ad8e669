# SPDX-License-Identifier: Apache-2.0
"""The Ray of a run: its environment, its start or the cluster that is joined, and a watch over it.

A private Ray can be used by nobody else: it listens on the loopback interface only and asks for a token,
which is in a folder that only this user can enter, beside Ray's sockets and logs. A run that joins a cluster
(``launch.address``) uses the user's token and leaves the cluster as it is.

Ray reads its environment when it is imported, so nothing here imports it at the top, and `prepare` is called
before anything does.
"""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import secrets
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

import psutil

from accerl_lerobot import guardian
from accerl_lerobot.config.parsing import imported
from accerl_lerobot.engine.stopping import WorkerError, arrived, deferred, pause_s
from accerl_lerobot.errors import InputError

if TYPE_CHECKING:
    from accerl_lerobot.engine.config import LaunchConfig

logger = logging.getLogger(__name__)

FIELD = "launch.address"
SOCKET_BYTES = 103 if sys.platform == "darwin" else 107  # of a socket's path at most
RAY_BYTES = 70  # at most of it Ray's own part: /session_…/sockets/plasma_store
STARTS = 4  # attempts to start a private Ray, which gives up after 30 s; a busy machine may need more
CONNECT_S, ANSWER_S = 5.0, 60.0
"""Timeouts for a TCP connection to a cluster, and for ``ray status``, most of which is importing Ray."""
LOOK_S = 0.5  # between two looks at Ray's processes
HURRY_S = 2.0  # how long one of them may be stopped once the run has been asked to stop
GIVE_UP_S, GONE_S = 30.0, 3.0
"""How long the main thread may take to end a lost Ray, before this process is ended, and a killed process."""

WORKERS = {
    # Several CPU workers share the cores: spinning threads would cost more than they give.
    "OMP_NUM_THREADS": "1",
    "OMP_WAIT_POLICY": "PASSIVE",
    "TOKENIZERS_PARALLELISM": "false",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
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

RAY_PROCESSES = {
    "gcs_server": ("/ray/gcs/gcs_server",),
    "raylet": ("/ray/raylet/raylet",),
    "dashboard agent": ("/dashboard/agent.py", "ray::DashboardAgent"),
    "runtime env agent": ("/runtime_env/agent/main.py", "ray::RuntimeEnvAgent"),
    "log monitor": ("/_private/log_monitor.py",),
}
"""Ray's own processes → the beginning of their command lines, without and with a process title."""
REQUIRED = ("gcs_server", "raylet", "dashboard agent", "runtime env agent")
"""Processes among these without which Ray does not work: a raylet ends with its agents."""
STATUS = ("-m", "ray.scripts.scripts", "status")
UNAUTHORISED = ("Unauthenticated", "UNAUTHENTICATED", "InvalidAuthToken", "AuthenticationError")
"""One of these is in the answer to a missing or wrong token."""


def prepare(joins: bool = False) -> None:
    """Set the environment variables that Ray and its workers read; what is set already stays.

    Raises:
        InputError: RAY_TMPDIR cannot hold the files of a private Ray.
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
    check_sockets(os.environ["RAY_TMPDIR"])
    if "ray" in sys.modules:
        return
    for key, value in PRIVATE.items():
        os.environ.setdefault(key, value)
    if not any(os.environ.get(k) for k in _AUTH):
        os.environ["RAY_AUTH_MODE"] = "token"
        os.environ["RAY_AUTH_TOKEN_PATH"] = str(write_token())


def check_sockets(folder: str) -> None:
    """Refuse a RAY_TMPDIR in which Ray cannot make its sockets."""
    size, most = len(os.fsencode(os.path.abspath(folder))), SOCKET_BYTES - RAY_BYTES
    if size > most:
        why = f"{size} bytes, and a socket's path leaves {most} to it; use a shorter one, or unset RAY_TMPDIR"
        raise InputError("RAY_TMPDIR", folder, why)
    above = Path(os.path.abspath(folder))
    while not above.exists():
        above = above.parent
    if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
        raise InputError("RAY_TMPDIR", folder, f"{above} cannot hold folders; use another one")


def check_private() -> None:
    """Refuse to start a private Ray that others could use."""
    if not all(os.environ.get(key) for key in PRIVATE) or not any(os.environ.get(key) for key in _AUTH):
        hint = "start a new process, or call ray_session.prepare() before Ray is imported"
        raise RuntimeError(f"Ray has been imported, and would be open to others if started now: {hint}")


def has_token() -> bool:
    """True if the user has a token where Ray looks for one."""
    if os.environ.get("RAY_AUTH_TOKEN"):
        return True
    path = os.environ.get("RAY_AUTH_TOKEN_PATH") or Path.home() / ".ray" / "auth_token"
    return Path(path).is_file()


def without_token() -> dict[str, str]:
    """This environment as seen by somebody without a token."""
    home = str(private_folder())  # or Ray would look into this user's
    kept = {k: v for k, v in os.environ.items() if k not in _AUTH}
    return kept | {"RAY_AUTH_MODE": "disabled", "HOME": home}


def forwarded_environment() -> dict[str, str]:
    """Environment variables of workers on nodes that were not started from here."""
    return {name: os.environ[name] for name in (*WORKERS, *FORWARDED) if name in os.environ}


def write_token() -> Path:
    """Write a new token into this process's private folder, never open to others."""
    path = private_folder() / "token"
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(handle, "w") as file:
        file.write(secrets.token_hex(32))
    return path


@functools.cache
def private_folder() -> Path:
    """A folder of mode 0700, which this process's guardian removes when the process has ended."""
    temporary = tempfile.gettempdir()
    short = len(temporary) <= 16  # there is room for Ray's sockets, see `RAY_BYTES`
    folder = Path(tempfile.mkdtemp(prefix="accerl-", dir=temporary if short else "/tmp"))
    guardian.remove(folder)
    return folder


def process_kind(command: Sequence[str]) -> str | None:
    """The one of `RAY_PROCESSES` that a command line belongs to."""
    begin = " ".join(command[:3])
    return next((kind for kind, words in RAY_PROCESSES.items() if any(w in begin for w in words)), None)


def ray_processes() -> dict[psutil.Process, str]:
    """Ray's own processes below this one, and their kind."""
    kinds = {}
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):
            kinds[process] = process_kind(process.cmdline())
    return {process: kind for process, kind in kinds.items() if kind}


def kill_ray(known: Iterable[psutil.Process] = ()) -> None:
    """Kill Ray's own processes below this one and `known` ones, and all that they have started."""
    everyone: set[psutil.Process] = set()
    for process in [*ray_processes(), *known]:
        with contextlib.suppress(psutil.Error):
            everyone |= {process, *process.children(recursive=True)}
    for process in everyone:
        with contextlib.suppress(psutil.Error):
            process.kill()
    psutil.wait_procs(everyone, timeout=GONE_S)


def start_ray(launch: LaunchConfig | None = None) -> None:
    """Start a private Ray on this machine, or join the cluster of ``launch.address``."""
    import ray

    with deferred():
        if launch is not None and launch.address is not None:
            _join(launch)
            return
        check_private()
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
                reason = " ".join(str(error).split())
                kill_ray()
                ray.shutdown()
                if attempt == STARTS or arrived():
                    raise WorkerError(f"Ray did not start in {attempt} attempts: {reason}") from error
                logger.warning("Ray did not start and is started again: %s", reason)
                time.sleep(pause_s(attempt))


def _join(launch: LaunchConfig) -> None:
    import ray
    from ray.exceptions import AuthenticationError

    if not has_token():
        hint = "there is no token; start the cluster with RAY_AUTH_MODE=token, and set RAY_AUTH_TOKEN_PATH"
        raise InputError(FIELD, launch.address, hint)
    check_cluster(launch)
    try:
        ray.init(
            address=launch.address,
            log_to_driver=False,
            configure_logging=False,
            runtime_env={"env_vars": forwarded_environment()},
        )
    except (RuntimeError, ConnectionError, ValueError, AuthenticationError) as error:
        said = " ".join(str(error.__cause__ or error).split())[:300]
        hint = f"this process cannot join it; is one of its nodes on this machine? Ray says: {said}"
        raise InputError(FIELD, launch.address, hint) from error


def check_cluster(launch: LaunchConfig) -> None:
    """Ask a cluster for its status with this run's token and without one, in processes of their own."""
    address = str(launch.address)
    if address != "auto":
        host, _, port = address.rpartition(":")
        try:
            socket.create_connection((host.strip("[]"), int(port)), CONNECT_S).close()
        except OSError as error:
            why = error.strerror or error
            hint = f"nobody listens at {address} ({why}); is it what ray start --head printed?"
            raise InputError(FIELD, address, hint) from error
    if (complaint := _complaint(address)) is not None:
        if any(word in complaint for word in UNAUTHORISED):
            hint = "it does not take the token that is configured here; see RAY_AUTH_TOKEN_PATH"
        elif address == "auto" and "ConnectionError" in complaint:
            hint = "no cluster on this machine; give HOST:PORT, or start one with ray start --head"
        else:
            last = (complaint.strip().splitlines() or ["no answer"])[-1][:200]
            hint = f"it does not answer as Ray does: {last}"
        raise InputError(FIELD, address, hint)
    if _complaint(address, without_token()) is None:
        hint = "it asks for no token, so whoever reaches it runs code in its workers; start it with "
        hint += "RAY_AUTH_MODE=token"
        raise InputError(FIELD, address, hint)


def _complaint(address: str, env: dict[str, str] | None = None) -> str | None:
    """Why a cluster does not tell its status to somebody in this environment; None: it does."""
    command = [sys.executable, *STATUS, f"--address={address}"]
    try:
        done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=ANSWER_S, check=False)
    except subprocess.TimeoutExpired:
        return f"no answer within {ANSWER_S:.0f} s"
    return done.stderr if done.returncode else None


class RaySession:
    """Ray until it is closed, and a watch over its own processes.

    A Ray that was there before is used and left running, and so is a cluster. Ray takes a minute to notice
    that its GCS is gone, then ends this process from C++, and a raylet that has been stopped blocks every
    call for ever. So when a process has died, or has been stopped for ``launch.stall_s`` (after SIGTERM or
    Ctrl-C, `HURRY_S` at most), a thread kills the others, which ends the calls that wait for them. If the
    main thread does not get on then, it ends this process.
    """

    def __init__(self, launch: LaunchConfig) -> None:
        self._launch, self._started = launch, False
        self._lost = ""
        self._thread: threading.Thread | None = None
        self._closed, self._lock = threading.Event(), threading.Lock()
        self._processes: dict[psutil.Process, str] = {}  # required processes and their kind
        self._stopped: dict[psutil.Process, float] = {}
        """Since when they have been stopped, on `time.monotonic`."""

    @property
    def lost(self) -> str:
        """The process of Ray that has been lost, and how; empty: none."""
        return self._lost if self._thread is None else self._look()

    def start(self) -> None:
        """Start Ray unless it is there and none of its processes is lost."""
        import ray

        if ray.is_initialized():
            if not self._started or not self.lost:
                return
            logger.warning("%s, and Ray is started again", self._lost)
            self.close()
        self._started, self._lost = True, ""
        start_ray(self._launch)
        if self._launch.address is None:
            self.watch()

    def watch(self) -> None:
        self._processes, self._stopped, self._closed = {}, {}, threading.Event()
        self._look()
        self._thread = threading.Thread(target=self._watch, name="ray watch", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End Ray, if it was started here. Safe to call twice."""
        import ray

        if self._started and ray.is_initialized():
            if self.lost:
                kill_ray(self._processes)
            ray.shutdown()
        self._started = False
        if self._thread is not None:
            self._closed.set()
            self._thread.join()
            self._thread = None

    def _watch(self) -> None:
        while not self._look():
            if self._closed.wait(LOOK_S):
                return
        kill_ray(self._processes)
        if not self._closed.wait(GIVE_UP_S):
            guardian.explain(cause=self._lost)
            os._exit(1)

    def _look(self) -> str:
        with self._lock:
            if len(self._processes) < len(REQUIRED):
                self._processes |= {p: kind for p, kind in ray_processes().items() if kind in REQUIRED}
            for process, kind in self._processes.items() if not self._lost else ():
                if how := self._fate(process):
                    self._lost = f"Ray's {kind} (process {process.pid}) {how}"
                    break
            return self._lost

    def _fate(self, process: psutil.Process) -> str:
        """How a process was lost; empty: it was not."""
        try:
            status = process.status()
        except psutil.NoSuchProcess:
            status = psutil.STATUS_ZOMBIE
        if status == psutil.STATUS_ZOMBIE:
            return "has died"
        if status not in (psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP):
            self._stopped.pop(process, None)
            return ""
        stopped_s = time.monotonic() - self._stopped.setdefault(process, time.monotonic())
        limit = min(HURRY_S, self._launch.stall_s) if arrived() else self._launch.stall_s
        return f"has been stopped for {stopped_s:.0f} s" if stopped_s > limit else ""


@contextlib.contextmanager
def opened(launch: LaunchConfig, now: bool) -> Iterator[RaySession | None]:
    """The Ray of a run, None in the local engine; `now`: start it beside the import of LeRobot."""
    if launch.engine == "local":
        yield None
        return
    if launch.address is None and (folder := os.environ.get("RAY_TMPDIR")):
        check_sockets(folder)
    with contextlib.closing(RaySession(launch)) as session:
        if now:
            prepare(joins=launch.address is not None)
            import ray  # noqa: F401  # now, as two threads that import the same modules may see parts of them

            with ThreadPoolExecutor(1) as pool, contextlib.suppress(WorkerError):  # failures come again later
                pool.submit(imported, "accerl_lerobot.policies.loading:load_adapter")
                session.start()
        yield session
