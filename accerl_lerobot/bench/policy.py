# SPDX-License-Identifier: Apache-2.0
"""Cost of a full-size policy here: memory, decisions, updates, and the rounding of its log-probs.

Weights are random, sizes those of the published checkpoint, inputs made up: nothing is downloaded. Decisions
are made, re-scored at equal weights, and learnt from, as inference and trainer do it.
"""

from __future__ import annotations

import platform
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from rich.table import Table

from accerl_lerobot.bench.measure import Memory, device_name, timed
from accerl_lerobot.config.ranges import Choice, Device, Range, Repeats, Section
from accerl_lerobot.policies.config import TuningConfig

STATE_DIM, ACTION_DIM, TOKENS = 8, 7, 48
"""LIBERO's sizes: end-effector state, end-effector action; length of a padded instruction."""


@dataclass(frozen=True, kw_only=True)
class BenchPolicyConfig(Section):
    """Fields of ``accerl bench policy``."""

    type: Annotated[str, Choice(BUILDERS)] = "smolvla"
    """smolvla, pi0 or pi05."""
    cameras: Annotated[int, Range("[1, 64]")] = 2
    """Pictures in an observation."""
    batch: Annotated[int, Range("[1, 65536]")] = 8
    """Decisions made at once, and learnt from at once."""
    num_steps: Annotated[int, Range("[1, 10000]")] | None = None
    """Denoising steps; None: the published 10."""
    stochastic: Literal["last", "all", "one"] = "last"
    """Which denoising steps are random; see ``policy.sampler.stochastic``."""
    precision: Literal["fp32", "bf16"] = "fp32"
    """fp32 or bf16; see ``policy.precision``."""
    tuning: TuningConfig = field(default_factory=lambda: TuningConfig(mode="expert"))
    device: Device = "auto"
    """cpu, cuda, or auto."""
    repeats: Repeats = 3
    """Times each part is measured after a first one that does not count."""


def bench_policy(config: BenchPolicyConfig) -> dict[str, Any]:
    """Builds, decides, re-scores and updates.

    Returns:
        ``parameters`` (all, trained), ``seconds`` (build; then median, min, max of decide_one, decide, score
        and update), ``memory_gb`` after each stage, ``mismatch`` at equal weights (mean and largest
        |Δ log-prob| of a decision in nats, share of chunk ratios outside 1 ± 0.2), ``config`` and ``host``.
    """
    import numpy as np
    import torch

    from accerl_lerobot.policies.adapter import stack_observations
    from accerl_lerobot.policies.loading import resolve_device

    device = resolve_device(config.device, "device")
    memory = Memory(device)
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as directory:
        adapter = _adapter(config, device, Path(directory))
    built = time.perf_counter() - started
    memory.note("built")
    requests = _requests(config.batch)
    one = timed(lambda: adapter.decide(requests[:1], 0), config.repeats, device)
    many = timed(lambda: adapter.decide(requests, 0), config.repeats, device)
    memory.note("decided")
    # One at a time, and re-scored together: rounding depends on the batch, and this is what a run does.
    decisions = [adapter.decide([request], 0)[0] for request in requests]
    names = decisions[0].latent
    latent = {k: torch.from_numpy(np.stack([d.latent[k] for d in decisions])) for k in names}
    old = torch.stack([torch.from_numpy(d.log_prob) for d in decisions]).to(device)
    observations = stack_observations(requests)

    def score() -> Any:
        with torch.no_grad():
            return adapter.evaluate(*observations, latent).log_prob

    scored = timed(score, config.repeats, device)
    change = (score() - old).sum(1)
    gap, ratio = change.abs(), change.exp()
    trainable = adapter.trainable()
    optimizer = torch.optim.AdamW(trainable.values(), lr=1e-6)

    def update() -> None:
        optimizer.zero_grad(set_to_none=True)
        evaluation = adapter.evaluate(*observations, latent)
        ratio = (evaluation.log_prob - old).sum(1).clamp(-1, 1).exp()
        (ratio.mean() + (evaluation.value - 1).square().mean()).backward()
        optimizer.step()

    updated = timed(update, config.repeats, device)
    memory.note("updated")
    return {
        "config": asdict(config),
        "parameters": {
            "all": sum(p.numel() for p in adapter.policy.parameters()),
            "trained": sum(p.numel() for p in trainable.values()),
        },
        "seconds": {"build": built, "decide_one": one, "decide": many, "score": scored, "update": updated},
        "memory_gb": memory.notes,
        "mismatch": {
            "mean": float(gap.mean()),
            "max": float(gap.max()),
            "clip": float(((ratio > 1.2) | (ratio < 0.8)).float().mean()),
        },
        "host": {
            "device": device_name(device),
            "machine": platform.machine(),
            "threads": torch.get_num_threads(),
        },
    }


