# SPDX-License-Identifier: Apache-2.0
"""No line of the package runs or unpickles what it should not; nothing it stands on is known to be bad."""

from __future__ import annotations

import ast
import importlib.metadata
import re
import subprocess
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "accerl_lerobot"

BANNED_MODULES = {"pickle", "cPickle", "cloudpickle", "dill", "joblib", "marshal", "shelve", "code", "codeop"}
BANNED_NAMES = {"eval", "exec", "compile", "__import__", "input"}
BANNED_CALLS = {
    ("torch", "load"), ("torch", "save"), ("yaml", "unsafe_load"), ("yaml", "full_load"),
    ("yaml", "load_all"), ("yaml", "FullLoader"), ("yaml", "UnsafeLoader"), ("yaml", "Loader"),
    ("os", "system"), ("os", "popen"),
    ("runpy", "run_path"), ("importlib.util", "spec_from_file_location"), ("pd", "read_pickle"),
    ("np", "fromregex"), ("tarfile", "open"), ("zipfile", "ZipFile"), ("shutil", "unpack_archive"),
}  # fmt: skip
ALLOWED = {
    (
        "policies/guard.py",
        "torch.load",
    ): "puts a function in its place that refuses what is not PyTorch's own",
    ("config/parsing.py", "yaml.load"): "with a loader that is derived from SafeLoader",
}
"""(file, what) → why it is no danger there."""


def dotted(node: ast.expr) -> str:
    """``a.b.c`` of an attribute; empty for what is more than names."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute) and (before := dotted(node.value)):
        return f"{before}.{node.attr}"
    return ""


def findings(source: str) -> Iterator[tuple[int, str]]:
    """Line and name of everything in a Python file that could run or unpickle what it reads."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)]
        else:
            names = []
        for name in names:
            if name.split(".")[0] in BANNED_MODULES or tuple(name.rsplit(".", 1)) in BANNED_CALLS:
                yield node.lineno, name
        if isinstance(node, ast.Attribute):
            name = dotted(node)
            if tuple(name.rsplit(".", 1)) in BANNED_CALLS:
                yield node.lineno, name
        if not isinstance(node, ast.Call):
            continue
        name = dotted(node.func)
        given = {k.arg: k.value for k in node.keywords}
        if name in BANNED_NAMES or name.startswith("builtins."):
            yield node.lineno, name
        if name == "yaml.load" or name.endswith(".yaml.load"):
            yield node.lineno, "yaml.load"
        for option, harmless in (("allow_pickle", False), ("weights_only", True), ("shell", False)):
            value = given.get(option)
            if value is not None and not (isinstance(value, ast.Constant) and value.value is harmless):
                yield node.lineno, f"{option}="
        trust = given.get("trust_remote_code")
        if trust is not None and isinstance(trust, ast.Constant) and trust.value is not False:
            yield node.lineno, "trust_remote_code="


def test_nothing_from_outside_is_run_or_unpickled():
    found, used = [], set()
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).as_posix()
        for line, what in findings(path.read_text()):
            used.add((name, what))
            if (name, what) not in ALLOWED:
                found.append(f"{name}:{line}: {what}")
    assert found == []
    assert set(ALLOWED) <= used, "an exception that nothing needs any more"


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "import cloudpickle as cp",
        "from joblib import load",
        "from torch import load",
        "from yaml import unsafe_load",
        "import marshal, os",
        "import shelve",
        "import torch\ntorch.load(path)",
        "import torch\nread = torch.load",
        "torch.load(path, weights_only=True)",
        "eval(text)",
        "exec(text)",
        "builtins.exec(text)",
        "__import__(name)",
        "np.load(path, allow_pickle=True)",
        "np.load(path, allow_pickle=flag)",
        "yaml.load(text, Loader)",
        "yaml.full_load(text)",
        "os.system(text)",
        "subprocess.run(text, shell=True)",
        "AutoModel.from_pretrained(name, trust_remote_code=True)",
        "pd.read_pickle(path)",
    ],
)
def test_the_search_finds(source: str):
    assert list(findings(source)), source


@pytest.mark.parametrize(
    "source",
    [
        "model.eval()",
        "re.compile(text)",
        "torch.compile",
        "np.load(path, allow_pickle=False)",
        "json.loads(text)",
        "yaml.safe_load(text)",
        "make_env(config, trust_remote_code=config.trust_remote_code)",
        "subprocess.run([program], shell=False)",
    ],
)
def test_the_search_leaves_alone(source: str):
    assert list(findings(source)) == []


