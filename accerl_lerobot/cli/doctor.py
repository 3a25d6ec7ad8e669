# SPDX-License-Identifier: Apache-2.0
"""``accerl doctor``: checks this machine, and a recipe against it; every failure comes with its hint.

A frame is really drawn, in a process of its own, because a broken OpenGL can take a process down.
"""

from __future__ import annotations

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

from accerl_lerobot.checkpoint.safety import brief
from accerl_lerobot.config.machine import GIB, memory_gib
from accerl_lerobot.engines.config import lag_limits
from accerl_lerobot.errors import InputError
from accerl_lerobot.run import sizes

if TYPE_CHECKING:
    from accerl_lerobot.engines.config import RunConfig

OK, WARN, FAIL = "ok", "warn", "FAIL"
DISK_GIB = 2.0  # space that demonstrations, checkpoints and videos of a run may need
RENDER_TIMEOUT_S = 120

DRAW = """
from accerl_lerobot.envs.graphics import import_mujoco, new_renderer
mujoco = import_mujoco()
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><light pos='0 0 3'/><geom size='.3' rgba='1 0 0 1'/></worldbody></mujoco>"
)
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = new_renderer(model, 64, 64)
renderer.update_scene(data)
print("drawn" if renderer.render().std() > 1 else "empty")
"""


class Check(NamedTuple):
    """One result."""

    name: str
    status: str  # ok, warn or FAIL; only the last makes the exit code 1
    text: str  # the finding and, unless it is fine, the hint


def main(arguments: list[str]) -> int:
    """``accerl doctor``; 0 if everything needed is there, otherwise 1."""
    config: RunConfig | None = None
    history = 1
    checks = []
    if arguments:
        try:
            config, history = _resolve(arguments)
            checks.append(Check("recipe", OK, "resolves"))
        except InputError as error:
            checks.append(Check("recipe", FAIL, str(error)))
    checks += machine(config, history)
    if config is not None:
        checks += pace(config)
        for name, check in (("imagination", imagination), ("placement", placement)):
            try:
                checks += check(config)
            except InputError as error:
                checks.append(Check(name, FAIL, str(error)))
    for each in checks:
        sys.stdout.write(f"{each.status:5} {each.name:10} {each.text}\n")
    failed = sum(each.status == FAIL for each in checks)
    sys.stdout.write(f"\n{failed} of {len(checks)} checks failed\n" if failed else "\nall good\n")
    return 1 if failed else 0


def _resolve(arguments: list[str]) -> tuple[RunConfig, int]:
    """The config of a command line, and its policy's ``n_obs_steps``."""
    from accerl_lerobot.engines.config import RunConfig, parse
    from accerl_lerobot.run.preflight import check_start

    config: RunConfig = parse(RunConfig, arguments)
    _, history = check_start(config)
    return config, history


def machine(config: RunConfig | None, history: int = 1) -> Iterator[Check]:
    """Checks that any run needs, and those of `config`; `history` is the policy's ``n_obs_steps``."""
    yield Check("python", OK, f"{platform.python_version()} in {sys.prefix}")
    yield packages()
    yield from libraries(config)
    yield rendering(needed=config is None or config.env.type in ("metaworld", "libero"))
    yield from resources(config, history)


def packages() -> Check:
    """Installed versions against the ranges of this package's requirements."""
    from packaging.requirements import Requirement

    wrong = []
    missing = False
    try:
        requirements = importlib.metadata.requires("accerl-lerobot") or []
    except importlib.metadata.PackageNotFoundError:
        return Check("packages", FAIL, "accerl-lerobot is not installed: run make setup")
    for requirement in map(Requirement, requirements):
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        try:
            version = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            missing = True
            wrong.append(f"{requirement.name} missing")
            continue
        if not requirement.specifier.contains(version, prereleases=True):
            wrong.append(f"{requirement.name} {version}, not {requirement.specifier}")
    if wrong:
        return Check("packages", FAIL if missing else WARN, f"{'; '.join(wrong)}: run make setup")
    lerobot = importlib.metadata.version("lerobot")
    return Check("packages", OK, f"all within their ranges, lerobot {lerobot} among them")


def libraries(config: RunConfig | None) -> Iterator[Check]:
    """Ray, with the environment a run would give it, torch, and the GPUs that it sees."""
    from accerl_lerobot.engines import ray_session

    try:
        ray_session.prepare(joins=config is not None and config.launch.address is not None)
        import ray

        yield Check("ray", OK, ray.__version__)
    except Exception as error:
        yield Check("ray", FAIL, _importing(error))
    try:
        import torch
    except Exception as error:
        yield Check("torch", FAIL, _importing(error))
        return
    yield Check("torch", OK, str(torch.__version__))
    if not torch.cuda.is_available():
        yield Check("gpu", OK, "none")
        return
    gib = torch.cuda.get_device_properties(0).total_memory / GIB
    text = f"{torch.cuda.device_count()} × {torch.cuda.get_device_name(0)}, {gib:.0f} GiB each"
    need = 0.0 if config is None else _learning_gib(config)
    if need > gib:
        hint = "use policy.tuning.mode=lora, or several GPUs and trainer.sharding=zero3"
        yield Check("gpu", WARN, f"{text}; weights, gradients and AdamW take {need:.1f} GiB: {hint}")
        return
    if need:
        text += f"; weights, gradients and AdamW take {need:.1f}, trainer.micro_batch sizes the rest"
    yield Check("gpu", OK, text)


