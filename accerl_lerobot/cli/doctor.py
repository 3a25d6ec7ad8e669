# SPDX-License-Identifier: Apache-2.0
"""``accerl doctor``: checks a recipe against this machine; every failure comes with its hint.

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
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from accerl_lerobot.checkpoint.safety import MIB, brief
from accerl_lerobot.engine import sizes
from accerl_lerobot.engine.config import lag_limits
from accerl_lerobot.errors import InputError

if TYPE_CHECKING:
    from accerl_lerobot.engine.config import RunConfig

OK, WARN, FAIL = "ok", "warn", "FAIL"
DISK_GIB = 2.0  # space that demonstrations, checkpoints and videos of a run may need
RENDER_TIMEOUT_S = 120
USABLE = 0.8
"""Share of a device's memory that an estimate may fill. SmolVLA's backward pass took 1.19 times its estimate
on a CPU, for gradients under way and fragmentation; on a GPU CUDA's libraries need their part too."""

DRAW = """
import time
from accerl_lerobot.envs.graphics import import_mujoco, new_renderer
mujoco = import_mujoco()
model = mujoco.MjModel.from_xml_string(
    "<mujoco><worldbody><light pos='0 0 3'/><geom size='.3' rgba='1 0 0 1'/></worldbody></mujoco>"
)
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
renderer = new_renderer(model, 64, 64)
renderer.update_scene(data)
renderer.render()
started = time.perf_counter()
renderer.update_scene(data)
frame = renderer.render()
print("drawn", frame.std() > 1, round(1000 * (time.perf_counter() - started), 1))
"""


class Check(NamedTuple):
    """One result."""

    name: str
    status: str  # ok, warn or FAIL; only the last makes the exit code 1
    text: str  # the finding and, unless it is fine, the hint


def main(arguments: list[str]) -> int:
    """``accerl doctor``; 0 if everything needed is there, otherwise 1."""
    config, history, checks = _resolve(arguments) if arguments else (None, 1, [])
    checks += machine(config, history)
    if config is not None:
        checks += pace(config)
        for name, check in (("imagination", imagination), ("placement", placement), ("policy", policy_fits)):
            try:
                checks += check(config)
            except InputError as error:
                checks.append(Check(name, FAIL, str(error)))
    for each in checks:
        sys.stdout.write(f"{each.status:5} {each.name:10} {each.text}\n")
    failed = sum(each.status == FAIL for each in checks)
    sys.stdout.write(f"\n{'all good' if not failed else f'{failed} of {len(checks)} checks failed'}\n")
    return 1 if failed else 0


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
    from packaging.utils import canonicalize_name

    here: dict[str, str] = {canonicalize_name(d.name): d.version for d in importlib.metadata.distributions()}
    if "accerl-lerobot" not in here:
        return Check("packages", FAIL, "accerl-lerobot is not installed: run make setup")
    wrong: dict[str, str | None] = {}
    for requirement in map(Requirement, importlib.metadata.requires("accerl-lerobot") or ()):
        installed = here.get(canonicalize_name(requirement.name))
        needed = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
        if needed and not (installed and requirement.specifier.contains(installed, prereleases=True)):
            wrong[f"{requirement.name} {installed or 'missing'}, not {requirement.specifier}"] = installed
    if wrong:
        return Check("packages", WARN if all(wrong.values()) else FAIL, f"{'; '.join(wrong)}: run make setup")
    return Check("packages", OK, f"all within their ranges, lerobot {here['lerobot']} among them")


def libraries(config: RunConfig | None) -> Iterator[Check]:
    """Ray, with the environment a run would give it, torch, and the GPUs that it sees."""
    from accerl_lerobot.engine import ray_session

    try:
        ray_session.prepare(joins=config is not None and config.launch.address is not None)
    except InputError as error:
        yield Check("ray", FAIL, str(error))
    for name in ("ray", "torch"):
        try:
            module = importlib.import_module(name)
        except Exception as error:
            yield Check(name, FAIL, f"cannot be imported ({brief(error)}); run make setup")
            continue
        text = str(module.__version__)
        if name == "torch":
            count = module.cuda.device_count() if module.cuda.is_available() else 0
            text += f", {count} × {module.cuda.get_device_name(0)}" if count else ", no CUDA device"
        yield Check(name, OK, text)


