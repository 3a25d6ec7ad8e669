# SPDX-License-Identifier: Apache-2.0
"""The Ray that a run has, a private one or a cluster that it joins, and its nodes before anything is placed.

A cluster is looked at before this process connects, by processes that end: what is at the address, whether it
asks for a token, whether it takes this one. Ray itself would wait for minutes, or let anybody in. Then every
node that a worker may be on says which versions it has, and which of the run's files it sees.

Ending a run ends its workers: a private Ray goes with them, a cluster stays.
"""

from __future__ import annotations

import contextlib
import json
import logging
import secrets
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import ray
from ray._private import services
from ray._private.state import available_resources_per_node, total_resources_per_node
from ray.exceptions import AuthenticationError, GetTimeoutError, RayError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from accerl_lerobot.engine.config import LaunchConfig, RunConfig
from accerl_lerobot.engine.contract import WorkerError, pause_s
from accerl_lerobot.engine.placement import Node, Place, Plan, asked, candidates, planned
from accerl_lerobot.engine.placement_config import WHERE
from accerl_lerobot.engine.ray_environment import check_private, has_token, kind_of, passed_on, without_token
from accerl_lerobot.engine.stopping import arrived, deferred
from accerl_lerobot.errors import InputError
from accerl_lerobot.transport.shared_memory import this_node

logger = logging.getLogger(__name__)

FIELD = "launch.address"
CONNECT_S = 5.0
"""How long a machine may take to accept a connection."""
ANSWER_S = 60.0
"""How long a cluster may take to answer who asks whether it is one, most of which is importing Ray."""
REPORT_S = 120.0
"""How long a node may take to start a process and say what it has."""
FREED_S = 20.0
"""How long what ended before this run may take to give back what it had."""
STRANGE = ("Unauthenticated", "UNAUTHENTICATED", "InvalidAuthToken", "AuthenticationError")
"""One of these is said to who has no token, or a wrong one."""
STARTS = 4
"""How often a private Ray is started: it gives up after 30 s, which may be too few on a busy machine."""
GONE_S = 3.0
"""How long a killed process may take to be gone."""
ASK = """
import sys
from ray._raylet import GcsClient
found = GcsClient(address=sys.argv[1]).internal_kv_get(b"CLUSTER_METADATA", b"cluster", 20)
print((found or b"{}").decode())
"""
VERSIONS = ("python", "lerobot", "torch", "accerl_lerobot", "its code")
"""Packages whose versions must be alike on all nodes. Ray compares its own version."""


def start_ray(launch: LaunchConfig | None = None) -> None:
    """A private Ray on this machine, without a dashboard, or the cluster of ``launch.address``.

    Raises:
        InputError: there is no such cluster, or it is none that this run should join.
        WorkerError: a private Ray has not started, though it was tried `STARTS` times.
    """
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
            except Exception as error:  # its own classes, and of its start-up a plain one
                reason = " ".join(str(error).split())
                kill_ray()
                ray.shutdown()
                if attempt == STARTS or arrived():
                    raise WorkerError(f"Ray did not start in {attempt} attempts: {reason}") from error
                logger.warning("Ray did not start and is started again: %s", reason)
                time.sleep(pause_s(attempt))


def ray_processes() -> dict[psutil.Process, str]:
    """Ray's own processes below this one, by kind."""
    found = {}
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):
            if kind := kind_of(process.cmdline()):
                found[process] = kind
    return found


def kill_ray(known: Iterable[psutil.Process] = ()) -> None:
    """Kills Ray's own processes below this one, and all that they have started.

    Args:
        known: others, which may have lost their parent.
    """
    everyone: set[psutil.Process] = set()
    for process in [*ray_processes(), *known]:
        with contextlib.suppress(psutil.Error):
            everyone |= {process, *process.children(recursive=True)}
    for process in everyone:
        with contextlib.suppress(psutil.Error):
            process.kill()
    psutil.wait_procs(everyone, timeout=GONE_S)


def placed(config: RunConfig) -> Plan:
    """Where the workers of a run go on the nodes that Ray has now.

    Raises:
        InputError: they do not fit, or a node has other versions.
        WorkerError: a node does not answer.
    """
    deadline, known = time.monotonic() + FREED_S, alive()
    try:
        seen = _seen(config)
    except WorkerError:
        if known <= alive():
            raise
        seen = _seen(config)  # one has left, which Ray finds out when it is asked for something
    while True:
        nodes, whole = _nodes()
        nodes = [seen(node) for node in nodes]
        try:
            plan = planned(nodes, config)
            break
        except InputError:
            # What has just been ended is given back a moment later.
            if whole or time.monotonic() > deadline:
                raise
            time.sleep(0.5)
    for row in plan.rows():
        logger.info("%s", row)
    return plan


