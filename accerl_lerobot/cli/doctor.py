# SPDX-License-Identifier: Apache-2.0
"""``accerl doctor``: checks a recipe against this machine; every failure comes with its remedy.

A frame is really drawn, in a process of its own, because a broken OpenGL can take a process down.
"""

from __future__ import annotations

import contextlib
import importlib.metadata
import importlib.util
import math
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from accerl_lerobot.checkpoint.safety import MIB, brief
from accerl_lerobot.errors import InputError, expanded

if TYPE_CHECKING:
    from accerl_lerobot.engine.config import RunConfig

OK, WARN, FAIL = "ok", "warn", "FAIL"
RESOLVED = "--resolved="
DISTRIBUTION = "accerl-lerobot"
SIMULATOR_EXTRAS = ("metaworld", "libero", "pusht")

GIB = 2**30
POLICY_PROCESS_GIB, ROLLOUT_PROCESS_GIB, RAY_GIB = 1.2, 0.4, 0.7
SIMULATOR_GIB = {"metaworld": 0.17, "libero": 0.17}
"""Resident memory without a policy's weights, for which see `preflight.policy_gib`: a process with torch and
LeRobot, a rollout process without its worlds, Ray's own processes, and, by type of environment, the simulator
of one task with its renderers."""
DISK_GIB = 2.0
"""Space that demonstrations, checkpoints and videos of a run may need."""
RENDER_TIMEOUT_S = 120
USABLE = 0.8
"""Share of a device's memory that an estimate may fill. SmolVLA's backward pass took 1.19 times its estimate
on a CPU, for gradients under way and fragmentation; on a GPU CUDA's libraries need their part too."""

DRAW = """
import time
from accerl_lerobot.envs.metaworld import import_mujoco, new_renderer
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


@dataclass(frozen=True)
class Check:
    """One result."""

    name: str
    status: str
    """ok, warn or FAIL; only the last makes the exit code 1."""
    text: str
    """The finding and, unless it is fine, the remedy."""


def main(arguments: list[str]) -> int:
    """``accerl doctor``; 0 if everything needed is there, otherwise 1.

    ``--resolved=FILE`` also writes the whole config to which the recipe resolves.
    """
    files = [argument.removeprefix(RESOLVED) for argument in arguments if argument.startswith(RESOLVED)]
    arguments = [argument for argument in arguments if not argument.startswith(RESOLVED)]
    config, history, checks = _resolve(arguments) if arguments else (None, 1, [])
    checks += [*pulled(arguments), *machine(config, history)]
    if config is not None:
        checks += [*pace(config), *imagination_checks(config), *placement(config), *policy_fits(config)]
    for check in checks:
        sys.stdout.write(f"{check.status:5} {check.name:10} {check.text}\n")
    failed = sum(check.status == FAIL for check in checks)
    sys.stdout.write(f"\n{'all good' if not failed else f'{failed} of {len(checks)} checks failed'}\n")
    if config is not None and files:
        from accerl_lerobot.engine.config import encode

        path = expanded(files[-1], RESOLVED.strip("-="))
        try:
            path.write_text(yaml.safe_dump(encode(config), sort_keys=False, allow_unicode=True))
        except OSError as error:
            remedy = f"cannot be written: {error.strerror}; name another file"
            raise InputError(RESOLVED.strip("-="), str(path), remedy) from error
    return 1 if failed else 0


def machine(config: RunConfig | None, history: int = 1) -> Iterator[Check]:
    """Checks that any run needs, and those of `config`; `history` is the policy's ``n_obs_steps``."""
    yield Check("python", OK, f"{platform.python_version()} in {sys.prefix}")
    yield packages()
    yield hugging_face_datasets()
    yield ray_imports(joins=config is not None and config.launch.address is not None)
    yield cuda(config)
    yield rendering(needed=config is None or config.env.type in SIMULATOR_GIB)
    yield from resources(config, history)