def rendering(*, needed: bool, script: str = DRAW) -> Check:
    """Draws a frame in a process of its own; if it is not `needed`, a failure is only a warning."""
    from accerl_lerobot.envs.graphics import choose_backend

    command, hint = [sys.executable, "-c", script], "set MUJOCO_GL to osmesa or egl"
    if importlib.util.find_spec("mujoco") is None:
        text = "MuJoCo is not installed; install the extra: accerl-lerobot[metaworld] or [libero]"
        return Check("rendering", FAIL if needed else WARN, text)
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=RENDER_TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        text = f"no frame within {RENDER_TIMEOUT_S} s; {hint}"
    else:
        words = done.stdout.split()
        if done.returncode == 0 and words[:2] == ["drawn", "True"]:
            backend = os.environ.get("MUJOCO_GL") or choose_backend() or "the display"
            return Check("rendering", OK, f"MuJoCo draws 64 × 64 pixels in {words[2]} ms ({backend})")
        text = (done.stderr.strip().splitlines() or [f"ended with code {done.returncode}"])[-1]
        text = text.removeprefix("accerl_lerobot.errors.InputError: ")
        if done.returncode == 0:
            text = f"MuJoCo draws an empty picture; {hint}"
    return Check("rendering", FAIL if needed else WARN, text)


