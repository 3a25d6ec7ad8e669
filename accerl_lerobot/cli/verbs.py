# SPDX-License-Identifier: Apache-2.0
"""The verbs of ``accerl``.

Results go to the standard output, as a path or one JSON object for programs; everything else goes to the
standard error, since LeRobot prints while it loads. On a terminal there is no JSON, because the lines before
say the same.
"""

from __future__ import annotations

import json
import shlex
import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import yaml

from accerl_lerobot.checkpoint.layout import (
    CHECKPOINTS,
    CONFIG,
    LAST,
    PRETRAINED,
    SUMMARY,
    write_atomically,
    write_json,
)
from accerl_lerobot.cli.configs import DemosRun, EvalRun, OfflineRun, SFTRun, WorldModelEvalRun, WorldModelRun
from accerl_lerobot.cli.export import ExportConfig, export_config, export_episodes
from accerl_lerobot.config.parsing import read_arguments
from accerl_lerobot.console import Console, count, duration, number, rate
from accerl_lerobot.engines.config import RunConfig, encode, parse
from accerl_lerobot.errors import InputError, check_absent, expanded, kept_traceback
from accerl_lerobot.hub.card import PullConfig, PushConfig
from accerl_lerobot.metrics import plain
from accerl_lerobot.policies.config import Load
from accerl_lerobot.report import ReportConfig, write_report
from accerl_lerobot.timeline import TimelineConfig, write_trace

OUTCOME = (
    "success_before", "ci95_before", "success_after", "ci95_after", "n_after", "episodes", "env_steps",
    "updates", "wall_s",
)  # fmt: skip
"""Numbers of a run's summary that ``accerl train`` prints."""


def train(arguments: list[str], load: Load | None = None) -> int:
    """``accerl train``; `load` makes the policy's adapter, of LeRobot's checkpoint by default."""
    config: RunConfig = parse(RunConfig, arguments)
    from accerl_lerobot.engines.stopping import StoppedError
    from accerl_lerobot.run import train as runs

    console = Console()
    try:
        directory, summary = runs.run_to_end(config, console, read_arguments(arguments)[0], load)
    except StoppedError as stopped:
        console.say(str(stopped))
        return 128 + stopped.number
    success = rate(summary["success_after"], summary["ci95_after"])
    if summary["success_before"] is not None:
        before = rate(summary["success_before"], summary["ci95_before"])
        success = f"{before} → {success}"
    practice = f"{count(summary['episodes'], 'episode')}, {count(summary['env_steps'], 'env step')}"
    console.say(f"success {success} of {summary['n_after']}; {practice}; {duration(summary['wall_s'])}")
    outcome = {name: summary[name] for name in OUTCOME}
    return tell(outcome | _say_places(directory, console))


def demos(arguments: list[str]) -> int:
    """``accerl demos``."""
    config: DemosRun = parse(DemosRun, arguments, recipe_class=RunConfig)
    from accerl_lerobot.config.machine import check_disk
    from accerl_lerobot.demos.record import record_demos
    from accerl_lerobot.run.preflight import check_demonstrations, check_environment

    with redirect_stdout(sys.stderr):
        check_disk(config.root, "root")
        check_demonstrations(config.demos, check_environment(config.env))
        path = record_demos(config.env, config.demos, config.root, config.seed)
    sys.stdout.write(f"{path}\n")
    return 0


def sft(arguments: list[str]) -> int:
    """``accerl sft``."""
    config: SFTRun = parse(SFTRun, arguments, recipe_class=RunConfig)
    from accerl_lerobot.policies.loading import resolve_device
    from accerl_lerobot.run.preflight import check_environment, check_training_data, sft_policy
    from accerl_lerobot.run.train import fine_tune, make_output_dir

    device = str(resolve_device(config.device, "device"))
    policy = sft_policy(config.sft)
    spec = None if config.env is None else check_environment(config.env)
    check_training_data(config.sft, config.dataset, policy, spec, {})
    directory = make_output_dir(config)
    with redirect_stdout(sys.stderr), kept_traceback(directory):
        path = fine_tune(config.sft, config.dataset, directory, config.seed, device, Console())
    sys.stdout.write(f"{path}\n")
    return 0


def offline(arguments: list[str]) -> int:
    """``accerl offline``."""
    config: OfflineRun = parse(OfflineRun, arguments, recipe_class=RunConfig)
    from accerl_lerobot.run.offline import learn_offline

    summary, directory, console = _in_new_folder(config, lambda *place: learn_offline(config, *place))
    losses = summary["imitation_loss"]
    changes = {}
    for outcome, loss in losses["before"].items():
        changes[outcome] = f"{number(loss)} → {number(losses['after'][outcome])}"
    console.say(
        f"imitation loss of successes {changes['successes']}, of failures {changes['failures']}; "
        f"{count(summary['episodes'], 'episode')}; {duration(summary['wall_s'])}"
    )
    _say_places(directory, console)
    return tell(summary)


def _say_places(directory: Path, console: Console) -> dict[str, str]:
    """Say where the policy and the summary of a run are; returns both paths by name."""
    policy = directory / CHECKPOINTS / LAST / PRETRAINED
    summary = directory / SUMMARY
    console.say(f"policy {policy}")
    console.say(f"the rest {summary}; accerl report {shlex.quote(str(directory))} makes a page")
    return {"policy": str(policy), "summary": str(summary)}


def _in_new_folder[Result](
    config: Any, work: Callable[[Path, Console], Result]
) -> tuple[Result, Path, Console]:
    """Do `work` in a new folder, which is removed again if the input is refused.

    Returns:
        The result of `work`, the folder, and the console.
    """
    from accerl_lerobot.run.train import discard_unused, make_output_dir

    directory = make_output_dir(config)
    console = Console()
    console.say(f"run {directory}")
    write_atomically(directory / CONFIG, yaml.safe_dump(encode(config), sort_keys=False))
    try:
        with redirect_stdout(sys.stderr), kept_traceback(directory):
            return work(directory, console), directory, console
    except InputError:
        discard_unused(directory)
        raise


