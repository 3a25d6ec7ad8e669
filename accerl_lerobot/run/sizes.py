# SPDX-License-Identifier: Apache-2.0
"""Memory of a run: rough estimates, and refusals of sizes that this machine cannot hold."""

from __future__ import annotations

import operator
from typing import TYPE_CHECKING, Any

from accerl_lerobot.config.machine import GIB, SIMULATOR_GIB, memory_gib
from accerl_lerobot.errors import InputError

if TYPE_CHECKING:
    from accerl_lerobot.engines.config import RunConfig

POLICY_PROCESS_GIB, ROLLOUT_PROCESS_GIB = 1.2, 0.4
"""Resident memory without a policy's weights: a process with torch and LeRobot, and a rollout process without
its environments."""
ABSURD = 2  # times this machine's memory that a rough estimate may be; ``accerl doctor`` warns long before


def check_memory(config: RunConfig) -> None:
    """Refuse sizes far beyond this machine, and weights that it cannot hold; a cluster may have more."""
    if config.launch.address is not None:
        return
    total = memory_gib("MemTotal")
    parts = memory_parts_gib(config)
    needed = sum(parts.values())
    largest = max(parts, key=lambda name: parts[name])
    if needed > ABSURD * total:
        hint = f"the run needs about {needed:,.0f} GiB of memory, this machine has {total:.0f}; lower it"
        value = operator.attrgetter(largest)(config)
        raise InputError(largest, value, hint)
    weights = policy_gib(config)
    if weights > total:
        hint = (
            f"its weights take {weights:.1f} GiB in the processes of this run, this machine has {total:.1f}; "
        )
        hint += "use a smaller policy, a GPU, launch.engine=local or policy.tuning.mode=lora"
        raise InputError("policy.path", config.policy.path, hint)


def memory_parts_gib(config: RunConfig, history: int = 1) -> dict[str, float]:
    """Field → rough memory of what it sizes, without a policy's weights."""
    rollout = config.rollout
    tasks = len(getattr(config.env, "tasks", ("one",)))
    # The environments of a process share its simulators.
    simulators = min(rollout.environments * tasks, tasks + 2 * rollout.environments)
    simulator = SIMULATOR_GIB.get(config.env.type, 0.0)
    pictures = history * observation_bytes(config) / GIB
    processes = POLICY_PROCESS_GIB
    if config.launch.engine == "ray":  # the driver, and workers
        loaded = 1 + config.trainer.ranks + config.inference.workers
        processes = loaded * POLICY_PROCESS_GIB + rollout.workers * ROLLOUT_PROCESS_GIB
    return {
        "rollout.workers": processes,
        "rollout.environments": rollout.workers * simulators * simulator,
        "rollout.segment_length": rollout.in_flight * pictures,
        "replay.capacity": config.replay.capacity * pictures,
        "algorithm.memory": config.remembered * pictures,
    }


def observation_bytes(config: RunConfig) -> int:
    """Bytes of one env step's images; what else a decision holds is small beside them."""
    env: Any = config.env
    side = getattr(env, "image_size", 96)  # LeRobot's own environments differ; PushT's have 96 pixels
    cameras = len(getattr(env, "cameras", ("one",)))
    return 3 * side * side * cameras


def policy_gib(config: RunConfig) -> float:
    """Memory that the weights of ``policy.path`` take in all processes of a run; activations come on top.

    On a GPU they are not in the machine's memory. Nothing is known of a policy that an SFT will make.
    """
    from accerl_lerobot.policies.loading import policy_sizes, resolve_device

    if config.policy.path is None or resolve_device(config.policy.device).type != "cpu":
        return 0.0
    sizes = policy_sizes(config.policy)
    processes = 1
    copies = trained_copies(config)
    if config.launch.engine == "ray":
        processes = config.trainer.ranks + config.inference.workers
        copies += 2 * config.inference.workers  # sets under way
    numbers = sizes.policy * processes + sizes.trained * copies
    return 4 * numbers / GIB


def trained_copies(config: RunConfig) -> int:
    """Copies of the trained weights that a trainer keeps: gradient, Adam's two moments, weights to probe."""
    return 3 + int(config.trainer.probe_every > 0)
