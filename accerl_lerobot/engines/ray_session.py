# SPDX-License-Identifier: Apache-2.0
"""The Ray of a run, and the nodes of its workers.

The Ray is a private one on this machine, or the cluster of ``launch.address``.

A private Ray listens on the loopback interface and asks for a token that only this user's processes know. Its
sockets and logs are in a folder that is removed at the end of the process. If the process is killed, Ray ends
its own processes and the folder stays. A run that joins a cluster uses the user's token and leaves the
cluster as it is.

A `Placement` has the nodes of each role's workers, and their share of a GPU, as options that Ray schedules
by. By default everything is on the node where the run is started, and processes with a network share its
GPUs. ``launch.placement`` sends a role to the nodes with a resource, or spreads it over all. Workers with a
network read the policy's files and write into the run's folder, so their nodes must see both under the same
paths.

Ray reads its environment when it is imported. So nothing here imports it at the top, and `prepare` is called
before anything does.
"""

from __future__ import annotations

import atexit
import contextlib
import logging
import math
import os
import secrets
import shutil
import socket
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

from accerl_lerobot.algorithms import ChunkCriticConfig
from accerl_lerobot.config.parsing import imported
from accerl_lerobot.engines.stopping import handled, left_to_this_process
from accerl_lerobot.errors import InputError, in_one_line

if TYPE_CHECKING:
    from accerl_lerobot.engines.config import LaunchConfig, RunConfig

logger = logging.getLogger(__name__)

STARTS = 3  # attempts to start a private Ray, which gives up after 30 s; a busy machine may need more
CONNECT_S = 5.0  # timeout for a TCP connection to a cluster
ALL = "all"  # in ``launch.placement``: every node
PART = 0.001  # share of a resource that a worker takes, so that any number of them fit where it is

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
        atexit.register(shutil.rmtree, folder, ignore_errors=True)  # after Ray's own end
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
            with left_to_this_process():
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
    except (RuntimeError, OSError, ValueError, OverflowError, AuthenticationError) as error:
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


class Placement:
    """Where the workers of a run go, in a Ray that is running or, without one, on this machine alone."""

    def __init__(self, config: RunConfig, nodes: list[dict[str, float]], this_node: str = "") -> None:
        """`nodes` are the resources of each node, this one first; `this_node` is Ray's id of that."""
        self._nodes = nodes
        self._this_node = this_node
        self._selectors = config.launch.placement
        learns = learns_states(config)
        self._workers = {
            "trainer": config.trainer.ranks,
            "world_model": int(learns or config.imagination.learns),
            "inference": config.inference.workers,
            "rollout": config.rollout.workers,
        }
        for role in self._selectors:
            self._nodes_of(role)
        # The world model of imagined environments predicts and learns on processors.
        on_gpu = ("trainer", "inference", "world_model") if learns else ("trainer", "inference")
        self._shares = {} if config.policy.device == "cpu" else self._gpu_shares(config, on_gpu)

    def options(self, role: str) -> dict[str, Any]:
        """Ray's options of an actor of this role; ``replay`` is on this node."""
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        options: dict[str, Any] = {"num_cpus": 0, "num_gpus": self._shares.get(role, 0.0)}
        selector = self._selectors.get(role)
        if selector is None:
            options["scheduling_strategy"] = NodeAffinitySchedulingStrategy(self._this_node, soft=False)
        elif selector == ALL:
            # Ray chooses the node of a worker that takes nothing by chance.
            options |= {"num_cpus": PART, "scheduling_strategy": "SPREAD"}
        else:
            options["resources"] = {selector: PART}
        return options

    def rows(self) -> list[str]:
        """One line for each role: its workers, their share of a GPU, and their nodes."""
        rows = []
        for role, count in (self._workers | {"replay": 1}).items():
            selector = self._selectors.get(role)
            if selector is None:
                where = "this node"
            else:
                where = "all nodes" if selector == ALL else f"nodes with {selector}"
            share = self._shares.get(role, 0.0)
            gpus = f" × {share:g} GPU" if share else ""
            if count:
                rows.append(f"{count} {role}{gpus} on {where}")
        return rows

    def _nodes_of(self, role: str) -> list[dict[str, float]]:
        """Resources of the nodes that a role's workers may be on."""
        selector = self._selectors.get(role)
        if selector is None:
            return self._nodes[:1]
        if selector == ALL:
            return self._nodes
        nodes = [node for node in self._nodes if selector in node]
        if not nodes:
            known = set().union(*self._nodes) - {"CPU", "GPU", "memory"}
            names = ", ".join(sorted(known))
            hint = f"no node of the cluster has this resource; there are {names}, or use all"
            raise InputError(f"launch.placement.{role}", selector, hint)
        return nodes

    def _gpu_shares(self, config: RunConfig, on_gpu: Sequence[str]) -> dict[str, float]:
        """Share of a GPU for each process of a role. Roles on the same nodes share their GPUs."""
        shares: dict[str, float] = {}
        for selector in {self._selectors.get(role) for role in on_gpu}:
            roles = [role for role in on_gpu if self._selectors.get(role) == selector]
            gpus = sum(node.get("GPU", 0.0) for node in self._nodes_of(roles[0]))
            if not gpus and config.policy.device.startswith("cuda") and selector is not None:
                hint = f"there is no GPU on the nodes with {selector}; use auto, cpu or other nodes"
                raise InputError("policy.device", config.policy.device, hint)
            others = sum(self._workers[role] for role in roles if role != "trainer")
            share = 1 / math.ceil(others / gpus) if gpus and others else 0.0
            of_trainer = 0.0
            if "trainer" in roles:
                of_trainer, share = config.trainer.gpu_shares(gpus, max(1, others))
            for role in roles:
                shares[role] = of_trainer if role == "trainer" else share
        return shares


def learns_states(config: RunConfig) -> bool:
    """True if the run has a world model that critic and teacher stand on, and that learns."""
    from accerl_lerobot.world_model.states import can_learn

    return isinstance(config.algorithm, ChunkCriticConfig) and can_learn(config.state_model)


def place_workers(config: RunConfig) -> Placement:
    """The placement of a run on the nodes that Ray has now."""
    import ray

    this_node = ray.get_runtime_context().get_node_id()
    alive = [node for node in ray.nodes() if node["Alive"]]
    alive.sort(key=lambda node: node["NodeID"] != this_node)
    return Placement(config, [node["Resources"] for node in alive], this_node)


def check_placement(config: RunConfig) -> list[str]:
    """Refuse a placement that does not fit before any long work; returns the placement as lines."""
    if config.launch.engine == "local":
        return []
    if config.launch.address is not None:
        with opened(config.launch):
            return place_workers(config).rows()
    import torch

    return Placement(config, [{"GPU": float(torch.cuda.device_count())}]).rows()
