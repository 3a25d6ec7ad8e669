# SPDX-License-Identifier: Apache-2.0
"""The card of what is pushed: metadata for the Hub, measured numbers and commands for people."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from huggingface_hub import DatasetCard, EvalResult, ModelCard, ModelCardData

from accerl_lerobot.checkpoint.layout import AWAY
from accerl_lerobot.config.imports import DISCOVER
from accerl_lerobot.hub.around import FOLDER, Around
from accerl_lerobot.hub.config import REPO_ID
from accerl_lerobot.hub.contents import RECORD, Files
from accerl_lerobot.hub.kinds import (
    CONFIG,
    INFO,
    LAST,
    POLICY,
    RECIPE,
    RUN,
    SUCCESS_MODEL,
    WORLD_MODEL,
    read_json,
)
from accerl_lerobot.policies.plugins import discovery
from accerl_lerobot.world_model.config import PIXELS

MARK = "<!-- Written by accerl push, and anew each time. Delete this line to keep what you change. -->"
PLUGIN = "accerl_lerobot.world_model.success_plugin"
TITLES = {
    POLICY: "A LeRobot policy improved by online reinforcement learning",
    RUN: "A run of accerl train",
    WORLD_MODEL: "A world model for LeRobot policies",
    SUCCESS_MODEL: "A success model, which is a LeRobot reward model",
}


def model_card(repo_id: str, kind: str, folder: Path, files: Files, around: Around) -> str:
    """README.md of a model repository.

    Args:
        repo_id: where it goes.
        kind: of what is pushed.
        folder: what is pushed.
        files: what of it; pictures and films among them are shown.
        around: what is known of it.
    """
    config = read_json(folder / LAST / CONFIG if kind == RUN else folder / CONFIG)
    name = repo_id.split("/")[1]
    data = ModelCardData(
        library_name="lerobot",
        pipeline_tag="robotics",
        tags=_tags(kind, config, around),
        datasets=_datasets(around.recipe),
        base_model=_base_model(around.recipe),
        model_name=name,
        eval_results=_results(around) or None,
    )
    parts = [f"# {name}", f"{TITLES[kind]}, made with accerl-lerobot {_of(config)}.".replace(" .", ".")]
    parts += _numbers(around) + _validation(around) + _pictures(files)
    parts += (
        _use_policy(repo_id, kind, config, around)
        if kind in (POLICY, RUN)
        else _use_model(repo_id, kind, config, around)
    )
    recipe = files.get(RECIPE if kind == RUN else f"{FOLDER}/{RECIPE}")
    if isinstance(recipe, bytes):
        summary = "<summary>Every field, as <code>accerl train</code> takes it</summary>"
        parts += ["## Recipe", f"<details>\n{summary}\n\n```yaml\n{recipe.decode()}```\n\n</details>"]
    return str(ModelCard(f"---\n{data.to_yaml()}\n---\n\n{MARK}\n\n" + "\n\n".join(parts) + "\n"))


def dataset_card(repo_id: str, folder: Path) -> str:
    """README.md of a LeRobotDataset: LeRobot's own card, and how to use it here."""
    from lerobot.datasets.io_utils import load_info
    from lerobot.datasets.utils import create_lerobot_dataset_card

    info = read_json(folder / INFO)
    counts = ", ".join(f"{info.get(f'total_{what}')} {what}" for what in ("episodes", "frames", "tasks"))
    fields = f"accerl sft --config_path=RECIPE --dataset.repo_id={repo_id}"
    text = f"{counts}, {info.get('fps')} frames a second.\n\n```bash\n{fields}\n```"
    card: DatasetCard = create_lerobot_dataset_card(
        tags=["accerl-lerobot"], dataset_info=load_info(folder), repo_id=repo_id, dataset_description=text
    )
    head, _, body = str(card).partition("\n---\n")
    return f"{head}\n---\n\n{MARK}\n{body}"


def _of(config: Mapping[str, Any]) -> str:
    return f"({config['type']})" if "type" in config else ""


def _tags(kind: str, config: Mapping[str, Any], around: Around) -> list[str]:
    env, algorithm = around.recipe.get("env") or {}, around.recipe.get("algorithm") or {}
    tags = ["accerl-lerobot", kind.replace(" ", "-"), config.get("type"), env.get("type")]
    if around.summary:
        tags += ["reinforcement-learning", algorithm.get("type")]
    return list(dict.fromkeys(str(tag) for tag in tags if tag))


