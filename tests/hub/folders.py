# SPDX-License-Identifier: Apache-2.0
"""Folders that look like what is pushed, written in no time; nothing in them could be loaded."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from accerl_lerobot import cli

SUMMARY = {
    "success_before": 0.25, "success_after": 0.75, "n_before": 40, "n_after": 40,
    "ci95_before": [0.1419, 0.4019], "ci95_after": [0.5981, 0.8581],
    "tasks_before": {"match": {"success": 0.25, "n": 40, "ci95": [0.1419, 0.4019]}},
    "tasks_after": {"match": {"success": 0.75, "n": 40, "ci95": [0.5981, 0.8581]}},
    "env_steps": 12345, "episodes": 321, "updates": 12, "lag_mean": 3.25, "rl_s": 60.0,
    "algorithm": "gipo", "seed": 3,
}  # fmt: skip


def told(capsys: pytest.CaptureFixture[str], *arguments: str) -> dict[str, Any]:
    """What a command that succeeds has said."""
    capsys.readouterr()
    assert cli.main(list(arguments)) == 0, capsys.readouterr().err
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line of a command that is refused."""
    capsys.readouterr()
    assert cli.main(list(arguments)) == 2
    out, err = capsys.readouterr()
    (line,) = [line for line in err.splitlines() if line.startswith("accerl: ")]
    assert out == "" and "Traceback" not in err and "hf_" not in err, "no token is told"
    return line


def write_json(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=4) + "\n")


def write_policy_folder(folder: Path, *, size: int = 3000, seed: int = 0, **config: Any) -> Path:
    """A policy's files; `config` goes into LeRobot's."""
    write_json(folder / "config.json", {"type": "act", "n_obs_steps": 1} | config)
    for name in ("policy_preprocessor.json", "policy_postprocessor.json"):
        write_json(folder / name, {"name": "any", "steps": []})
    rng = np.random.default_rng(seed)
    (folder / "model.safetensors").write_bytes(rng.bytes(size))
    (folder / "value_head.safetensors").write_bytes(rng.bytes(size // 2))
    return folder


def write_run_folder(run: Path, **policy: Any) -> Path:
    """A run that made 12 updates; names its own places, as runs do."""
    home = run / "checkpoints" / "000012" / "pretrained_model"
    write_policy_folder(home, **policy)
    write_policy_folder(run / "checkpoints" / "000006" / "pretrained_model", seed=6)
    os.symlink("000012", run / "checkpoints" / "last")
    recipe = {
        "output_dir": str(run),
        "env": {"type": "metaworld", "task": "door-open-v3", "image_size": 64},
        "dataset": {"repo_id": "accerl/demos", "root": str(run.parent / "my demos" / "one")},
        "policy": {"path": "lerobot/smolvla_base"},
        "sft": {"extra_args": [f"--dataset.root={run.parent}/data/two"]},
        "algorithm": {"type": "gipo"},
    }
    (run / "config.yaml").write_text(yaml.safe_dump(recipe, sort_keys=False))
    write_json(run / "summary.json", SUMMARY)
    (run / "success_curve.png").write_bytes(b"\x89PNG curve")
    (run / "before_after.mp4").write_bytes(b"\0\0 film")
    return run