def rehearse(config: RunConfig) -> list[str]:
    """The plan as lines, of a run that joins a cluster; leaves it as it was.

    Raises:
        InputError: see `start_ray` and `placed`.
    """
    if ray.is_initialized():
        return list(placed(config).rows())
    start_ray(config.launch)
    try:
        return list(placed(config).rows())
    finally:
        ray.shutdown()


def on(place: Place) -> dict[str, Any]:
    """Options of an actor that is to be there."""
    strategy = NodeAffinitySchedulingStrategy(place.node.key, soft=False)
    return {"num_cpus": place.cpus, "num_gpus": place.gpus, "scheduling_strategy": strategy}


def alive() -> frozenset[str]:
    """Keys of the nodes that are there."""
    return frozenset(node["NodeID"] for node in ray.nodes() if node["Alive"])


def _join(launch: LaunchConfig) -> None:
    address = _found(str(launch.address))
    if not has_token() and not launch.open_cluster:
        remedy = (
            "there is no token; start the cluster with RAY_AUTH_MODE=token and give its token by "
            "RAY_AUTH_TOKEN_PATH, or add --launch.open_cluster=true to do without"
        )
        raise InputError(FIELD, launch.address, remedy)
    _check_cluster(address, launch)
    try:
        ray.init(
            address=address,
            log_to_driver=False,
            configure_logging=False,
            runtime_env={"env_vars": passed_on()},
        )
    except (RuntimeError, ConnectionError, ValueError, AuthenticationError) as error:
        said = " ".join(str(error.__cause__ or error).split())[:300]
        remedy = f"this process cannot join it; is one of its nodes on this machine? Ray says: {said}"
        raise InputError(FIELD, launch.address, remedy) from error


def _found(address: str) -> str:
    """HOST:PORT, somebody listening there."""
    given = address
    if address == "auto":
        try:
            address = services.canonicalize_bootstrap_address_or_die("auto")
        except (ConnectionError, ValueError) as error:
            remedy = (
                "no cluster was found on this machine; give HOST:PORT, or start one with ray start --head"
            )
            raise InputError(FIELD, given, remedy) from error
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), CONNECT_S).close()
    except OSError as error:
        remedy = (
            f"nobody listens at {address} ({error.strerror or error}); is it what ray start --head printed?"
        )
        raise InputError(FIELD, given, remedy) from error
    return address


def _check_cluster(address: str, launch: LaunchConfig) -> None:
    """Asks it as who has this run's token, and as who has none.

    Raises:
        InputError: it is no Ray, takes the token for a wrong one, or asks for none.
    """
    command = [sys.executable, "-c", ASK, address]
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with (
        subprocess.Popen(command, **pipes) as known,
        subprocess.Popen(command, env=without_token(), **pipes) as stranger,
    ):
        said, complaint = _answer(known)
        open_to_all = _answer(stranger)[0] is not None
    if said is None:
        if any(word in complaint for word in STRANGE):
            remedy = "it does not take the token that is configured here; see RAY_AUTH_TOKEN_PATH"
            raise InputError(FIELD, launch.address, remedy)
        last = (complaint.strip().splitlines() or ["no answer"])[-1][:200]
        remedy = f"what listens at {address} does not answer as Ray {ray.__version__} does: {last}"
        raise InputError(FIELD, launch.address, remedy)
    version = json.loads(said).get("ray_version", ray.__version__)
    if version != ray.__version__:
        remedy = f"it runs Ray {version}, and this is {ray.__version__}; install the same on all machines"
        raise InputError(FIELD, launch.address, remedy)
    if open_to_all and not launch.open_cluster:
        remedy = (
            "it asks for no token, so whoever reaches it runs code in its workers; start it with "
            "RAY_AUTH_MODE=token, or add --launch.open_cluster=true"
        )
        raise InputError(FIELD, launch.address, remedy)


def _answer(process: subprocess.Popen[str]) -> tuple[str | None, str]:
    """Its printed answer, None if it has failed; and its complaints."""
    try:
        said, complaint = process.communicate(timeout=ANSWER_S)
    except subprocess.TimeoutExpired:
        process.kill()
        return None, f"no answer within {ANSWER_S:.0f} s"
    return (said if process.returncode == 0 else None), complaint


def _nodes() -> tuple[list[Node], bool]:
    """The nodes that are there, this one first; and whether nothing of them is taken."""
    here = ray.get_runtime_context().get_node_id()
    rows = sorted(
        (node for node in ray.nodes() if node["Alive"]),
        key=lambda node: (node["NodeID"] != here, node["NodeManagerAddress"], node["NodeID"]),
    )
    free, total = available_resources_per_node(), total_resources_per_node()
    own = "" if len(rows) > 1 else this_node()
    found = [
        Node(
            number=number,
            key=row["NodeID"],
            name=row["NodeManagerAddress"],
            cpus=free.get(row["NodeID"], {}).get("CPU", 0.0),
            gpus=free.get(row["NodeID"], {}).get("GPU", 0.0),
            resources=frozenset(name for name in row["Resources"] if _is_custom(name)),
            host=own or row["NodeID"],
        )
        for number, row in enumerate(rows)
    ]
    whole = all(
        free.get(key, {}).get(kind, 0.0) >= had.get(kind, 0.0)
        for key, had in total.items()
        for kind in ("CPU", "GPU")
    )
    return found, whole