def packages() -> Check:
    """Installed versions against the ranges of this package's requirements."""
    from packaging.requirements import Requirement

    try:
        wanted = [Requirement(text) for text in importlib.metadata.requires(DISTRIBUTION) or []]
    except importlib.metadata.PackageNotFoundError:
        return Check("packages", FAIL, f"{DISTRIBUTION} is not installed: run make setup")
    count, differing = 0, []
    needed, optional = set[str](), set[str]()
    for requirement in wanted:
        marker = requirement.marker
        extra = marker is not None and not marker.evaluate({"extra": ""})
        if marker and extra and not any(marker.evaluate({"extra": name}) for name in SIMULATOR_EXTRAS):
            continue  # for development
        try:
            installed = importlib.metadata.version(requirement.name)
        except importlib.metadata.PackageNotFoundError:
            (optional if extra else needed).add(requirement.name)
            continue
        count += 1
        if not requirement.specifier.contains(installed, prereleases=True):
            differing.append(f"{requirement.name} {installed}, not {requirement.specifier}")
    if needed:
        return Check("packages", FAIL, f"not installed: {', '.join(sorted(needed))}; run make setup")
    if differing:
        return Check("packages", WARN, f"{'; '.join(differing)}: not tested; run make setup")
    text = f"{count} within their ranges, lerobot {importlib.metadata.version('lerobot')} among them"
    if optional:
        text += f"; without the extras' {', '.join(sorted(optional))}"
    return Check("packages", OK, text)


def hugging_face_datasets() -> Check:
    """A folder named ``datasets`` stands in for a package that is absent, and one with a file shadows it."""
    spec = importlib.util.find_spec("datasets")
    if spec is None or spec.origin is None:
        text = "Hugging Face datasets is not installed, or a folder hides it; run make setup"
        return Check("datasets", FAIL, text)
    distribution = importlib.metadata.distribution("datasets")
    if Path(spec.origin).resolve().parent != Path(str(distribution.locate_file("datasets"))).resolve():
        return Check("datasets", FAIL, f"{spec.origin} shadows Hugging Face datasets: remove or rename it")
    return Check("datasets", OK, f"Hugging Face datasets {distribution.version}")


def ray_imports(joins: bool = False) -> Check:
    """Ray, with the environment a run would give it."""
    from accerl_lerobot.engine import ray_session

    ray_session.prepare(joins)
    try:
        import ray
    except Exception as error:
        return Check("ray", FAIL, f"cannot be imported ({brief(error)}); run make setup")
    return Check("ray", OK, ray.__version__)


def cuda(config: RunConfig | None) -> Check:
    """GPUs that torch sees, and whether the recipe insists on one."""
    wish = config.policy.device if config is not None else "auto"
    try:
        import torch
    except Exception as error:
        return Check("torch", FAIL, f"cannot be imported ({brief(error)}); run make setup")
    if torch.cuda.is_available():
        gpus = f"{torch.cuda.device_count()} × {torch.cuda.get_device_name(0)}"
        return Check("torch", OK, f"{torch.__version__}, {gpus}")
    text = f"{torch.__version__}, no CUDA device"
    if wish.startswith("cuda"):
        return Check("torch", FAIL, f"{text}: policy.device={wish!r} cannot be had; use auto or cpu")
    return Check("torch", OK, f"{text}; policies run on the CPU")


def rendering(*, needed: bool, script: str = DRAW) -> Check:
    """Draws a frame in a process of its own; if it is not `needed`, a failure is only a warning."""
    from accerl_lerobot.envs.metaworld import choose_backend

    bad = FAIL if needed else WARN
    if importlib.util.find_spec("mujoco") is None:
        text = "MuJoCo is not installed; install the extra: accerl-lerobot[metaworld] or [libero]"
        return Check("rendering", bad, text)
    command = [sys.executable, "-c", script]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=RENDER_TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        text = f"no frame within {RENDER_TIMEOUT_S} s; set MUJOCO_GL to osmesa or egl"
        return Check("rendering", bad, text)
    words = done.stdout.split()
    if done.returncode == 0 and words[:2] == ["drawn", "True"]:
        backend = os.environ.get("MUJOCO_GL") or choose_backend() or "the display"
        return Check("rendering", OK, f"MuJoCo draws 64 × 64 pixels in {words[2]} ms ({backend})")
    if done.returncode == 0:
        return Check("rendering", bad, "MuJoCo draws an empty picture; set MUJOCO_GL to osmesa or egl")
    last = (done.stderr.strip().splitlines() or [f"ended with code {done.returncode}"])[-1]
    return Check("rendering", bad, last.removeprefix("accerl_lerobot.errors.InputError: "))


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
    free = _memory_gib()
    if free is not None:
        text, status = f"{free:.1f} GiB free", OK
        if config is not None:
            need = memory_estimate_gib(config, history)
            text += f", about {need:.1f} GiB needed"
            if need > free:
                remedy = "lower rollout.workers, rollout.worlds or replay.capacity, or use a smaller policy"
                status, text = WARN, f"{text}: {remedy}"
        yield Check("memory", status, text)
    disk = shutil.disk_usage(Path.cwd()).free / GIB
    short = disk < DISK_GIB
    text = f"{disk:.0f} GiB free here" + (f"; a run may need {DISK_GIB:.0f}" if short else "")
    yield Check("disk", WARN if short else OK, text)


