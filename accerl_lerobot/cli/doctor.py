# SPDX-License-Identifier: Apache-2.0
"""``accerl doctor``: checks this machine, and a recipe against it; every failure comes with its hint.

A frame is really drawn, in a process of its own, because a broken OpenGL can take a process down.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import math
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from accerl_lerobot.config.machine import GIB, free_memory_gib
from accerl_lerobot.engines.config import in_flight, lag_limits
from accerl_lerobot.errors import InputError, check_absent, expanded, in_one_line, last_exception

if TYPE_CHECKING:
    from accerl_lerobot.engines.config import RunConfig

OK, WARN, FAIL = "ok", "warn", "FAIL"
DISK_GIB = 2.0  # space that demonstrations, checkpoints and videos of a run may need
ADAMW_COPIES = 3  # of the trained weights: the gradient and the two moments
RENDER_TIMEOUT_S = 120
DRAW = """
from accerl_lerobot.envs.graphics import Renderers, import_mujoco
mujoco = import_mujoco()
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><light pos='0 0 3'/><geom size='.3' rgba='1 0 0 1'/></worldbody></mujoco>"
)
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
if Renderers(model).draw(64, 64, data).std() <= 1:
    raise SystemExit("MuJoCo draws an empty picture; set MUJOCO_GL to osmesa or egl")
