# SPDX-License-Identifier: Apache-2.0
"""Memory of a run: rough estimates, and refusals of what this machine cannot hold."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from accerl_lerobot.algorithms import RatioConfig
from accerl_lerobot.config.machine import GIB, SIMULATOR_GIB, memory_gib
from accerl_lerobot.envs.gym_env import MAX_STEPS
from accerl_lerobot.errors import InputError

if TYPE_CHECKING:
    from accerl_lerobot.engines.config import RunConfig

POLICY_PROCESS_GIB, ROLLOUT_PROCESS_GIB, RAY_GIB = 1.2, 0.4, 0.7
"""Resident memory without a policy's weights, see `policy_gib`: a process with torch and LeRobot, a
rollout process without its environments, and Ray's own processes."""
ABSURD = 2  # times this machine's memory that a rough estimate may be; ``accerl doctor`` warns long before


def check_memory(config: RunConfig) -> None:
    """Refuse sizes far beyond this machine, and weights that it cannot hold; a cluster may have more."""
    total = memory_gib("MemTotal")
    if total is None or config.launch.address is not None:
        return
    parts = memory_parts_gib(config)
    needed, largest = sum(parts.values()), max(parts, key=lambda name: parts[name])
    if needed > ABSURD * total:
        hint = f"the run needs about {needed:,.0f} GiB of memory, this machine has {total:.0f}; lower it"
        section, _, name = largest.partition(".")
        raise InputError(largest, getattr(getattr(config, section), name), hint)
    if (need := policy_gib(config)) > total:
        text = f"its weights take {need:.1f} GiB in the processes of this run, this machine has {total:.1f}"
        hint = "use a smaller policy, a GPU, launch.engine=local or policy.tuning.mode=lora"
        raise InputError("policy.path", config.policy.path, f"{text}; {hint}")


def memory_parts_gib(config: RunConfig, history: int = 1) -> dict[str, float]:
    """Field → rough memory of what it sizes, without a policy's weights."""
    from accerl_lerobot.evaluation import FILM

    rollout, films, local = config.rollout, config.evaluation, config.launch.engine == "local"
    tasks = len(getattr(config.env, "tasks", ("one",)))
    simulators = min(
        rollout.environments * tasks, tasks + 2 * rollout.environments
    )  # as shared by a process's environments
    pictures = history * observation_bytes(config) / GIB
    loaded = 2 + config.trainer.ranks  # the driver, inference and the trainer each load torch
    imagination = config.imagination  # rollout processes load torch too, and one more process learns
    imagining = rollout.workers * (imagination.environments > 0) + imagination.learns
    longest = config.env.max_steps or MAX_STEPS
    frames = min(films.videos, films.episodes) * longest / FILM[1]
    return {
        "trainer.ranks": POLICY_PROCESS_GIB if local else RAY_GIB + loaded * POLICY_PROCESS_GIB,
        "inference.workers": 0.0 if local else (config.inference.workers - 1) * POLICY_PROCESS_GIB,
        "rollout.workers": 0.0 if local else rollout.workers * ROLLOUT_PROCESS_GIB,
        "rollout.environments": rollout.workers * simulators * SIMULATOR_GIB.get(config.env.type, 0.0),
        "rollout.segment_length": rollout.in_flight * pictures,
        "replay.capacity": config.replay.capacity * pictures,
        "algorithm.memory": config.remembered * pictures,
        "imagination.environments": 0.0 if local else imagining * POLICY_PROCESS_GIB,
        "evaluation.videos": frames * 3 * FILM[0] ** 2 / GIB,
    }


def observation_bytes(config: RunConfig) -> int:
    """Bytes of one env step's images; what else a decision holds is small beside them."""
    env: Any = config.env
    side = getattr(env, "image_size", 96)  # LeRobot's own environments differ; PushT's have 96 pixels
    return 3 * side * side * len(getattr(env, "cameras", ("one",)))


def policy_gib(config: RunConfig) -> float:
    """Memory that the weights of ``policy.path`` take in all processes of a run; activations come on top.

    On a GPU they are not in the machine's memory. Nothing is known of a policy that an SFT will make.
    """
    from accerl_lerobot.policies.loading import policy_sizes, resolve_device

    if config.policy.path is None or resolve_device(config.policy.device).type != "cpu":
        return 0.0
    sizes, processes, copies = policy_sizes(config.policy), 1, trained_copies(config)
    if config.launch.engine != "local":
        processes = config.trainer.ranks + config.inference.workers
        copies += 2 * config.inference.workers  # sets under way
    return 4 * (sizes.policy * processes + sizes.trained * copies) / GIB


def trained_copies(config: RunConfig) -> int:
    """Copies of the trained weights that a trainer keeps: gradient, Adam's two moments, weights to probe."""
    return 3 + (isinstance(config.algorithm, RatioConfig) and config.trainer.probe_every > 0)
