# SPDX-License-Identifier: Apache-2.0
"""Cost of a full-size policy: memory, seconds of decisions and updates, and the rounding of its log-probs.

Weights are random, sizes those of the published checkpoint, inputs generated: nothing is downloaded.
"""

from __future__ import annotations

import resource
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from rich.table import Table

from accerl_lerobot.config.ranges import Device, Range, Repeats, Section
from accerl_lerobot.demos.backbone import write_backbone
from accerl_lerobot.policies.config import TuningConfig
from benchmarks.tables import as_table, host, ranged, spread

STATE = "observation.state"
STATE_DIM, ACTION_DIM, TOKENS = 8, 7, 48
"""LIBERO's sizes: end-effector state, end-effector action; length of a padded instruction."""
SMOLVLM2_500M: dict[str, Any] = {
    "text": {
        "hidden_size": 960,
        "intermediate_size": 2560,
        "num_hidden_layers": 32,
        "num_attention_heads": 15,
        "num_key_value_heads": 5,
        "vocab_size": 49280,
    },
    "vision": {
        "hidden_size": 768,
        "intermediate_size": 3072,
        "num_hidden_layers": 12,
        "num_attention_heads": 12,
        "image_size": 512,
        "patch_size": 16,
    },
    "shuffle": 4,
}


@dataclass(frozen=True, kw_only=True)
class BenchPolicyConfig(Section):
    """Cost of a full-size policy."""

    type: Literal["smolvla", "pi0", "pi05"] = "smolvla"
    """LeRobot's policy type."""
    cameras: Annotated[int, Range("[1, 64]")] = 2
    """Pictures in an observation."""
    batch: Annotated[int, Range("[1, 65536]")] = 8
    """Decisions made together, and learned from together."""
    precision: Literal["fp32", "bf16"] = "fp32"
    """fp32 or bf16; see ``policy.precision``."""
    tuning: TuningConfig = field(default_factory=lambda: TuningConfig(mode="expert"))
    device: Device = "auto"
    """cpu, cuda, or auto."""
    imitates: bool = False
    """Learn by LeRobot's imitation loss, as off-policy algorithms do, instead of by a likelihood ratio."""
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

    from accerl_lerobot.experience import TASK, Request, stack_observations
    from accerl_lerobot.policies.loading import resolve_device, sizes_of
    from accerl_lerobot.testing import stored

    device = resolve_device(config.device, "device")
    on = torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu"
    seconds: dict[str, Any] = {}
    memory: dict[str, float] = {}
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as directory:
        adapter = _adapter(config, device, Path(directory))
    seconds["build"] = time.perf_counter() - started
    sizes = sizes_of(adapter)
    result = {
        "config": asdict(config),
        "parameters": {"all": sizes.policy, "trained": sizes.trained},
        "host": host() | {"device": on, "threads": torch.get_num_threads()},
    }

    def measure(name: str, work: Callable[[], Any]) -> None:
        times = []
        for _ in range(config.repeats + 1):
            began = time.perf_counter()
            work()
            if device.type == "cuda":
                torch.cuda.synchronize()
            times.append(time.perf_counter() - began)
        seconds[name] = spread(times[1:])

    memory["built"] = _peak_gb(device)
    requests = [
        Request(observation={STATE: np.full(1, i, np.float32), TASK: "do it"}, noise_seed=i)
        for i in range(config.batch)
    ]
    measure("decide_one", lambda: adapter.decide(requests[:1], 0))
    measure("decide", lambda: adapter.decide(requests, 0))
    memory["decided"] = _peak_gb(device)
    # One at a time, and re-scored together: rounding depends on the batch, and this is what a run does.
    decisions = [adapter.decide([request], 0)[0] for request in requests]
    latent, old = stored(decisions)
    observations, old = stack_observations(requests), old.to(device)
    chunks = torch.from_numpy(np.stack([d.chunk for d in decisions])).to(device)
    score = torch.no_grad()(lambda: adapter.evaluate(*observations, latent).log_prob)
    measure("score", score)
    change = (score() - old).sum(1)
    optimizer = torch.optim.AdamW(adapter.trainable().values(), lr=1e-6, fused=True)

    def update() -> None:
        optimizer.zero_grad(set_to_none=True)
        if config.imitates:
            with adapter.autocast():
                loss = adapter.family.imitation_loss(adapter.encode(*observations), chunks).mean()
        else:
            evaluation = adapter.evaluate(*observations, latent)
            ratio = (evaluation.log_prob - old).sum(1).clamp(-1, 1).exp()
            loss = ratio.mean() + (evaluation.value - 1).square().mean()
        loss.backward()
        optimizer.step()

    measure("update", update)
    memory["updated"] = _peak_gb(device)
    gap, clipped = change.abs(), (change.exp() - 1).abs() > 0.2
    return result | {
        "seconds": seconds,
        "memory_gb": memory,
        "mismatch": {
            "mean": float(gap.mean()),
            "max": float(gap.max()),
            "clip": float(clipped.float().mean()),
        },
    }