def imagination_checks(config: RunConfig) -> Iterator[Check]:
    """Imagination settings against the environment and the policy."""
    imagination = config.imagination
    if not imagination.share:
        return
    from accerl_lerobot.engine.imagination import check_imagination

    try:
        check_imagination(config)
    except InputError as error:
        yield Check("imagination", FAIL, str(error))
        return
    text = f"{imagination.share:.0%} of every batch; world model: {imagination.model}"
    yield Check("imagination", OK, text)


def placement(config: RunConfig) -> Iterator[Check]:
    """Where each worker would run; the cluster is asked if one is to be joined."""
    from accerl_lerobot.engine.preflight import check_placement

    try:
        yield from [Check("placement", OK, row) for row in check_placement(config)]
    except InputError as error:
        yield Check("placement", FAIL, str(error))


def policy_fits(config: RunConfig) -> Iterator[Check]:
    """The memory of a given policy where it learns and acts, against that of its device."""
    from accerl_lerobot.algorithms import RatioConfig
    from accerl_lerobot.engine.preflight import trained_copies
    from accerl_lerobot.policies.loading import rehearsed, resolve_device
    from accerl_lerobot.trainer.footprint import PolicyMemory, policy_memory
    from accerl_lerobot.trainer.off_policy import POLICY_BATCH

    if config.policy.path is None or not config.trainer.updates:
        return
    trainer, ratio = config.trainer, isinstance(config.algorithm, RatioConfig)
    try:
        device = resolve_device(config.policy.device)
        measure = partial(policy_memory, imitates=not ratio, checkpointing=trainer.activation_checkpointing)
        memory = PolicyMemory(*rehearsed(config.policy, measure))
    except InputError as error:
        yield Check("policy", FAIL, str(error))
        return
    batch = math.ceil(trainer.batch_decisions / trainer.ranks) if ratio else POLICY_BATCH
    decisions = min(batch, trainer.micro_batch)
    kept = memory.trainer(0, trained_copies(config)) / (trainer.ranks if trainer.zero else 1)
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
    remedy = f"use --trainer.micro_batch={fitting}" if fitting > 0 else "use policy.tuning.mode=lora"
    if not trainer.activation_checkpointing:
        remedy += ", or --trainer.activation_checkpointing=true"
    yield Check("policy", WARN, f"{text}: {remedy}")


def _device_memory(config: RunConfig, device: Any) -> tuple[float, int, str]:
    """Bytes that a rank and the inference replicas beside it may take, how many these are, and of what."""
    import torch

    others = config.inference.workers if config.launch.engine != "local" else 0
    if device.type == "cpu":
        rest = sum(memory_parts_gib(config).values())
        return USABLE * ((_memory_gib() or math.inf) - rest) * GIB, others, "this machine"
    gpus = torch.cuda.device_count()
    rank, other = config.trainer.gpu_shares(gpus, others)
    beside = int((1 - rank) / other + 1e-6) if other else 0
    smallest = min(torch.cuda.get_device_properties(i).total_memory for i in range(gpus))
    return USABLE * smallest, min(others, beside), "a GPU"


def _gib(size: float) -> str:
    if size < GIB:
        return f"{size / MIB:.0f} MiB"
    return f"{size / GIB:.1f} GiB" if size < 10 * GIB else f"{size / GIB:.0f} GiB"


def memory_estimate_gib(config: RunConfig, history: int = 1) -> float:
    """Rough: processes with their libraries, the policy's weights, simulators, replay and films."""
    from accerl_lerobot.engine.preflight import policy_gib

    return policy_gib(config) + sum(memory_parts_gib(config, history).values())