def table(result: dict[str, Any]) -> Table:
    """`result` for people."""
    config, parameters, batch = result["config"], result["parameters"], result["config"]["batch"]
    shown = Table(
        title=f"{config['type']} {config['precision']}, {config['tuning']['mode']}: "
        f"{parameters['all'] / 1e6:,.0f} M parameters, {parameters['trained'] / 1e6:,.0f} M trained, on "
        f"{result['host']['device']}"
    )
    for heading in ("what", "seconds", "range", "decisions/s"):
        shown.add_column(heading, justify="left" if heading == "what" else "right")
    shown.add_row("build", f"{result['seconds']['build']:.1f}", "", "")
    for name, count in (("decide_one", 1), ("decide", batch), ("score", batch), ("update", batch)):
        t = result["seconds"][name]
        spread = f"{t['min']:.3f} to {t['max']:.3f}"
        shown.add_row(f"{name} ({count})", f"{t['median']:.3f}", spread, f"{count / t['median']:.1f}")
    for stage, size in result["memory_gb"].items():
        shown.add_row(f"memory, {stage}", f"{size:.1f} GB", "", "")
    gap = result["mismatch"]
    shown.add_row("mismatch at equal weights", f"{gap['mean']:.1e} nats", f"max {gap['max']:.1e}", "")
    return shown


def _adapter(config: BenchPolicyConfig, device: Any, directory: Path) -> Any:
    from dataclasses import replace

    import torch
    from lerobot.policies.factory import get_policy_class

    from accerl_lerobot.config.imports import imported
    from accerl_lerobot.policies.adapter import LeRobotAdapter
    from accerl_lerobot.policies.config import FlowSamplerConfig, ValueHeadConfig
    from accerl_lerobot.policies.flow import FlowFamily
    from accerl_lerobot.policies.registry import POLICIES, steps_field
    from accerl_lerobot.policies.tuning import tune
    from accerl_lerobot.policies.value_head import ValueHead

    torch.manual_seed(0)
    lerobot_config = BUILDERS[config.type](config, directory)
    lerobot_config.device = str(device)
    if config.num_steps is not None:
        lerobot_config = replace(lerobot_config, **{str(steps_field(lerobot_config)): config.num_steps})
    policy = get_policy_class(config.type)(lerobot_config).to(device)
    model = imported(POLICIES[config.type][0])(policy)
    family = FlowFamily(model, FlowSamplerConfig(stochastic=config.stochastic, noise_level=0.2))
    processing: Any = _MadeUp(config, device)
    adapter = LeRobotAdapter(
        policy, processing, model, family, ValueHead(model.width, ValueHeadConfig()), config.precision
    )
    tune(policy, model, family, config.tuning)
    return adapter


class _MadeUp:
    """Stands where LeRobot's processors do: a preprocessed batch of random content, the same each time."""

    def __init__(self, config: BenchPolicyConfig, device: Any) -> None:
        self.config, self.device = config, device

    def prepare(self, observations: dict[str, Any], tasks: Sequence[str]) -> dict[str, Any]:
        """Row i is the same whatever the batch."""
        import torch

        rows = []
        for i in observations["observation.state"][:, 0].astype(int):
            generator = torch.Generator().manual_seed(int(i))
            row = {
                f"observation.images.camera{c}": torch.rand(3, 256, 256, generator=generator)
                for c in range(self.config.cameras)
            }
            row["observation.state"] = torch.randn(STATE_DIM, generator=generator)
            row["observation.language.tokens"] = torch.randint(1, 200, (TOKENS,), generator=generator)
            row["observation.language.attention_mask"] = torch.arange(TOKENS) < 12
            rows.append(row)
        return {k: torch.stack([r[k] for r in rows]).to(self.device) for k in rows[0]}

    def unnormalise(self, chunk: Any) -> Any:
        """The chunk itself."""
        return chunk


def _features(config: BenchPolicyConfig) -> dict[str, Any]:
    from lerobot.configs.types import FeatureType, PolicyFeature

    inputs = {
        f"observation.images.camera{c}": PolicyFeature(type=FeatureType.VISUAL, shape=(3, 256, 256))
        for c in range(config.cameras)
    }
    inputs["observation.state"] = PolicyFeature(type=FeatureType.STATE, shape=(STATE_DIM,))
    action = PolicyFeature(type=FeatureType.ACTION, shape=(ACTION_DIM,))
    return {"input_features": inputs, "output_features": {"action": action}, "push_to_hub": False}


def _smolvla(config: BenchPolicyConfig, directory: Path) -> Any:
    from lerobot.policies.factory import make_policy_config

    from accerl_lerobot.demos.backbone import SMOLVLM2_500M, write_backbone

    backbone = write_backbone(directory / "backbone", SMOLVLM2_500M)
    return make_policy_config(
        "smolvla",
        **_features(config),
        device="cpu",
        vlm_model_name=str(backbone),
        load_vlm_weights=False,
        num_vlm_layers=16,
    )


def _pi(config: BenchPolicyConfig, directory: Path) -> Any:
    from lerobot.policies.factory import make_policy_config

    return make_policy_config(config.type, **_features(config), device="cpu")


BUILDERS: dict[str, Callable[[BenchPolicyConfig, Path], Any]] = {"smolvla": _smolvla, "pi0": _pi, "pi05": _pi}
"""Policy type → its LeRobot config at the published size."""


def _requests(count: int) -> list[Any]:
    import numpy as np

    from accerl_lerobot.experience import TASK, Request

    return [
        Request(observation={"observation.state": np.full(1, i, np.float32), TASK: "do it"}, noise_seed=i)
        for i in range(count)
    ]
