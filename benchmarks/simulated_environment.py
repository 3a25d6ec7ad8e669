# SPDX-License-Identifier: Apache-2.0
"""The simulated environment with latency that is slept, and with faults on request.

Importing this module registers ``env.type=simulated_latency``.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np

from accerl_lerobot.config.ranges import NonNegative, Range, Steps
from accerl_lerobot.envs import ChunkResult, EnvConfig, SimulatedConfig
from accerl_lerobot.envs.simulated import SimulatedEnvironment
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Observation
from benchmarks.latency import RESET


@EnvConfig.register_subclass("simulated_latency")
@dataclass(frozen=True, kw_only=True)
class LatencyConfig(SimulatedConfig):
    """How slow, how broken.

    Example:
        >>> LatencyConfig(task="match", frame_ms=6.0, latency_cv=0.5)
    """

    environment = "benchmarks.simulated_environment:LatencyEnvironment"

    frame_ms: NonNegative = 0.0
    """Mean time from a decision to its observation, in milliseconds; slept, so it costs no processor."""
    latency_cv: Annotated[float, Range("[0, 10]")] = 0.0
    """Standard deviation over mean of its lognormal law, drawn from the episode's seed; 0: constant."""
    latency_trace: str | None = None
    """File that the benchmark `latency` has written of another environment, scaled so that its decisions take
    `frame_ms` on average: an episode takes a stretch of it, from a moment drawn from its seed. What a reset
    takes is drawn from what resets took there."""
    crash_after: Steps = 0
    """Env steps of this instance after which it raises; 0 for never."""
    nan_after: Steps = 0
    """Env steps of this instance after which one state is NaN and its episode ends; 0 for never."""


class LatencyEnvironment(SimulatedEnvironment):
    """One instance; `crash_after` and `nan_after` count over all its episodes."""

    config: LatencyConfig

    def __init__(self, config: LatencyConfig) -> None:
        super().__init__(config)
        path = config.latency_trace
        self._trace = None if path is None else read_trace(path, "env.latency_trace")
        self._clock = np.random.default_rng(0)
        self._at = 0
        self._lifetime = 0

    def reset(self, seed: int, task: str) -> Observation:
        """See the base class."""
        observation = super().reset(seed, task)
        self._clock = np.random.default_rng((seed, 1))
        if self._trace is not None:
            self._at = int(self._clock.integers(len(self._trace.decisions)))
        if self._trace is not None and len(self._trace.resets):
            _wait(self.config.frame_ms / 1000 * float(self._clock.choice(self._trace.resets)))
        else:
            _wait(self._delay())
        return observation

    def step_chunk(self, actions: np.ndarray) -> ChunkResult:
        """See the base class."""
        crash, nan = (after - self._lifetime for after in (self.config.crash_after, self.config.nan_after))
        if 0 < nan <= len(actions):
            actions = actions[:nan]
        result = super().step_chunk(actions)
        self._lifetime += result.steps
        if 0 < crash <= result.steps:
            raise RuntimeError(f"simulated crash after {self.config.crash_after} env steps")
        if result.steps == nan:
            state = np.full(self.spec.state_dim, np.nan, np.float32)
            result = replace(
                result,
                observation={**result.observation, "observation.state": state},
                terminated=False,
                truncated=True,
                finite=False,
            )
            self._done = True
        _wait(self._delay())
        return result

    def _delay(self) -> float:
        """Seconds, drawn anew for each observation."""
        mean, cv = self.config.frame_ms / 1000, self.config.latency_cv
        if self._trace is not None:
            self._at = (self._at + 1) % len(self._trace.decisions)
            return mean * float(self._trace.decisions[self._at])
        variance = math.log1p(cv**2)
        return mean * math.exp(self._clock.normal(-variance / 2, math.sqrt(variance))) if cv else mean


class Trace(NamedTuple):
    """How long an environment has taken, in units of its mean decision."""

    decisions: np.ndarray
    """float64 (T,), one after the other, of mean 1."""
    resets: np.ndarray
    """float64 (R,); there may be none."""


def read_trace(path: str, field: str = "latency_trace") -> Trace:
    """A text file with a duration on each line, in any unit, of a decision or after ``reset`` of a reset;
    what follows a ``#`` is for people. `field` is where it is named, for an error."""
    try:
        text = Path(path).expanduser().read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(field, path, f"it cannot be read ({error}); use a text file") from None
    found: dict[bool, list[float]] = {True: [], False: []}
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        try:
            value = float(words[-1]) if words[:-1] in ([], [RESET]) else math.nan
        except ValueError:
            value = math.nan
        if not 0 <= value < math.inf:
            hint = f"line {number}, {line.strip()!r}, is no duration; use a number, or {RESET} and a number"
            raise InputError(field, path, hint)
        found[len(words) > 1].append(value)
    if not sum(found[False]) > 0:
        raise InputError(field, path, "no time passes in it; write one duration on each line")
    mean = float(np.mean(found[False]))
    return Trace(np.asarray(found[False]) / mean, np.asarray(found[True]) / mean)


def _wait(delay: float) -> None:
    if delay > 0:
        time.sleep(delay)
