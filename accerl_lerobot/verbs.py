# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""What each verb of ``accerl`` does, once its arguments are parsed."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from accerl_lerobot.config import DatasetConfig, LaunchConfig, RunConfig, parse
from accerl_lerobot.console import Console
from accerl_lerobot.demos.record import DemosConfig
from accerl_lerobot.demos.sft import SFTConfig
from accerl_lerobot.envs import EnvConfig, MetaWorldConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.evaluation.config import EvaluationConfig
from accerl_lerobot.inference.worker import InferenceConfig
from accerl_lerobot.policies.loading import PolicyConfig
from accerl_lerobot.rollout.runner import RolloutConfig


@dataclass(frozen=True, kw_only=True)
class DemosRun:
    """``accerl demos``."""

    env: EnvConfig = field(default_factory=MetaWorldConfig)
    demos: DemosConfig = field(default_factory=DemosConfig)


@dataclass(frozen=True, kw_only=True)
class SFTRun:
    """``accerl sft``."""

    seed: int = 0
    output_dir: str = "outputs/sft"
    """Folder to create."""
    device: str = "auto"
    env: EnvConfig | None = None
    """When given, the dataset is checked against it first."""
    dataset: DatasetConfig = field(default_factory=DatasetConfig)
    sft: SFTConfig = field(default_factory=SFTConfig)


@dataclass(frozen=True, kw_only=True)
class EvalRun:
    """``accerl eval``."""

    seed: int = 0
    output_dir: str | None = None
    """Folder for ``evaluation.json`` and videos; None prints only."""
    env: EnvConfig = field(default_factory=MetaWorldConfig)
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    rollout: RolloutConfig = field(default_factory=RolloutConfig)
    inference: InferenceConfig = field(default_factory=InferenceConfig)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
    launch: LaunchConfig = field(default_factory=LaunchConfig)


def train(arguments: list[str]) -> int:
    """``accerl train``."""
    from accerl_lerobot import run

    config: RunConfig = parse(RunConfig, arguments)
    console = Console()
    directory = run.make_output_dir(config)
    console.say(f"run {directory}")
    summary = run.train(config, directory, console)
    console.say(
        f"success {summary['success_before']:.1%} → {summary['success_after']:.1%} in {summary['wall_s']:.0f} s; "
        f"see {directory / 'success_curve.png'}"
    )
    sys.stdout.write(json.dumps(summary, indent=2) + "\n")
    return 0


def demos(arguments: list[str]) -> int:
    """``accerl demos``."""
    from accerl_lerobot.demos.record import record_demos

    config: DemosRun = parse(DemosRun, arguments)
    sys.stdout.write(f"{record_demos(config.env, config.demos)}\n")
    return 0


def sft(arguments: list[str]) -> int:
    """``accerl sft``."""
    from accerl_lerobot.demos.sft import run_sft
    from accerl_lerobot.demos.windows import check_dataset, open_metadata, task_texts
    from accerl_lerobot.policies.loading import resolve_device

    config: SFTRun = parse(SFTRun, arguments)
    if config.dataset.repo_id is None:
        raise InputError("dataset.repo_id", None, "name a LeRobotDataset, on the Hub or with dataset.root")
    if config.sft.steps == 0:
        raise InputError("sft.steps", 0, "use at least 1")
    out = Path(config.output_dir)
    if out.exists():
        raise InputError("output_dir", str(out), "the folder exists; choose another or remove it")
    meta = (
        open_metadata(config.dataset) if config.env is None else check_dataset(config.dataset, config.env, {})
    )
    console = Console()
    with console.stage("SFT", total=config.sft.steps) as stage:
        path = run_sft(
            config.sft, config.dataset.repo_id, config.dataset.root, out / "sft", config.seed,
            str(resolve_device(config.device)), task_texts(meta), on_step=lambda s, loss: stage.update(s, f"loss {loss:.3f}"),
        )  # fmt: skip
    sys.stdout.write(f"{path}\n")
    return 0


def evaluate(arguments: list[str]) -> int:
    """``accerl eval``."""
    from accerl_lerobot import run
    from accerl_lerobot.evaluation.config import evaluation_plans
    from accerl_lerobot.evaluation.pictures import write_video
    from accerl_lerobot.evaluation.summary import summarise, table

    config: EvalRun = parse(EvalRun, arguments)
    rooms = ("seed", "env", "policy", "rollout", "inference", "evaluation", "launch")
    whole = RunConfig(**{name: getattr(config, name) for name in rooms})
    out = Path(config.output_dir) if config.output_dir else None
    if out is not None and out.exists():
        raise InputError("output_dir", str(out), "the folder exists; choose another or remove it")
    run.check_policy(whole)
    tasks = run.check_world(whole)
    console = Console()
    engine = run.make_engine(whole, tasks)
    try:
        film = config.evaluation.videos if out else 0
        engine.plan(evaluation_plans(tasks, config.evaluation.episodes, "eval", film))
        results = run.run_plans(engine, config.evaluation.episodes, "eval", console)
    finally:
        engine.close()
    summary: dict[str, Any] = summarise(results) | {"policy": config.policy.path}
    console.rich.print(table(summary, f"{config.policy.path}"))
    if out is not None:
        out.mkdir(parents=True)
        (out / "evaluation.json").write_text(json.dumps(summary, indent=2) + "\n")
        for result in results:
            if result.frames:
                name = (
                    f"{result.plan.task}_{result.plan.seed}_{'success' if result.success else 'failure'}.mp4"
                )
                write_video(out / name, [result.frames], fps=20)
    sys.stdout.write(json.dumps(summary) + "\n")
    return 0


def bench(arguments: list[str]) -> int:
    """``accerl bench world``."""
    from accerl_lerobot.bench import world

    if not arguments or arguments[0] != "world":
        raise InputError("bench", arguments[0] if arguments else "", "use: accerl bench world")
    config: world.BenchWorldConfig = parse(world.BenchWorldConfig, arguments[1:])
    result = world.bench_world(config)
    Console().rich.print(world.table(result))
    sys.stdout.write(json.dumps(result, indent=2) + "\n")
    return 0