"""


class Check(NamedTuple):
    """One result."""

    name: str
    status: str  # ok, warn or FAIL; only the last makes the exit code 1
    text: str  # the finding and, unless it is fine, the hint


def compared(name: str, text: str, suffices: bool, hint: str) -> Check:
    """A comparison of a recipe with this machine; if it does not suffice, the hint is added."""
    return Check(name, OK, text) if suffices else Check(name, WARN, f"{text}: {hint}")


def main(arguments: list[str]) -> int:
    """``accerl doctor``; 0 if everything needed is there, otherwise 1."""
    checks: list[Check] = []
    if arguments:
        try:
            checks += recipe(arguments)
        except InputError as error:
            checks.append(Check("recipe", FAIL, str(error)))
    else:
        checks.append(rendering(needed=True))
    checks += machine(joins=any(argument.startswith("--launch.address") for argument in arguments))
    for check in checks:
        sys.stdout.write(f"{check.status:5} {check.name:10} {check.text}\n")
    failed = sum(check.status == FAIL for check in checks)
    sys.stdout.write(f"\n{failed} of {len(checks)} checks failed\n" if failed else "\nall good\n")
    return 1 if failed else 0


def machine(*, joins: bool = False) -> Iterator[Check]:
    """Checks that any run needs; `joins` is True for a run on a Ray cluster."""
    yield Check("python", OK, f"{platform.python_version()} in {sys.prefix}")
    yield from libraries(joins)
    yield Check("cpu", OK, f"{len(os.sched_getaffinity(0))} cores")
    yield Check("memory", OK, f"{free_memory_gib():.1f} GiB free")
    disk = shutil.disk_usage(Path.cwd()).free / GIB
    yield compared("disk", f"{disk:.0f} GiB free here", disk >= DISK_GIB, f"a run may need {DISK_GIB:.0f}")


def libraries(joins: bool) -> Iterator[Check]:
    """LeRobot, Ray, with the environment a run would give it, torch, and the GPUs that it sees."""
    from accerl_lerobot.engines import ray_session

    ray_session.prepare(joins)
    for name in ("lerobot", "ray", "torch"):
        try:
            importlib.import_module(name)
        except Exception as error:
            yield Check(name, FAIL, f"it cannot be imported ({in_one_line(error)}); run make setup")
            return
        yield Check(name, OK, importlib.metadata.version(name))
    import torch

    text = "none"
    if torch.cuda.is_available():
        gib = torch.cuda.get_device_properties(0).total_memory / GIB
        text = f"{torch.cuda.device_count()} × {torch.cuda.get_device_name(0)}, {gib:.0f} GiB each"
    yield Check("gpu", OK, text)


def rendering(*, needed: bool) -> Check:
    """Draws a frame in a process of its own; if it is not `needed`, a failure is only a warning."""
    failure = FAIL if needed else WARN
    if importlib.util.find_spec("mujoco") is None:
        hint = "install the extra: accerl-lerobot[metaworld] or [libero]"
        return Check("rendering", failure, f"MuJoCo is not installed; {hint}")
    command = [sys.executable, "-c", DRAW]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=RENDER_TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        hint = "set MUJOCO_GL to osmesa or egl"
        return Check("rendering", failure, f"no frame within {RENDER_TIMEOUT_S} s; {hint}")
    if done.returncode:
        why = last_exception(done.stderr) or f"ended with code {done.returncode}"
        return Check("rendering", failure, why.removeprefix("accerl_lerobot.errors.InputError: "))
    return Check("rendering", OK, "MuJoCo draws 64 × 64 pixels")


def recipe(arguments: list[str]) -> Iterator[Check]:
    """Checks of a command line of ``accerl train``: that it resolves, fits this machine, and its pace.

    Raises:
        InputError: it is refused.
    """
    from accerl_lerobot.engines.config import RunConfig, parse

    config: RunConfig = parse(RunConfig, arguments)
    from accerl_lerobot.engines.ray_session import check_placement
    from accerl_lerobot.run.preflight import check_start
    from accerl_lerobot.world_model.imagined import check_imagination

    if config.output_dir is not None and not config.resume:
        check_absent(expanded(config.output_dir, "output_dir"))
    check_start(config)
    yield Check("recipe", OK, "resolves")
    yield rendering(needed=config.env.type in ("metaworld", "libero"))
    yield resources(config)
    yield from gpu_memory(config)
    yield from pace(config)
    count = config.imagination.environments
    if count:
        check_imagination(config)
        yield Check("imagination", OK, f"{count} imagined environments per rollout process")
    for row in check_placement(config):  # a cluster is asked if one is to be joined
        yield Check("placement", OK, row)


def resources(config: RunConfig) -> Check:
    """Cores of this machine against the processes and threads of the recipe."""
    cores = len(os.sched_getaffinity(0))
    workers = config.rollout.workers
    threads = max(config.trainer.num_threads, config.inference.num_threads)
    networks = f"{config.inference.workers} inference, {config.trainer.ranks} trainer"
    text = f"{cores} for {workers} rollout workers, {networks}"
    hint = "lower rollout.workers, trainer.num_threads or inference.num_threads"
    return compared("cores", text, max(workers, threads) <= cores, hint)


def gpu_memory(config: RunConfig) -> Iterator[Check]:
    """Memory that a given policy takes on the GPU of its trainer, without what a batch adds."""
    import torch

    from accerl_lerobot.policies.loading import policy_sizes, resolve_device

    if config.policy.path is None or resolve_device(config.policy.device).type == "cpu":
        return
    policy = policy_sizes(config.policy)
    copies = ADAMW_COPIES
    if config.trainer.probe_every:
        copies += 1  # the weights of the probe
    need = 4 * (policy.policy + policy.trained * copies) / GIB
    memory = torch.cuda.get_device_properties(0).total_memory / GIB
    text = f"weights, gradients and AdamW take {need:.1f} GiB of GPU memory"
    hint = "use policy.tuning.mode=lora, or several GPUs and trainer.sharding=zero3"
    yield compared("needs", text, need <= memory, hint)


def pace(config: RunConfig) -> Iterator[Check]:
    """How far apart collecting and learning may run under this recipe, and how much it collects."""
    replay = config.replay
    trainer = config.trainer
    bound, of_pace = lag_limits(config)
    text = f"at most {bound} updates with {in_flight(config)} decisions under way"
    hint = (
        f"the pace alone allows {of_pace}, so segments may be thrown away as too old; lower replay.capacity, "
        "replay.max_unlearned_decisions or replay.samples_per_insert, or raise replay.max_lag"
    )
    yield compared("lag", text, of_pace <= bound, hint)
    collected = math.ceil(trainer.updates * trainer.batch_decisions / replay.samples_per_insert)
    text = f"{trainer.updates:,} updates of {trainer.batch_decisions} on about {collected:,} decisions"
    yield Check("work", OK, text)