def _datasets(recipe: Mapping[str, Any]) -> list[str] | None:
    rooms = [recipe.get(room) or {} for room in ("dataset", "online")]
    # Beside a folder the name is a label, and no dataset on the Hub.
    names = [room["repo_id"] for room in rooms if room.get("repo_id") and not room.get("root")]
    return names or None


def _base_model(recipe: Mapping[str, Any]) -> str | None:
    for name in ((recipe.get("policy") or {}).get("path"), (recipe.get("sft") or {}).get("init_path")):
        if name and (pulled := read_json(Path(name).expanduser() / RECORD)):
            return str(pulled.get("repo_id"))
        if name and REPO_ID.fullmatch(name) and not Path(name).exists():
            return None if name.startswith(f"{AWAY}/") else str(name)
    return None


def _measured(around: Around) -> list[tuple[str, dict[str, Any]]]:
    """(when, {success, n, ci95, tasks}) of every measurement there is."""
    s, found = around.summary, []
    for when, label in (("before", "before RL"), ("after", "after RL")):
        if s.get(f"success_{when}") is not None and s.get(f"ci95_{when}"):
            row = {"success": s[f"success_{when}"], "n": s[f"n_{when}"], "ci95": s[f"ci95_{when}"]}
            found.append((label, row | {"tasks": s.get(f"tasks_{when}") or {}}))
    if around.evaluation:
        found.append(("accerl eval", dict(around.evaluation)))
    return found


def _results(around: Around) -> list[EvalResult]:
    """Latest measurements, in all and per task, for the Hub's model index."""
    rows = _measured(around)
    if not rows or rows[-1][0] == "before RL":
        return []
    env, row = (around.recipe.get("env") or {}).get("type", "simulation"), rows[-1][1]
    tasks = row.get("tasks") or {}
    parts = tasks if len(tasks) > 1 else {}
    lone = next(iter(tasks), "all tasks") if len(tasks) == 1 else "all tasks"
    return [
        EvalResult(
            task_type="robotics",
            task_name="robotics",
            dataset_type=env,
            dataset_name=f"{env} {name}",
            dataset_config=name,
            metric_type="success_rate",
            metric_name="success rate",
            metric_value=round(result["success"], 4),
            metric_args={"n": result["n"], "ci95": [round(v, 4) for v in result["ci95"]]},
        )
        for name, result in ({lone: row} | parts).items()
    ]


def _numbers(around: Around) -> list[str]:
    rows = _measured(around)
    if not rows:
        return []
    table = ["| | task | success | n | 95 % interval |", "|---|---|---|---|---|"]
    for when, row in rows:
        tasks = row.get("tasks") or {}
        everything = {next(iter(tasks), "all") if len(tasks) == 1 else "all": row}
        for task, result in (everything | (tasks if len(tasks) > 1 else {})).items():
            low, high = result["ci95"]
            table.append(
                f"| {when} | {task} | {result['success']:.1%} | {result['n']} | {low:.1%} to {high:.1%} |"
            )
    text = "Simulated episodes on seeds that no run trains on, with LeRobot's own sampler; Wilson intervals."
    parts = ["## Measured", "\n".join(table), text]
    s = around.summary
    if s:
        wanted = (
            ("env steps", "env_steps"), ("episodes", "episodes"), ("updates", "updates"), ("seed", "seed"),
            ("algorithm", "algorithm"), ("lag, mean", "lag_mean"), ("seconds of RL", "rl_s"),
        )  # fmt: skip
        shown = [(what, s[key]) for what, key in wanted if s.get(key) is not None]
        parts.append(
            "| | |\n|---|---|\n" + "\n".join(f"| {what} | {_plain(value)} |" for what, value in shown)
        )
    return parts


def _validation(around: Around) -> list[str]:
    validation = around.validation
    if "passed" not in validation:
        return []
    verdict = "It passed validation" if validation["passed"] else "**It failed validation**"
    checks = validation.get("checks") or {}
    rows = [
        f"| {name} | {_plain(check.get('value'))} | {'yes' if check.get('holds') else 'no'} |"
        for name, check in checks.items()
    ]
    text = f"{verdict} on held-out episodes."
    return (
        ["## Validation", text, "\n".join(["| check | value | holds |", "|---|---|---|", *rows])]
        if rows
        else ["## Validation", text]
    )