def evaluate(arguments: list[str]) -> int:
    """``accerl eval``."""
    config: EvalRun = parse(EvalRun, arguments, recipe_class=RunConfig)
    out = None
    if config.output_dir:
        out = expanded(config.output_dir, "output_dir")
        check_absent(out)
    from accerl_lerobot.evaluation import summarise, table, write_video
    from accerl_lerobot.run import train as runs

    sections = ("seed", "env", "policy", "rollout", "inference", "evaluation", "launch")
    whole = RunConfig(**{name: getattr(config, name) for name in sections})
    console = Console()
    with redirect_stdout(sys.stderr):
        results = runs.play_evaluation(whole, console, config.evaluation.videos if out else 0)
    policy = config.policy.path
    local = expanded(str(policy), "policy.path")
    if local.exists():
        policy = str(local.resolve())  # `last` is another checkpoint after more updates
    summary: dict[str, Any] = summarise(results) | {"policy": policy}
    console.say(f"{config.policy.path}, LeRobot's sampler")
    console.rich.print(table(summary, "evaluation"))
    if out is not None:
        out.mkdir(parents=True)
        write_json(out / "evaluation.json", summary)
        for result in results:
            if not result.frames:
                continue
            outcome = "success" if result.success else "failure"
            task = result.plan.task.replace("/", "-")
            video = out / f"{task}_{result.plan.seed}_{outcome}.mp4"
            write_video(video, [[result.frames]], fps=20)
    return tell(summary)


def world_model(arguments: list[str]) -> int:
    """``accerl world-model``; 1 if it fails a check."""
    config: WorldModelRun = parse(WorldModelRun, arguments, recipe_class=RunConfig)
    from accerl_lerobot.world_model.pretrain import pretrain

    def work(*place: Any) -> dict[str, Any]:
        sections = config.world_model, config.env, config.dataset
        return pretrain(*sections, *place, seed=config.seed, device=config.device)

    return _checked(config, work)


def world_model_eval(arguments: list[str]) -> int:
    """``accerl world-model-eval``; 1 if it fails a check."""
    config: WorldModelEvalRun = parse(WorldModelEvalRun, arguments, recipe_class=RunConfig)
    from accerl_lerobot.world_model.pretrain import evaluate

    return _checked(config, lambda *place: evaluate(config, *place))


def _checked(
    config: WorldModelRun | WorldModelEvalRun, work: Callable[[Path, Console], dict[str, Any]]
) -> int:
    """Do `work` in a new folder; returns 0 if the world model has passed its check, otherwise 1."""
    from accerl_lerobot.world_model.pretrain import show

    found, directory, console = _in_new_folder(config, work)
    show(found, directory, console)
    return tell(found, 1 if found["failed"] else 0)


def push(arguments: list[str]) -> int:
    """``accerl push``."""
    config: PushConfig = parse(PushConfig, arguments)
    from accerl_lerobot.hub.transfer import push as to_hub

    with redirect_stdout(sys.stderr):
        found = to_hub(config)
    done = "is there already, as" if found["unchanged"] else "is now"
    Console().say(f"{found['kind']} {done} {found['url']} at commit {found['commit']}")
    return tell(found)


def pull(arguments: list[str]) -> int:
    """``accerl pull``."""
    config: PullConfig = parse(PullConfig, arguments)
    from accerl_lerobot.hub.transfer import pull as from_hub

    with redirect_stdout(sys.stderr):
        found = from_hub(config)
    Console().say(f"{found['kind']} {found['path']} is {found['commit']}, {found['files']} files")
    return tell(found)


def report(arguments: list[str]) -> int:
    """``accerl report``."""
    config: ReportConfig = parse(ReportConfig, arguments)
    sys.stdout.write(f"{write_report(config)}\n")
    return 0


def timeline(arguments: list[str]) -> int:
    """``accerl timeline``."""
    config: TimelineConfig = parse(TimelineConfig, arguments)
    console = Console()
    found = write_trace(config)
    for run in found["runs"]:
        console.say(f"{run['run']}: time of its workers while it trained")
        for role, shares in run["shares"].items():
            parts = (f"{state} {share:.0%}" for state, share in shares.items())
            console.say(f"{role:20} {', '.join(parts)}")
    console.say(f"trace {found['trace']}; open it at https://ui.perfetto.dev")
    return tell(found)


def export(arguments: list[str]) -> int:
    """``accerl export``."""
    config = export_config(arguments)
    console = Console()
    with redirect_stdout(sys.stderr):
        found = export_episodes(config, console)
    console.say(f"{count(found['episodes'], 'episode')}, {found['successes']} successes, in {config.root}")
    return tell(found)


def tell(result: dict[str, Any], code: int = 0) -> int:
    """Print a result as JSON for programs, unless the output is a terminal; returns `code`."""
    if not sys.stdout.isatty():
        sys.stdout.write(json.dumps(plain(result), indent=2) + "\n")
    return code


CONFIGS: dict[str, type[Any]] = {
    "train": RunConfig,
    "demos": DemosRun,
    "sft": SFTRun,
    "offline": OfflineRun,
    "eval": EvalRun,
    "world-model": WorldModelRun,
    "world-model-eval": WorldModelEvalRun,
    "push": PushConfig,
    "pull": PullConfig,
    "report": ReportConfig,
    "timeline": TimelineConfig,
    "export": ExportConfig,
    "doctor": RunConfig,
}
"""Verb → what its command line is parsed into."""