def _is_custom(name: str) -> bool:
    own = ("CPU", "GPU", "memory", "object_store_memory")
    return name not in own and not name.startswith(("node:", "accelerator_type:"))


def _seen(config: RunConfig) -> Callable[[Node], Node]:
    """Adds what nodes say of themselves, where a cluster was joined.

    Raises:
        InputError: one of those has other versions, or does not answer.
    """
    nodes, _ = _nodes()
    wanted = {0} if config.launch.address is not None else set()
    for role in asked(config):
        found = candidates(nodes, role.config.nodes, f"{WHERE}.{role.role}.nodes")
        wanted |= {node.number for node in found}
    if wanted == {0} and config.launch.address is None:
        return lambda node: node
    said = _reports([node for node in nodes if node.number in wanted], config)

    def seen(node: Node) -> Node:
        report = said.get(node.key)
        return node if report is None else replace(node, host=report["host"], unseen=report["unseen"])

    return seen


def _reports(nodes: list[Node], config: RunConfig) -> dict[str, dict[str, str]]:
    """Reports of the nodes, each compared with this machine."""
    policy = config.policy.path if config.policy.path and Path(config.policy.path).is_dir() else None
    tell = _teller()
    with _mark(config) as mark:
        here = tell(mark, policy)
        task = ray.remote(tell)
        asked_of = [(node, task.options(**on(Place(node, 0.0, 0.0))).remote(mark, policy)) for node in nodes]
        told = {node.key: (node, _told(node, reference)) for node, reference in asked_of}
    found: dict[str, dict[str, str]] = {}
    for key, (node, report) in told.items():
        for name in VERSIONS:
            if report[name] != here[name]:
                there = report[name] or "missing"
                remedy = f"{node} has {name} {there}, and this is {here[name]}; install the same on all"
                raise InputError(FIELD, config.launch.address, remedy)
        unseen = ""
        if policy is not None and report["policy"] != here["policy"]:
            unseen = f"policy.path, {policy}"
        if report["mark"] != here["mark"]:
            unseen = f"the run's folder, {config.output_dir}"
        found[key] = {"host": report["host"], "unseen": unseen}
    return found


def _told(node: Node, reference: Any) -> dict[str, str]:
    try:
        return dict(ray.get(reference, timeout=REPORT_S))
    except GetTimeoutError as error:
        raise WorkerError(f"{node} has not said within {REPORT_S:.0f} s which versions it has") from error
    except RayError as error:
        raise WorkerError(f"{node} could not say which versions it has:\n{error}") from error


@contextlib.contextmanager
def _mark(config: RunConfig) -> Iterator[str | None]:
    """A file in the run's folder for as long as others look for it."""
    if config.output_dir is None:
        yield None
        return
    path = Path(config.output_dir).absolute() / f".seen-{secrets.token_hex(8)}"
    path.touch()
    try:
        yield str(path)
    finally:
        path.unlink(missing_ok=True)


def _teller() -> Callable[[str | None, str | None], dict[str, str]]:
    """Code that a node runs; it travels as text, since the package may be missing there."""

    def tell(mark: str | None, policy: str | None) -> dict[str, str]:
        import hashlib
        import importlib.metadata
        import importlib.util
        import platform
        from pathlib import Path

        def version(name: str) -> str:
            try:
                return importlib.metadata.version(name)
            except importlib.metadata.PackageNotFoundError:
                return ""

        def digest(paths: list[Path]) -> str:
            found = hashlib.sha256()
            for path in paths:
                found.update(path.name.encode() + b"\0" + path.read_bytes())
            return found.hexdigest()[:12]

        spec = importlib.util.find_spec("accerl_lerobot")
        folder = None if spec is None or spec.origin is None else Path(spec.origin).parent
        config = None if policy is None else Path(policy) / "config.json"
        host = ""
        if folder is not None:
            from accerl_lerobot.transport.shared_memory import this_node

            host = this_node()
        return {
            "python": ".".join(platform.python_version_tuple()[:2]),
            "lerobot": version("lerobot"),
            "torch": version("torch"),
            "accerl_lerobot": version("accerl-lerobot"),
            "its code": "" if folder is None else digest(sorted(folder.rglob("*.py"))),
            "host": host,
            "policy": "" if config is None or not config.is_file() else digest([config]),
            "mark": "" if mark is None or not Path(mark).is_file() else "seen",
        }

    return tell