def _learning_gib(config: RunConfig) -> float:
    """Memory that a given policy takes on the GPU of its trainer, without what a batch adds."""
    from accerl_lerobot.policies.loading import policy_sizes, resolve_device

    if config.policy.path is None or resolve_device(config.policy.device).type == "cpu":
        return 0.0
    policy = policy_sizes(config.policy)
    return 4 * (policy.policy + policy.trained * sizes.trained_copies(config)) / GIB


def _importing(error: Exception) -> str:
    if isinstance(error, InputError):
        return str(error)
    return f"cannot be imported ({brief(error)}); run make setup"


def rendering(*, needed: bool, script: str = DRAW) -> Check:
    """Draws a frame in a process of its own; if it is not `needed`, a failure is only a warning."""
    from accerl_lerobot.envs.graphics import choose_backend

    failure = FAIL if needed else WARN
    if importlib.util.find_spec("mujoco") is None:
        text = "MuJoCo is not installed; install the extra: accerl-lerobot[metaworld] or [libero]"
        return Check("rendering", failure, text)
    hint = "set MUJOCO_GL to osmesa or egl"
    command = [sys.executable, "-c", script]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=RENDER_TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        return Check("rendering", failure, f"no frame within {RENDER_TIMEOUT_S} s; {hint}")
    if done.returncode:
        lines = done.stderr.strip().splitlines() or [f"ended with code {done.returncode}"]
        text = lines[-1].removeprefix("accerl_lerobot.errors.InputError: ")
        return Check("rendering", failure, text)
    if done.stdout.split() != ["drawn"]:
        return Check("rendering", failure, f"MuJoCo draws an empty picture; {hint}")
    backend = os.environ.get("MUJOCO_GL") or choose_backend() or "the display"
    return Check("rendering", OK, f"MuJoCo draws 64 × 64 pixels ({backend})")


def resources(config: RunConfig | None, history: int = 1) -> Iterator[Check]:
    """Cores, memory and disk, against what the recipe will take."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    text, status = f"{cores} cores", OK
    if config is not None:
        text += f" for {config.rollout.workers} rollout, 1 inference, 1 trainer"
        if config.rollout.workers > cores:
            status, text = WARN, f"{text}: they will wait for each other; lower rollout.workers"
        elif max(config.trainer.num_threads, config.inference.num_threads) > cores:
            status, text = WARN, f"{text}: lower trainer.num_threads and inference.num_threads to {cores}"
    yield Check("cpu", status, text)
    free = memory_gib("MemAvailable")
    if free is not None:
        text, status = f"{free:.1f} GiB free", OK
        if config is not None:
            need = sizes.policy_gib(config) + sum(sizes.memory_parts_gib(config, history).values())
            text += f", about {need:.1f} GiB needed"
            if need > free:
                status = WARN
                text += (
                    ": lower rollout.workers, rollout.environments or replay.capacity, "
                    "or use a smaller policy"
                )
        yield Check("memory", status, text)
    disk = shutil.disk_usage(Path.cwd()).free / GIB
    if disk < DISK_GIB:
        yield Check("disk", WARN, f"{disk:.0f} GiB free here; a run may need {DISK_GIB:.0f}")
    else:
        yield Check("disk", OK, f"{disk:.0f} GiB free here")


def imagination(config: RunConfig) -> Iterator[Check]:
    """Imagination settings against the environment and the policy."""
    from accerl_lerobot.world_model.imagined import check_imagination

    count = config.imagination.environments
    if count:
        check_imagination(config)
        yield Check("imagination", OK, f"{count} imagined environments per rollout process")


def placement(config: RunConfig) -> Iterator[Check]:
    """Where each worker would run; the cluster is asked if one is to be joined."""
    from accerl_lerobot.engines.placement import check_placement

    return (Check("placement", OK, row) for row in check_placement(config))


def pace(config: RunConfig) -> Iterator[Check]:
    """How far apart collecting and learning may run under this recipe, and how much it collects."""
    replay, trainer = config.replay, config.trainer
    bound, of_pace = lag_limits(config)
    text = f"at most {bound} updates with {config.rollout.in_flight} decisions under way"
    if of_pace > bound:
        text += (
            f"; the pace alone allows {of_pace}, so segments may be thrown away as too old: "
            "lower replay.capacity, replay.max_unlearned_decisions or replay.samples_per_insert, "
            "or raise replay.max_lag"
        )
    yield Check("lag", WARN if of_pace > bound else OK, text)
    collected = math.ceil(trainer.updates * trainer.batch_decisions / replay.samples_per_insert)
    text = f"{trainer.updates:,} updates of {trainer.batch_decisions} on about {collected:,} decisions"
    of_sft = config.sft.policy.get("n_action_steps", 0) if config.sft.steps else 0
    actions = int(config.policy.n_action_steps or of_sft)
    if actions:
        text += f", at most {collected * actions:,} env steps"
    yield Check("work", OK, text)
