# SPDX-License-Identifier: Apache-2.0
"""Everything that needs a GPU to be known, in one command: ``make gpu-check``.

SmolVLA of its published size decides and learns in both precisions: seconds, memory, and
how far its log-probs are from each other at equal weights. Then recipes/gipo.yaml is trained for a few
updates with trainer and inference on the GPU, so that weights travel from one to the other; and once more by
two ranks where there are two GPUs.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from rich.table import Table

from accerl_lerobot.config.ranges import Device, Range, Repeats, Section
from accerl_lerobot.console import Console
from accerl_lerobot.policies.config import TuningConfig
from benchmarks.policy import BenchPolicyConfig, bench_policy
from benchmarks.tables import as_markdown, as_table, host, output_folder, write

COLUMNS = ("check", "result")
GIB = 2**30


@dataclass(frozen=True, kw_only=True)
class BenchGpuConfig(Section):
    """Fields of the check."""

    output_dir: str = "outputs/gpu"
    """Folder for gpu.json, gpu.md and the runs."""
    device: Device = "cuda"
    """cuda; cpu tries the command itself."""
    recipe: str = "recipes/gipo.yaml"
    """The runs', with fewer demonstrations, steps and episodes."""
    updates: Annotated[int, Range("[1, 100000]")] = 20
    """Updates of each run."""
    batch: Annotated[int, Range("[1, 65536]")] = 8
    """Decisions that are made, and learnt from, together."""
    repeats: Repeats = 3
    """Times each part is measured."""


def bench_gpu(config: BenchGpuConfig) -> dict[str, Any]:
    """Runs all checks.

    Returns:
        ``policies``: results of `bench_policy` by precision; ``runs``: summaries by sharding, or the reason
        why there is none; ``config`` and ``host``.
    """
    import torch

    from accerl_lerobot.policies.loading import resolve_device

    resolve_device(config.device, "device")
    console, root = Console(), output_folder(config.output_dir).resolve()
    result: dict[str, Any] = {"config": asdict(config), "host": host(), "policies": {}, "runs": {}}

    def save() -> None:
        write(root, "gpu", result, as_markdown(COLUMNS, _rows(result)))

    measured = BenchPolicyConfig(
        batch=config.batch, repeats=config.repeats, device=config.device, tuning=TuningConfig(mode="expert")
    )
    for precision in ("fp32", "bf16"):
        console.say(f"SmolVLA of its published size, {precision} …")
        result["policies"][precision] = bench_policy(replace(measured, precision=precision))
        save()
    gpus = torch.cuda.device_count()
    for sharding, ranks in (("ddp", 1), ("zero2", 2)):
        if config.device != "cpu" and ranks > gpus:
            result["runs"][sharding] = f"not run: {ranks} ranks need {ranks} GPUs, there are {gpus}"
            continue
        console.say(f"{config.updates} updates of {ranks} rank(s) …")
        ranked = (f"--trainer.ranks={ranks}", f"--trainer.sharding={sharding}")
        result["runs"][sharding] = _run(config, root / sharding, ranked)
    save()
    console.say(f"wrote gpu.json and gpu.md into {root}")
    return result


def _run(config: BenchGpuConfig, folder: Path, more: Sequence[str]) -> dict[str, Any]:
    if not (folder / "summary.json").is_file():
        shorter = ("--demos.episodes=4", "--sft.steps=50", "--evaluation.episodes=8", "--evaluation.videos=0")
        command = [
            sys.executable, "-m", "accerl_lerobot.cli", "train", f"--config_path={config.recipe}", *shorter,
            f"--output_dir={folder}", f"--policy.device={config.device}", "--evaluation.every_updates=0",
            f"--trainer.updates={config.updates}", "--trainer.probe_every=5", *more,
        ]  # fmt: skip
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"{' '.join(command)} failed:\n{done.stderr[-2000:]}")
    summary: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    return {name: summary[name] for name in ("ratio_max_dev", "lag_mean", "rl_s", "env_steps", "restarts")}


def table(result: dict[str, Any]) -> Table:
    """`result` for people."""
    device = result["policies"]["fp32"]["host"]["device"]
    return as_table(f"GPU check on {device}", COLUMNS, _rows(result))


def _rows(result: dict[str, Any]) -> list[list[str]]:
    rows = []
    batch = result["config"]["batch"]
    for precision, found in result["policies"].items():
        name = f"SmolVLA, {precision}"
        seconds = found["seconds"]
        gap = found["mismatch"]
        for part in ("decide", "score", "update"):
            rows.append([f"{name}: {part} {batch}", f"{batch / seconds[part]['median']:.2g} decisions/s"])
        taken = found["memory_gb"]["updated"] * 1e9 / GIB
        rows.append([f"{name}: memory of an update", f"{taken:.1f} GiB"])
        text = (
            f"{gap['mean']:.1e} nats, at most {gap['max']:.1e}; {gap['clip']:.0%} of ratios outside 1 ± 0.2"
        )
        rows.append([f"{name}: mismatch at equal weights", text])
    for sharding, found in result["runs"].items():
        text = found
        if not isinstance(found, str):
            text = f"{found['rl_s']:.0f} s, largest ratio error {found['ratio_max_dev']:.1e}"
        rows.append([f"asynchronous run, sharding {sharding}", text])
    return rows