def resources(config: RunConfig | None, history: int = 1) -> Iterator[Check]:
    """Cores, memory and disk, against what the recipe will take."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    text, status = f"{cores} cores", OK
    if config is not None:
        threads = max(config.trainer.num_threads, config.inference.num_threads)
        text += f" for {config.rollout.workers} rollout, 1 inference, 1 trainer"
        if config.rollout.workers > cores:
            status, text = WARN, f"{text}: they will wait for each other; lower rollout.workers"
        elif threads > cores:
            status, text = WARN, f"{text}: lower trainer.num_threads and inference.num_threads to {cores}"
    yield Check("cpu", status, text)
    free = sizes.memory_gib("MemAvailable")
    if free is not None:
        text, status = f"{free:.1f} GiB free", OK
        if config is not None:
            need = sizes.policy_gib(config) + sum(sizes.memory_parts_gib(config, history).values())
            text += f", about {need:.1f} GiB needed"
            if need > free:
                hint = (
                    "lower rollout.workers, rollout.environments or replay.capacity, or use a smaller policy"
                )
                status, text = WARN, f"{text}: {hint}"
        yield Check("memory", status, text)
    disk = shutil.disk_usage(Path.cwd()).free / sizes.GIB
    short = disk < DISK_GIB
    text = f"{disk:.0f} GiB free here" + (f"; a run may need {DISK_GIB:.0f}" if short else "")
    yield Check("disk", WARN if short else OK, text)


def imagination(config: RunConfig) -> Iterator[Check]:
    """Imagination settings against the environment and the policy."""
    from accerl_lerobot.engine.imagination import check_imagination

    if share := config.imagination.share:
        check_imagination(config)
        yield Check("imagination", OK, f"{share:.0%} of every batch; world model: {config.imagination.model}")


def placement(config: RunConfig) -> Iterator[Check]:
    """Where each worker would run; the cluster is asked if one is to be joined."""
    from accerl_lerobot.engine.placement import check_placement

    return (Check("placement", OK, row) for row in check_placement(config))


def policy_fits(config: RunConfig) -> Iterator[Check]:
    """The memory of a given policy where it learns and acts, against that of its device."""
    from accerl_lerobot.algorithms import RatioConfig
    from accerl_lerobot.policies.loading import learning_config, rehearsed, resolve_device
    from accerl_lerobot.trainer.footprint import PolicyMemory, policy_memory
    from accerl_lerobot.trainer.off_policy import POLICY_BATCH

    if config.policy.path is None or not config.trainer.updates:
        return
    trainer, ratio = config.trainer, isinstance(config.algorithm, RatioConfig)
    device = resolve_device(config.policy.device)
    measure = partial(policy_memory, imitates=not ratio, checkpointing=trainer.activation_checkpointing)
    learning_config(config.policy)
    memory = PolicyMemory(*rehearsed(config.policy, measure))
    batch = math.ceil(trainer.batch_decisions / trainer.ranks) if ratio else POLICY_BATCH
    decisions = min(batch, trainer.micro_batch)
    kept: float = memory.weights + sizes.trained_copies(config) * memory.trained
    if trainer.zero:  # zero2 holds all weights from the forward pass to the end of the backward pass
        kept = kept / trainer.ranks + (memory.weights if trainer.sharding == "zero2" else 0)
    kept += memory.learning_batch
    acting = memory.replica(config.inference.max_batch)
    usable, replicas, place = _device_memory(config, device)
    need = kept + decisions * memory.learning + replicas * acting
    text = (
        f"trainer {_gib(kept)} and {_gib(memory.learning)} for each of {decisions} decisions, "
        f"inference {_gib(acting)}; {_gib(need)} of {_gib(usable)} on {place}"
    )
    if need <= usable:
        yield Check("policy", OK, text)
        return
    fitting = int((usable - kept - replicas * acting) / memory.learning)
    hint = f"use --trainer.micro_batch={fitting}" if fitting > 0 else "use policy.tuning.mode=lora"
    if not trainer.activation_checkpointing:
        hint += ", or --trainer.activation_checkpointing=true"
    yield Check("policy", WARN, f"{text}: {hint}")


def _device_memory(config: RunConfig, device: Any) -> tuple[float, int, str]:
    """Bytes that a rank and the inference replicas beside it may take, how many these are, and of what."""
    import torch

    others = config.inference.workers if config.launch.engine != "local" else 0
    if device.type == "cpu":
        free = sizes.memory_gib("MemAvailable") or math.inf
        rest = free - sum(sizes.memory_parts_gib(config).values())
        return USABLE * rest * sizes.GIB, others, "this machine"
    gpus = torch.cuda.device_count()
    rank, other = config.trainer.gpu_shares(gpus, others)
    beside = int((1 - rank) / other + 1e-6) if other else 0
    smallest = min(torch.cuda.get_device_properties(i).total_memory for i in range(gpus))
    return USABLE * smallest, min(others, beside), "a GPU"


def _gib(size: float) -> str:
    if size < sizes.GIB:
        return f"{size / MIB:.0f} MiB"
    return f"{size / sizes.GIB:.1f} GiB" if size < 10 * sizes.GIB else f"{size / sizes.GIB:.0f} GiB"


def pace(config: RunConfig) -> Iterator[Check]:
    """How far apart collecting and learning may run under this recipe, and how much it collects."""
    replay, trainer = config.replay, config.trainer
    in_flight = config.rollout.in_flight
    bound, of_pace = lag_limits(config)
    text = f"at most {bound} updates with {in_flight} decisions under way"
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
    if actions := int(config.policy.n_action_steps or of_sft):
        text += f", at most {collected * actions:,} env steps"
    yield Check("work", OK, text)


def _resolve(arguments: list[str]) -> tuple[RunConfig | None, int, list[Check]]:
    from accerl_lerobot.engine.config import RunConfig, parse
    from accerl_lerobot.engine.preflight import check_start

    try:
        config: RunConfig = parse(RunConfig, arguments)
        _, history = check_start(config)
    except InputError as error:
        return None, 1, [Check("recipe", FAIL, str(error))]
    return config, history, [Check("recipe", OK, "resolves")]
