# SPDX-License-Identifier: Apache-2.0
"""The types that cross processes.

Shape letters: T decisions of a segment, K actions per chunk, A action dims, L log-prob factors of a decision.
NumPy only: a rollout worker that imports this file stays free of torch and LeRobot.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from accerl_lerobot.checkpoint.snapshot import kind

Observation = dict[str, np.ndarray | str]
"""One observation under LeRobot's feature names.

``observation.images.<camera>`` uint8 (H, W, 3), ``observation.state`` float32 (S,), ``task`` the instruction
text, ``observation.environment_state`` float32 (E,) where the environment offers it and is asked to. Values
are raw: scaling and normalisation belong to the policy's own LeRobot processors. Where a policy looks back
(LeRobot's ``n_obs_steps`` above 1), arrays hold so many env steps, oldest first, in a dimension in front.
"""

Observations = dict[str, np.ndarray]
"""A batch of observations, arrays (B, ...) by the names of an `Observation`; the instructions are apart."""

Tensors = dict[str, np.ndarray]
"""Weights of the policy by the names of its parameters; dtype and shape arrive as they were sent."""

Metrics = dict[str, float]
"""Numbers for the log, by name; docs/metrics.md explains them."""

TASK = "task"
ENVIRONMENT_STATE = "observation.environment_state"
"""LeRobot's name for what a simulator says of itself. Ours end it with the share of the time limit gone."""
REWARD, SUCCESS = "next.reward", "next.success"  # LeRobot's names for what an env step led to
TASK_BITS = 16  # numbers that stand for a task in `task_codes`
REAL, IMAGINED = "real", "imagined"  # which environments a segment can be from


@kind
@dataclass(frozen=True, kw_only=True)
class Request:
    """One observation that waits for a decision.

    `noise_seed` fixes all randomness of the decision, so that it does not depend on which batch it lands in.
    """

    observation: Observation
    noise_seed: int
    elapsed: float = 0.0  # share of the episode's time limit that is gone
    explore: bool = True  # False asks for LeRobot's stock sampler, the one evaluation uses
    task: str = ""  # the environment's name of the task; two tasks may have one instruction


@kind
@dataclass(frozen=True, kw_only=True)
class Decision:
    """The result of one policy call."""

    chunk: np.ndarray  # float32 (K, A), in the environment's action units (un-normalised); not clipped
    latent: dict[str, np.ndarray]  # what the policy sampled; `log_prob` is its density in normalised units
    log_prob: np.ndarray  # float32 (L,), an entry per factor, such as a row; the chunk's is their sum
    version: int  # of the weights that decided: the number of updates that made them


@kind
class SegmentStart(NamedTuple):
    """Where in which episode something begins."""

    task: str  # task of `Environment.reset`, which is not the instruction
    seed: int  # seed of `Environment.reset`
    decision: int  # decisions made before


@kind
@dataclass(kw_only=True)
class Segment:
    """T consecutive decisions of one episode, plus the observation after the last one.

    It ends because the episode `terminated`, by its time limit too (bootstrap 0), or is cut in mid-episode
    (bootstrap with V of the last observation).
    """

    observations: dict[str, np.ndarray]
    """Each (T + 1, ...) under LeRobot's names, without the task; the last row is the bootstrap observation,
    or what was seen when the episode terminated, which nothing is bootstrapped from."""
    task: str
    latent: dict[str, np.ndarray]  # each (T, ...)
    log_prob: np.ndarray  # float32 (T, L), of the behaviour policy
    actions: np.ndarray  # float32 (T, K, A), within bounds; the first `steps` rows of each were executed
    reward: np.ndarray  # float32 (T,), summed over the steps of each chunk
    version: np.ndarray  # int64 (T,), the weights behind each decision
    steps: np.ndarray  # int64 (T,), env steps each decision executed
    time_limit: int  # env steps of an episode at most
    before: int = 0  # env steps of the episode before the first of these decisions
    terminated: bool
    success: bool  # True if the episode had succeeded when the segment ended
    key: str  # worker, incarnation, sequence number
    source: str = REAL  # ``real`` or ``imagined``
    origin: SegmentStart  # where it begins; of an imagined one, task and seed of its plan

    def __len__(self) -> int:
        return len(self.reward)

    @property
    def elapsed(self) -> np.ndarray:
        """float32 (T,), share of the episode's time limit that was gone at each decision."""
        ends = self.before + np.cumsum(self.steps)
        return ((ends - self.steps) / self.time_limit).astype(np.float32)


def stacked(rows: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """Observations or latents as a batch: one array (B, ...) for each name but `TASK`."""
    arrays = {}
    for name in rows[0]:
        if name != TASK:
            arrays[name] = np.stack([row[name] for row in rows])
    return arrays


def stack_observations(requests: Sequence[Request]) -> tuple[Observations, list[str]]:
    """Batches raw observations: each array (B, ...), and the B task texts."""
    observations = [request.observation for request in requests]
    return stacked(observations), [str(observation[TASK]) for observation in observations]


def nonfinite(arrays: Mapping[str, Any]) -> str:
    """The first name whose numbers are not finite; empty: there is none. Texts and integers are."""
    for name, value in arrays.items():
        if not isinstance(value, np.ndarray) or value.dtype.kind != "f":
            continue
        if not np.isfinite(value).all():
            return name
    return ""


def task_codes(tasks: Sequence[str]) -> np.ndarray:
    """float32 (B, 16): ±1 for each of 16 bits of an instruction's hash, known without a list of all tasks."""
    digests = [hashlib.sha256(task.encode()).digest()[:TASK_BITS] for task in tasks]
    bits = np.frombuffer(b"".join(digests), np.uint8) & 1
    return np.where(bits, 1.0, -1.0).astype(np.float32).reshape(len(tasks), TASK_BITS)
