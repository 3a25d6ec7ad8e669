# SPDX-License-Identifier: Apache-2.0
"""Cost of a world model on this machine: predicting a chunk, classifying it, and a gradient step.

Weights and inputs are random; a trained model costs the same.
"""

from __future__ import annotations

import platform
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any

from rich.table import Table

from accerl_lerobot.bench import Memory, device_name, timed
from accerl_lerobot.config.parsing import encode
from accerl_lerobot.config.ranges import Device, Range, Repeats, Section, Threads
from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.config import WorldModelConfig


@dataclass(frozen=True, kw_only=True)
class BenchWorldModelConfig(Section):
    """Fields of ``python -m benchmarks world_model``."""

    world_model: WorldModelConfig = field(default_factory=WorldModelConfig)
    cameras: Annotated[int, Range("[1, 64]")] = 1
    """Cameras of an observation."""
    state_dim: Annotated[int, Range("[0, 65536]")] = 4
    action_dim: Annotated[int, Range("[1, 65536]")] = 4
    batches: tuple[Annotated[int, Range("[1, 65536]")], ...] = (1, 8, 32)
    """Rollouts at a time."""
    device: Device = "auto"
    """cpu, cuda, or auto."""
    num_threads: Threads = 1
    """CPU threads."""
    repeats: Repeats = 5
    """Times each part is measured after a first one that does not count."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.batches:
            raise InputError("batches", self.batches, "name sizes from 1 up")


def bench_world_model(config: BenchWorldModelConfig) -> dict[str, Any]:
    """Predicts, classifies and learns.

    Returns:
        ``parameters`` of world model and success model; ``seconds`` (median, min, max) of ``predict`` and
        ``classify`` by batch size, and of a gradient step ``learn``; ``memory_gb``; ``config``; ``host``.
    """
    import numpy as np
    import torch

    from accerl_lerobot.policies.loading import resolve_device
    from accerl_lerobot.world_model.contract import WorldModelSpec, context_of, new_model
    from accerl_lerobot.world_model.learners import Learner, new_success_model

    torch.set_num_threads(config.num_threads)
    torch.manual_seed(0)
    device, of = resolve_device(config.device, "device"), config.world_model
    memory = Memory(device)
    spec = WorldModelSpec(
        cameras=tuple(f"observation.images.{i}" for i in range(config.cameras)),
        image_size=(of.image_size, of.image_size),
        state_dim=config.state_dim,
        action_dim=config.action_dim,
        chunk=of.chunk,
        fps=10,
        context=of.model.context,
    )
    model = new_model(spec, of.model).to(device)
    success = new_success_model(of.chunk).to(device).eval()
    seconds: dict[str, Any] = {"predict": {}, "classify": {}}
    for batch in config.batches:
        windows = _windows(spec, batch, of.learn.chunks)
        state = model.begin(context_of(windows), windows.task)
        step = partial(model.step, state, torch.from_numpy(windows.actions[:, 0]), list(range(batch)))
        newest = windows.frames[:, spec.context - 1]
        seconds["predict"][str(batch)] = timed(step, config.repeats, device)
        classify = partial(success.probabilities, newest, newest)
        seconds["classify"][str(batch)] = timed(classify, config.repeats, device)
    memory.note("predicted")
    learner = Learner(model, of, seed=0)
    windows = _windows(spec, of.learn.batch, of.learn.chunks)
    seconds["learn"] = timed(lambda: learner.step(windows), config.repeats, device)
    memory.note("learnt")
    return {
        "config": encode(config),
        "parameters": {
            name: sum(p.numel() for p in net.parameters())
            for name, net in (("world", model), ("success", success))
        },
        "seconds": seconds,
        "memory_gb": memory.notes,
        "host": {
            "device": device_name(device),
            "machine": platform.machine(),
            "threads": torch.get_num_threads(),
            "numpy": np.__version__,
        },
    }


def table(result: dict[str, Any]) -> Table:
    """`result` for people."""
    of, parameters, host = result["config"]["world_model"], result["parameters"], result["host"]
    shown = Table(
        title=f"{of['model']['type']}, {of['image_size']} px: "
        f"{parameters['world'] / 1e6:.1f} M parameters, on {host['device']}, {host['threads']} thread(s)"
    )
    for heading in ("what", "ms", "range", "chunks/s"):
        shown.add_column(heading, justify="left" if heading == "what" else "right")
    rows = [
        (f"{what} ({batch})", times, int(batch))
        for what in ("predict", "classify")
        for batch, times in result["seconds"][what].items()
    ]
    learnt = of["learn"]["batch"] * of["learn"]["chunks"]
    rows.append(
        (f"learn ({of['learn']['batch']} × {of['learn']['chunks']})", result["seconds"]["learn"], learnt)
    )
    for what, times, count in rows:
        spread = f"{1000 * times['min']:.1f} to {1000 * times['max']:.1f}"
        shown.add_row(what, f"{1000 * times['median']:.1f}", spread, f"{count / times['median']:.0f}")
    for stage, size in result["memory_gb"].items():
        shown.add_row(f"memory, {stage}", f"{size:.1f} GB", "", "")
    return shown


def _windows(spec: Any, count: int, chunks: int) -> Any:
    """Random windows."""
    import numpy as np

    from accerl_lerobot.world_model.data import Windows

    rng, length = np.random.default_rng(0), spec.context
    cameras, (height, width) = len(spec.cameras), spec.image_size
    frames = rng.integers(0, 256, (count, length + chunks, cameras, height, width, 3), dtype=np.uint8)
    return Windows(
        frames=frames,
        anchor=frames[:, length - 1],
        state=rng.standard_normal((count, length + chunks, spec.state_dim), dtype=np.float32),
        before=rng.standard_normal((count, length - 1, spec.chunk, spec.action_dim), dtype=np.float32),
        commanded_sum=rng.standard_normal((count, spec.action_dim), dtype=np.float32),
        initial_state=rng.standard_normal((count, spec.state_dim), dtype=np.float32),
        actions=rng.standard_normal((count, chunks, spec.chunk, spec.action_dim), dtype=np.float32),
        steps=np.full((count, chunks), spec.chunk),
        success=np.zeros((count, chunks), bool),
        episode=np.arange(count),
        task=("",) * count,
    )