KNOWN_BAD = {
    "torch": ("2.10.0", "CVE-2025-32434 and CVE-2026-24747: weights_only=True does not hold"),
    "ray": ("2.54.0", "CVE-2026-27482 of the dashboard; tokens only since 2.52 (CVE-2023-48022)"),
    "pyarrow": ("14.0.1", "CVE-2023-47248: Arrow and Parquet files are unpickled"),
    "pillow": ("10.3.0", "CVE-2024-28219 and CVE-2023-4863: buffers overflow"),
    "transformers": ("4.48.0", "CVE-2024-11392, -11393 and -11394: models of some kinds are unpickled"),
    "pyyaml": ("5.4", "CVE-2020-14343: FullLoader runs code"),
    "urllib3": ("2.5.0", "CVE-2025-50181: redirects that were switched off"),
    "requests": ("2.32.4", "CVE-2024-47081: credentials go to other hosts"),
    "aiohttp": ("3.12.14", "CVE-2025-53643: request smuggling"),
    "jinja2": ("3.1.6", "CVE-2025-27516: out of the sandbox in which chat templates run"),
    "protobuf": ("6.31.1", "CVE-2025-4565: recursion without end"),
    "gitpython": ("3.1.41", "CVE-2024-22190: runs what lies in the current folder"),
    "setuptools": ("78.1.1", "CVE-2025-47273: path traversal"),
}
"""Distribution → the first version without what is known of it, and what that is."""


def numbers(version: str) -> tuple[int, ...]:
    """The leading numbers of a version."""
    return tuple(int(n) for n in re.findall(r"\d+", version.partition("+")[0])[:4])


@pytest.mark.parametrize("name", KNOWN_BAD)
def test_no_known_bad_version_is_installed(name: str):
    least, why = KNOWN_BAD[name]
    assert numbers(importlib.metadata.version(name)) >= numbers(least), why


def test_versions_are_compared_as_numbers():
    assert numbers("2.10.0") > numbers("2.9.1") and numbers("2.11.0+cpu") == (2, 11, 0)


def test_pins_are_not_below_what_is_known_to_be_bad():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    everything = [*project["dependencies"], *sum(project["optional-dependencies"].values(), [])]
    pinned = dict(re.fullmatch(r"([a-z0-9-]+)(?:\[.*\])?==([0-9.]+)", entry).groups() for entry in everything)
    checked = pinned.keys() & KNOWN_BAD.keys()
    assert {"torch", "ray"} <= checked
    for name in checked:
        assert numbers(pinned[name]) >= numbers(KNOWN_BAD[name][0]), KNOWN_BAD[name][1]
    assert "pip-audit" in pinned, "make audit"


SECRETS = {
    "Hugging Face token": r"\bhf_[A-Za-z0-9]{30,}\b",
    "GitHub token": r"\b(gh[pousr]_[A-Za-z0-9]{36,}|github_pat_[A-Za-z0-9_]{60,})\b",
    "AWS key": r"\b(AKIA|ASIA)[0-9A-Z]{16}\b",
    "Google key": r"\bAIza[0-9A-Za-z_-]{35}\b",
    "Slack token": r"\bxox[abposr]-[0-9A-Za-z-]{10,}",
    "OpenAI or Anthropic key": r"\bsk-(ant-|proj-)?[A-Za-z0-9_-]{32,}\b",
    "private key": r"-----BEGIN ([A-Z]+ )*PRIVATE KEY-----",
    "JSON web token": r"\beyJ[A-Za-z0-9_-]{16,}\.eyJ[A-Za-z0-9_-]{16,}\.[A-Za-z0-9_-]{16,}",
    "password in an address": r"\b[a-z][a-z0-9+.-]{1,15}://[^/\s:@'\"{}$]+:[^/\s:@'\"{}$]{4,}@",
    "key that is given": r"(?i)\b(api_?key|secret_?key|access_?token|auth_?token|password)\b['\"]?\s*"
    r"[:=]\s*['\"][A-Za-z0-9+/_-]{24,}['\"]",
    "W&B key": r"(?i)wandb.{0,20}\b[0-9a-f]{40}\b",
}
"""Patterns that are searched for in every file under version control."""


def secrets(text: str) -> list[str]:
    return [name for name, pattern in SECRETS.items() if re.search(pattern, text)]


def test_no_secret_is_under_version_control():
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    try:
        listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    except (FileNotFoundError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")
    found = {}
    for name in filter(None, listed.split("\0")):
        path = ROOT / name
        if path.is_file() and (there := secrets(path.read_bytes().decode("latin-1"))):
            found[name] = there
    assert found == {}


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("Hugging Face token", "hf_" + "a" * 34),
        ("GitHub token", "ghp_" + "A1" * 18),
        ("AWS key", "AKIA" + "ABCD" * 4),
        ("Google key", "AIza" + "a" * 35),
        ("Slack token", "xoxb-" + "1" * 12),
        ("OpenAI or Anthropic key", "sk-ant-" + "x" * 40),
        ("private key", "-----BEGIN RSA " + "PRIVATE KEY-----"),
        ("JSON web token", ".".join(("eyJ" + "a" * 20, "eyJ" + "b" * 20, "c" * 20))),
        ("password in an address", "https://me:" + "hunter22@example.com/x"),
        ("key that is given", "api_key = '" + "a1" * 16 + "'"),
        ("W&B key", "WANDB_API_KEY " + "0a" * 20),
    ],
)
def test_the_patterns_find_what_they_are_for(name: str, text: str):
    assert name in secrets(f"x {text} y")