def _peak_gb(device: Any) -> float:
    """Peak of a GPU's memory since the last question; on a CPU, of the whole process since it began."""
    import torch

    if device.type != "cuda":
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    peak = torch.cuda.max_memory_allocated() / 1e9
    torch.cuda.reset_peak_memory_stats()
    return float(peak)


def table(result: dict[str, Any]) -> Table:
    config = result["config"]
    parameters = result["parameters"]
    batch = config["batch"]
    millions = [f"{parameters[which] / 1e6:,.0f} M" for which in ("all", "trained")]
    title = f"{config['type']} {config['precision']}, {config['tuning']['mode']}: {millions[0]} parameters, "
    title += f"{millions[1]} trained, on {result['host']['device']}"
    rows = [("build", f"{result['seconds']['build']:.1f}", "")]
    for name, count in (("decide_one", 1), ("decide", batch), ("score", batch), ("update", batch)):
        seconds = result["seconds"][name]
        rows.append((f"{name} ({count})", ranged(seconds, ".3f"), f"{count / seconds['median']:.1f}"))
    rows += [(f"memory, {stage}", f"{size:.1f} GB", "") for stage, size in result["memory_gb"].items()]
    gap = result["mismatch"]
    rows.append(("mismatch at equal weights", f"{gap['mean']:.1e} nats, at most {gap['max']:.1e}", ""))
    return as_table(title, ("part", "seconds (range)", "decisions/s"), rows)


def _adapter(config: BenchPolicyConfig, device: Any, directory: Path) -> Any:
    import torch
    from lerobot.policies.factory import get_policy_class

    from accerl_lerobot.config.parsing import imported
    from accerl_lerobot.policies.adapter import LeRobotAdapter, ValueHead
    from accerl_lerobot.policies.config import POLICIES, FlowSamplerConfig
    from accerl_lerobot.policies.flow import FlowFamily
    from accerl_lerobot.policies.saving import tune

    torch.manual_seed(0)
    settings = lerobot_config(config, directory)
    settings.device = str(device)
    policy = get_policy_class(config.type)(settings).to(device)
    model = imported(POLICIES[config.type][0])(policy)
    family = FlowFamily(model, FlowSamplerConfig(noise_level=0.2))
    inputs: Any = _RandomInputs(config, device)
    adapter = LeRobotAdapter(policy, inputs, model, family, ValueHead(model.width), config.precision)
    tune(policy, config.tuning, model.backbone, model.idle)
    return adapter


class _RandomInputs:
    """Replaces LeRobot's processors: a preprocessed batch of random content, the same each time."""

    rename_map: ClassVar[dict[str, str]] = {}

    def __init__(self, config: BenchPolicyConfig, device: Any) -> None:
        self.config, self.device = config, device

    def prepare(self, observations: dict[str, Any], tasks: Sequence[str]) -> dict[str, Any]:
        """Row i is the same whatever the batch."""
        import torch

        rows = []
        for i in observations[STATE][:, 0].astype(int):
            generator = torch.Generator().manual_seed(int(i))
            row = {
                f"observation.images.camera{c}": torch.rand(3, 256, 256, generator=generator)
                for c in range(self.config.cameras)
            }
            row[STATE] = torch.randn(STATE_DIM, generator=generator)
            row["observation.language.tokens"] = torch.randint(1, 200, (TOKENS,), generator=generator)
            row["observation.language.attention_mask"] = torch.arange(TOKENS) < 12
            rows.append(row)
        return {k: torch.stack([r[k] for r in rows]).to(self.device) for k in rows[0]}

    def unnormalise(self, chunk: Any) -> Any:
        return chunk


def lerobot_config(config: BenchPolicyConfig, directory: Path) -> Any:
    """LeRobot's config of a policy of the published size; files that it needs go into `directory`."""
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.factory import make_policy_config

    picture = PolicyFeature(type=FeatureType.VISUAL, shape=(3, 256, 256))
    inputs = {f"observation.images.camera{c}": picture for c in range(config.cameras)}
    inputs[STATE] = PolicyFeature(type=FeatureType.STATE, shape=(STATE_DIM,))
    outputs = {"action": PolicyFeature(type=FeatureType.ACTION, shape=(ACTION_DIM,))}
    fields: dict[str, Any] = {"input_features": inputs, "output_features": outputs, "push_to_hub": False}
    if config.type == "smolvla":
        backbone = write_backbone(directory / "backbone", **SMOLVLM2_500M)
        fields |= {"vlm_model_name": str(backbone), "load_vlm_weights": False, "num_vlm_layers": 16}
    return make_policy_config(config.type, **fields, device="cpu")