def memory_parts_gib(config: RunConfig, history: int = 1) -> dict[str, float]:
    """Field → rough memory of what it sizes."""
    from accerl_lerobot.engine.preflight import under_way
    from accerl_lerobot.evaluation import FILM

    rollout, films, local = config.rollout, config.evaluation, config.launch.engine == "local"
    tasks = len(getattr(config.env, "tasks", ("one",)))
    simulator = tasks * SIMULATOR_GIB.get(config.env.type, 0.0)
    pictures = history * observation_bytes(config) / GIB
    loaded = 2 + config.trainer.ranks  # the driver, inference and the trainer each load torch
    frames = min(films.videos, films.episodes) * config.env.max_steps / FILM[1]
    return {
        "trainer.ranks": POLICY_PROCESS_GIB if local else RAY_GIB + loaded * POLICY_PROCESS_GIB,
        "inference.workers": 0.0 if local else (config.inference.workers - 1) * POLICY_PROCESS_GIB,
        "rollout.workers": 0.0 if local else rollout.workers * ROLLOUT_PROCESS_GIB,
        "rollout.worlds": rollout.workers * rollout.worlds * simulator,
        "rollout.segment_length": under_way(config) * pictures,
        "replay.capacity": config.replay.capacity * pictures,
        **({"algorithm.memory": config.remembered * pictures} if config.remembered else {}),
        "evaluation.videos": frames * 3 * FILM[0] ** 2 / GIB,
    }


def observation_bytes(config: RunConfig) -> int:
    """Bytes of one env step's images; what else a decision holds is small beside them."""
    env: Any = config.env
    side = getattr(env, "image_size", 96)  # LeRobot's own environments differ; PushT's have 96 pixels
    return 3 * side * side * len(getattr(env, "cameras", ("one",)))


def pace(config: RunConfig) -> Iterator[Check]:
    """How far apart collecting and learning may run under this recipe, and how much it collects."""
    from accerl_lerobot.engine.preflight import executed, lag_limits, under_way

    replay, trainer = config.replay, config.trainer
    in_flight = under_way(config)
    bound, of_pace = lag_limits(config)
    text = f"at most {bound} updates with {in_flight} decisions under way"
    if of_pace > bound:
        text += (
            f"; the pace alone allows {of_pace}, so segments may be thrown away as too old: "
            "lower replay.capacity, replay.ahead or replay.samples_per_insert, or raise replay.max_lag"
        )
    yield Check("lag", WARN if of_pace > bound else OK, text)
    collected = math.ceil(trainer.updates * trainer.batch_decisions / replay.samples_per_insert)
    text = f"{trainer.updates:,} updates of {trainer.batch_decisions} on about {collected:,} decisions"
    if actions := executed(config):
        text += f", at most {collected * actions:,} env steps"
    yield Check("work", OK, text)


def _resolve(arguments: list[str]) -> tuple[RunConfig | None, int, list[Check]]:
    from accerl_lerobot.engine.config import RunConfig, parse
    from accerl_lerobot.engine.preflight import check_start

    try:
        config: RunConfig = parse(RunConfig, arguments)
        history = check_start(config)
    except InputError as error:
        return None, 1, [Check("recipe", FAIL, str(error))]
    return config, history, [Check("recipe", OK, "resolves")]


def pulled(arguments: list[str]) -> Iterator[Check]:
    """The fields that `pull` has dropped from the recipe."""
    from accerl_lerobot.config.parsing import read_arguments
    from accerl_lerobot.hub.card import RECORD, read_json

    with contextlib.suppress(InputError):
        recipe = read_arguments(arguments)[0]
        for folder in recipe.absolute().parents if recipe is not None else ():
            dropped = read_json(folder / RECORD).get("dropped")
            name = Path(os.path.relpath(str(recipe), folder)).as_posix()
            fields = dropped.get(name) if isinstance(dropped, dict) else None
            if isinstance(fields, dict) and fields:
                names = ", ".join(map(ascii, fields))
                text = f"without {names}, which let code run: add them if you trust it"
                yield Check("pulled", WARN, text)


def total_memory_gib() -> float | None:
    """Memory of this machine, or its container's limit; None where that is unknown."""
    return _memory_of("MemTotal", 0)


def _memory_gib() -> float | None:
    """Memory that can be had, within the container's limit; None where that is unknown."""
    return _memory_of("MemAvailable", 1)


def _memory_of(entry: str, used: int) -> float | None:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    entries = {line.split(":")[0]: int(line.split()[1]) * 1024 for line in lines}
    found = float(entries.get(entry, 0))
    group = Path("/sys/fs/cgroup")
    with contextlib.suppress(OSError, ValueError):  # no such file, or no limit
        limit, taken = (int((group / f"memory.{name}").read_text()) for name in ("max", "current"))
        found = min(found, limit - used * taken)
    return found / GIB
