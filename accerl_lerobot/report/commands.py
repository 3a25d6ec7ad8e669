# SPDX-License-Identifier: Apache-2.0
"""Commands to type next: the run again, its policy evaluated here and by LeRobot, and shared."""

from __future__ import annotations

import shlex
from pathlib import Path

from accerl_lerobot.checkpoint.layout import CONFIG
from accerl_lerobot.engine.stopping import resume_command
from accerl_lerobot.report.read import Run

PLUGIN = "accerl_lerobot.envs.lerobot_plugin"


def commands(run: Run) -> list[tuple[str, str]]:
    """Purpose and line of each command; those that need a checkpoint only where there is one."""
    recipe = _quoted(run.path / CONFIG)
    found = []
    if run.verb == "train" and run.result is None:
        found.append(("Go on with it, if it has stopped", resume_command(run.path)))
    found.append(
        (
            "Run it again; choose a folder that does not exist yet",
            f"accerl {run.verb} --config_path={recipe} --output_dir={_quoted(Path(f'{run.path}-again'))}",
        )
    )
    if run.checkpoint is None:
        return found
    policy = f"--policy.path={_quoted(run.checkpoint)}"
    episodes = run.room("evaluation").get("episodes", 100)
    evaluate = f"accerl eval --config_path={recipe} {policy} --evaluation.episodes={episodes}"
    found.append(("Evaluate its policy on the seeds of this page", evaluate))
    if stock := _stock(run):
        found.append(("Evaluate it with LeRobot itself", f"lerobot-eval {policy} {stock}"))
    found.append(("Share it on the Hub", f"accerl push --path={_quoted(run.checkpoint)} --repo_id=USER/NAME"))
    return found


def _stock(run: Run) -> str | None:
    """Arguments of lerobot-eval that name this world; None for one that LeRobot does not have."""
    env = run.room("env")
    if env.get("type") == "metaworld":
        fields = {"type": "accerl_metaworld"} | {
            name: env[name] for name in ("task", "camera", "image_size", "max_steps") if name in env
        }
        start = f"--env.discover_packages_path={PLUGIN} "
    elif env.get("type") == "lerobot":
        fields, start = {"type": env.get("name"), **env.get("kwargs", {})}, ""
    else:
        return None
    world = " ".join(f"--env.{name}={shlex.quote(str(value))}" for name, value in fields.items())
    return f"{start}{world} --eval.n_episodes=50 --eval.batch_size=5"


def _quoted(path: Path) -> str:
    return shlex.quote(str(path))
