# SPDX-License-Identifier: Apache-2.0
"""Every policy type gets better by reinforcement, from random weights, in one process.

π0.5 and π0-FAST get their state as text, which random weights cannot read: they learn to stay near the
middle, so their return rises and not their success.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from accerl_lerobot.algorithms import GIPOConfig
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.engines import Engine
from accerl_lerobot.engines.local import LocalEngine
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.evaluation import evaluation_plans
from accerl_lerobot.policies.config import (
    DiffusionSamplerConfig,
    FlowSamplerConfig,
    GaussianSamplerConfig,
    PolicyConfig,
    SamplerConfig,
)
from accerl_lerobot.replay.buffer import ReplayConfig
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.testing import TOLERANCE
from tests.policies.cases import CASES, DDIM
from tests.policies.checkpoints import write_act, write_bins, write_diffusion, write_smolvla
from tests.policies.tiny_pi import write_pi
from tests.runs import collect, drive, tiny_run

ENV = SimulatedConfig(max_steps=8, tolerance=0.3, reward="dense")


def write_diffusion_that_looks_back(path: Path) -> Path:
    sizes = {"observation.state": 4, "action": 2}
    stats = {key: {"min": -torch.ones(n), "max": torch.ones(n)} for key, n in sizes.items()}
    steps = DDIM | {"num_inference_steps": 2}
    return write_diffusion(path, image=8, n_obs_steps=2, executed=4, stats=stats, **steps)


@dataclass(frozen=True, kw_only=True)
class Run:
    """How one type learns, and what it must have learned at least."""

    write: Callable[[Path], Path]
    updates: int
    lr: float
    batch: int = 128
    value_lr: float = 3e-3
    capacity: int = 1024
    least: int = 128  # decisions before the first update
    sampler: SamplerConfig | None = None
    env: SimulatedConfig = ENV
    entropy_coef: float = 0.0
    history: int = 1
    success: tuple[float, float] = (1.0, 0.0)  # largest before and least after
    gain: float = 0.0  # least rise of the return of an episode that does not explore


PI: dict[str, Any] = {"value_lr": 5e-3, "capacity": 512, "least": 64}
SMALL: dict[str, Any] = {"env": replace(ENV, image_size=8), "updates": 40, "batch": 96, "least": 96}
RUNS = {
    "smolvla": Run(
        write=write_smolvla,
        sampler=FlowSamplerConfig(noise_level=0.6),
        updates=100, lr=2e-3, success=(0.5, 0.8),
    ),
    "pi0": Run(
        write=lambda path: write_pi(path, "pi0", prompt=12, num_steps=2),
        sampler=FlowSamplerConfig(noise_level=0.6),
        updates=50, lr=5e-3, **PI, success=(0.4, 0.7), gain=2.0,
    ),
    "pi05": Run(
        write=lambda path: write_pi(path, "pi05", prompt=40, num_steps=1),
        sampler=FlowSamplerConfig(noise_level=0.6),
        updates=50, batch=64, lr=3e-3, **PI, gain=0.4,
    ),
    "pi0_fast": Run(
        write=lambda path: write_pi(path, "pi0_fast", prompt=40, num_steps=5),
        updates=40, lr=3e-3, **PI, gain=0.7,
    ),
    "smolvla_bins": Run(
        write=lambda path: write_bins(path, chunk=2, executed=2, num_bins=16),
        env=replace(ENV, max_steps=4, hold=2),
        entropy_coef=0.03,  # without it 13% become 11%
        updates=80, batch=256, lr=4e-3, success=(0.25, 0.5),
    ),
    "act": Run(
        write=lambda path: write_act(path, image=8, chunk=4, executed=4),
        sampler=GaussianSamplerConfig(std=0.4), **SMALL, lr=1e-3, success=(0.4, 0.6),
    ),
    "diffusion": Run(
        write=write_diffusion_that_looks_back,
        sampler=DiffusionSamplerConfig(std_min=0.3), history=2,
        **SMALL, lr=1e-3, success=(0.4, 0.5),
    ),
}  # fmt: skip


def played(engine: Engine, episodes: int = 128) -> tuple[float, float]:
    """Mean success and return of episodes that do not explore."""
    engine.plan(evaluation_plans(("match",), episodes, "test"))
    results = collect(engine, "test", episodes)
    return np.mean([r.success for r in results]), np.mean([r.episode_return for r in results])


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name == "act" else pytest.mark.slow) for name in CASES]
)
def test_a_random_policy_gets_better(name: str, tmp_path: Path):
    run = RUNS[name]
    path = run.write(tmp_path / "policy")
    config: Any = tiny_run(
        path,
        env=run.env,
        policy=PolicyConfig(path=str(path), device="cpu", sampler=run.sampler),
        rollout=RolloutConfig(environments=32, segment_length=8),
        replay=ReplayConfig(
            capacity=run.capacity,
            min_decisions=run.least,
            max_unlearned_decisions=2 * run.least,
            samples_per_insert=2.0,
        ),
        algorithm=GIPOConfig(gamma=0.5, entropy_coef=run.entropy_coef),
        trainer=TrainerConfig(
            updates=run.updates, batch_decisions=run.batch, lr=run.lr, value_lr=run.value_lr,
            warmup_updates=3, value_warmup_updates=5,
        ),
    )  # fmt: skip
    engine = LocalEngine(config, ("match",), history=run.history)
    before, return_before = played(engine)
    engine.train()
    updates = [u for progress in drive(engine) for u in progress.updates]
    after, return_after = played(engine)
    engine.close()
    most, least = run.success
    assert before <= most and after >= least, f"{before:.0%} → {after:.0%}"
    assert return_after > return_before + run.gain, f"{return_before:.2f} → {return_after:.2f}"
    assert updates[0]["ratio_max_dev"] <= TOLERANCE