def _pictures(files: Files) -> list[str]:
    shown = []
    for name in sorted(n for n in files if n.startswith(f"{FOLDER}/") or "/" not in n):
        if name.endswith((".png", ".gif", ".svg", ".jpg")):
            shown.append(f"![{Path(name).stem.replace('_', ' ')}]({name})")
        elif name.endswith(".mp4"):
            shown.append(f'<video controls src="{name}"></video>\n\n[{Path(name).name}]({name})')
    return shown


def _use_policy(repo_id: str, kind: str, config: Mapping[str, Any], around: Around) -> list[str]:
    here = repo_id.split("/")[1]
    policy = f"{here}/{LAST}" if kind == RUN else here
    recipe = f"{here}/config.yaml" if kind == RUN else f"{here}/{FOLDER}/config.yaml"
    lines = [f"accerl pull --repo_id={repo_id} --output_dir={here}"]
    if around.recipe:
        lines.append(f"accerl eval --config_path={recipe} --policy.path={policy} --evaluation.episodes=100")
        lines.append(f"accerl train --config_path={recipe} --sft.steps=0 --policy.path={policy}")
    parts = ["## Use", "With accerl-lerobot:", _bash(lines)]
    stock = _stock(policy, config, around.recipe.get("env") or {})
    if stock:
        parts += [
            "With LeRobot alone, and accerl-lerobot as its plugin for this environment:",
            _bash([stock]),
        ]
    if kind == POLICY and not _own_backbone(config):
        parts.append(f"LeRobot loads it from the Hub as well: `--policy.path={repo_id}`.")
    return parts


def _own_backbone(config: Mapping[str, Any]) -> bool:
    """True if LeRobot finds its backbone only once it has been pulled, which sets its place."""
    named = str(config.get("vlm_model_name") or "")
    return named.startswith(("/", "backbone"))


def _stock(policy: str, config: Mapping[str, Any], env: Mapping[str, Any]) -> str | None:
    command = [f"lerobot-eval --policy.path={policy}", *discovery(config.get("type"))]
    if env.get("type") == "metaworld":
        command += ["--env.discover_packages_path=accerl_lerobot.envs.lerobot_plugin"]
        command += ["--env.type=accerl_metaworld"]
        names = ("task", "camera", "image_size", "max_steps", "lighting")
        command += [f"--env.{name}={shlex.quote(str(env[name]))}" for name in names if name in env]
    elif env.get("type") == "lerobot":
        command += [f"--env.type={env.get('name')}"]
        command += [f"--env.{k}={shlex.quote(str(v))}" for k, v in (env.get("kwargs") or {}).items()]
    else:
        return None
    return " \\\n  ".join([*command, "--eval.n_episodes=50 --eval.batch_size=5"])


def _use_model(repo_id: str, kind: str, config: dict[str, Any], around: Around) -> list[str]:
    here = repo_id.split("/")[1]
    lines = [f"accerl pull --repo_id={repo_id} --output_dir={here}"]
    if kind == WORLD_MODEL:
        lines.append(f"accerl world-model-eval --path={here} --dataset.repo_id=USER/DATASET")
        model = config.get("model")
        if isinstance(model, dict) and model.get("type", PIXELS) != PIXELS:
            # Of one that was promoted in a run, no recipe is known.
            package = (around.recipe.get("world_model") or {}).get(DISCOVER) or "PACKAGE"
            lines[-1] += f" --{DISCOVER}={shlex.quote(str(package))}"
    parts = ["## Use", _bash(lines)]
    if kind == SUCCESS_MODEL:
        parts.append(
            "LeRobot loads it as a reward model:\n\n```python\n"
            f"from {PLUGIN}.modeling_success_pairs import SuccessPairsRewardModel\n\n"
            f'model = SuccessPairsRewardModel.from_pretrained("{repo_id}")\n```'
        )
    return parts


def _bash(lines: list[str]) -> str:
    return "```bash\n" + "\n".join(lines) + "\n```"


def _plain(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1e5 else f"{value:,.0f}"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)
