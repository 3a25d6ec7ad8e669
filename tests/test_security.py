# SPDX-License-Identifier: Apache-2.0
"""No line of the package runs or unpickles what it should not; no secret is in the repository."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "accerl_lerobot"

BANNED_NAMES = {"__import__", "compile", "input"}
HARMLESS = {"allow_pickle": False, "weights_only": True, "trust_remote_code": False}
"""Option → its only constant that runs nothing."""


def findings(source: str) -> Iterator[str]:
    """Calls that could run or unpickle what they read, and that no rule of ruff knows."""
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Call):
            continue
        if isinstance(node.func, ast.Name) and node.func.id in BANNED_NAMES:
            yield node.func.id
        for option in node.keywords:
            value = option.value
            passed_on = option.arg == "trust_remote_code" and not isinstance(value, ast.Constant)
            harmless = isinstance(value, ast.Constant) and value.value is HARMLESS.get(str(option.arg))
            if option.arg in HARMLESS and not (harmless or passed_on):
                yield option.arg


def test_nothing_from_outside_is_run_or_unpickled():
    found = {path.name: list(findings(path.read_text())) for path in sorted(PACKAGE.rglob("*.py"))}
    assert {name: what for name, what in found.items() if what} == {}


def test_ruff_refuses_what_runs_or_unpickles_what_it_reads():
    """In the package, by the rules in pyproject.toml; other names of a function are seen through."""
    lines = [
        "import pickle", "import cloudpickle as cp", "from joblib import load",
        "from torch import load as read", "import torch as t; t.load", "import marshal, os",
        "import shelve", "import yaml; yaml.full_load(x)",
        "import yaml; yaml.load(x, yaml.Loader)", "import os; os.system(x)", "eval(x)", "exec(x)",
        "import subprocess; subprocess.run(x, shell=True)", "import pandas as pd; pd.read_pickle(x)",
    ]  # fmt: skip
    command = [sys.executable, "-m", "ruff", "check", "--output-format=concise", "--stdin-filename"]
    done = subprocess.run(
        [*command, "accerl_lerobot/any.py", "-"],
        input="\n".join(lines),
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    refused = {int(n) for n in re.findall(r":(\d+):\d+: (?:S\d+|TID251) ", done.stdout)}
    assert [line for number, line in enumerate(lines, 1) if number not in refused] == []


SECRETS = {
    "Hugging Face token": r"\bhf_[A-Za-z0-9]{30,}\b",
    "GitHub token": r"\b(gh[pousr]_[A-Za-z0-9]{36,}|github_pat_[A-Za-z0-9_]{60,})\b",
    "private key": r"-----BEGIN ([A-Z]+ )*PRIVATE KEY-----",
    "password in an address": r"\b[a-z][a-z0-9+.-]{1,15}://[^/\s:@'\"{}$]+:[^/\s:@'\"{}$]{4,}@",
    "key that is given": r"(?i)\b(api_?key|secret_?key|access_?token|auth_?token|password)\b['\"]?\s*"
    r"[:=]\s*['\"][A-Za-z0-9+/_-]{24,}['\"]",
    "W&B key": r"(?i)wandb.{0,20}\b[0-9a-f]{40}\b",
}
"""Patterns that are searched for in every file under version control."""


def test_no_secret_is_under_version_control():
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    try:
        listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    except (FileNotFoundError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")
    found = {}
    for name in filter(None, listed.split("\0")):
        path = ROOT / name
        text = path.read_bytes().decode("latin-1") if path.is_file() else ""
        there = [kind for kind, pattern in SECRETS.items() if re.search(pattern, text)]
        if there:
            found[name] = there
    assert found == {}
