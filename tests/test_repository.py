# SPDX-License-Identifier: Apache-2.0
"""Rules for the repository itself, whoever adds a file to it."""

from __future__ import annotations

import ast
import re
import shlex
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest
from packaging.requirements import Requirement

from accerl_lerobot.cli.verbs import CONFIGS
from accerl_lerobot.engines.config import RunConfig, parse
from accerl_lerobot.policies.config import PLUGINS, POLICIES
from accerl_lerobot.run.preflight import check_sft_policy
from benchmarks.__main__ import CONFIGS as BENCHMARKS

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "accerl_lerobot"

HEADER, LONGEST_FILE = "# SPDX-License-Identifier: Apache-2.0\n", 600
MOST_EXPRESSIONS, MOST_FILES = 62_897, 114
MOST_TEST_LINES, MOST_WORDS = 17_000, 15_000
SHELLS = {
    "ray_engine.py", "ray_session.py", "supervision.py", "doctor.py", "worker.py", "online.py", "transport"
}  # fmt: skip
"""Files, and packages of one file, that may import Ray; all others are testable without it."""
DISTRIBUTED = {"ranks.py", "tensors.py"}
"""Files that may know of other processes of a `torch.distributed` group."""

LIGHT = [
    "accerl_lerobot.algorithms", "accerl_lerobot.cli", "accerl_lerobot.demos.record", "accerl_lerobot.envs",
    "accerl_lerobot.experience", "accerl_lerobot.inference.batcher", "accerl_lerobot.replay.worker",
    "accerl_lerobot.rollout.worker", "accerl_lerobot.timeline", "accerl_lerobot.algorithms.config",
]  # fmt: skip
"""Modules of processes that hold no policy: torch and LeRobot would cost each 400 MB and four seconds."""


def tracked() -> list[Path]:
    """Files under version control, and new ones that are about to be."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    try:
        listed = subprocess.check_output(command, cwd=ROOT, text=True)
    except (FileNotFoundError, subprocess.CalledProcessError):
        pytest.skip("not a git checkout")
    return [ROOT / name for name in listed.split("\0") if (ROOT / name).is_file()]


def sources() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


@cache
def parsed(path: Path) -> tuple[ast.Module, list[ast.AST]]:
    tree = ast.parse(path.read_text())
    return tree, list(ast.walk(tree))


def imports(path: Path, *, top_level: bool = False) -> Iterator[str]:
    """Names of imported modules; those at the top of the file only, if so asked."""
    tree, nodes = parsed(path)
    for node in tree.body if top_level else nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_every_file_has_the_licence_header_and_none_is_too_long() -> None:
    bare = [p.name for p in tracked() if p.suffix == ".py" and not p.read_text().startswith(HEADER)]
    assert bare == []
    assert [p.name for p in sources() if len(p.read_text().splitlines()) > LONGEST_FILE] == []


def test_packages_form_layers() -> None:
    needs: dict[str, set[str]] = {}
    for path in sources():
        unit = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        names = [name.split(".") for name in imports(path, top_level=True)]
        named = {name[1] for name in names if name[0] == PACKAGE.name and name[1:]}
        needs.setdefault(unit, set()).update(named - {unit})
    assert len(list(PACKAGE.glob("*.py"))) <= 8
    needs.pop("__init__")
    while free := {unit for unit, others in needs.items() if not others & needs.keys()}:
        needs = {unit: others for unit, others in needs.items() if unit not in free}
    assert needs == {}


def test_no_import_circle() -> None:
    """No module needs itself by way of others, imports inside functions and for type checking included."""
    files = {".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in sources()}
    files = {name.removesuffix(".__init__"): path for name, path in files.items()}
    needs = {name: set(imports(path)) & files.keys() - {name} for name, path in files.items()}
    for name, path in files.items():  # a package that is named on the way to one of its modules is not needed
        full = {found for found in imports(path) if found in files}
        needs[name] -= {found for found in full if any(other.startswith(f"{found}.") for other in full)}
    while free := {name for name, others in needs.items() if not others & needs.keys()}:
        needs = {name: others for name, others in needs.items() if name not in free}
    assert needs == {}


def test_nothing_grows() -> None:
    """Lower these bounds whenever it is possible."""
    operations = (ast.BinOp, ast.BoolOp, ast.UnaryOp, ast.Compare)
    kinds = (ast.Name, ast.Attribute, ast.Call, ast.Subscript, *operations)
    found = sum(isinstance(node, kinds) for path in sources() for node in parsed(path)[1])
    assert found <= MOST_EXPRESSIONS
    assert len(sources()) <= MOST_FILES
    assert sum(path.read_text().count("\n") for path in (ROOT / "tests").rglob("*.py")) <= MOST_TEST_LINES
    assert sum(len(path.read_text().split()) for path in (ROOT / "docs").rglob("*.md")) <= MOST_WORDS


def test_nothing_shadows_hugging_face_datasets_or_the_standard_library() -> None:
    python = [path for path in tracked() if path.suffix == ".py"]
    assert not [path for path in python if "datasets" in (path.stem, path.parent.name)]
    names = {p.stem for p in sources()} | {p.name for p in PACKAGE.iterdir() if p.is_dir()}
    assert names & set(sys.stdlib_module_names) <= {"__init__", "__main__"}


@pytest.mark.parametrize("path", sorted((ROOT / "recipes").glob("*")), ids=lambda p: p.name)
def test_recipes_resolve(path: Path) -> None:
    if "libero" in path.stem:
        pytest.importorskip("libero")
    config = parse(RunConfig, [f"--config_path={path}"])
    assert config.job_name == path.stem
    if config.sft.steps and config.sft.init_path is None:
        check_sft_policy(config.sft)
    comments = [line for line in path.read_text().splitlines() if line.startswith("#")]
    assert any(f"accerl train --config_path=recipes/{path.name}" in line for line in comments)


def test_only_shells_import_ray() -> None:
    users = set()
    for path in sources():
        if any(name.split(".")[0] == "ray" for name in imports(path)):
            users.add(path.parent.name if path.stem == "__init__" else path.name)
        distributed = any(name.startswith("torch.distributed") for name in imports(path))
        assert not distributed or path.name in DISTRIBUTED, path
    assert users <= SHELLS


@pytest.mark.parametrize(
    ("modules", "heavy"),
    [
        # Ray reads its environment when it is imported, and `ray_session.prepare` comes after the config.
        (["accerl_lerobot.run.train", "accerl_lerobot.cli.verbs"], ["ray"]),
        (LIGHT, ["torch", "lerobot", "transformers", "mujoco", "matplotlib"]),
    ],
)
def test_what_stays_light(modules: list[str], heavy: list[str]) -> None:
    code = f"import sys, {', '.join(modules)}; print({set(heavy)} & set(sys.modules))"
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "set()\n"


def test_what_the_package_imports_is_required() -> None:
    distribution = {"PIL": "pillow", "yaml": "pyyaml", "huggingface_hub": "huggingface-hub"}
    distribution |= {"libero": "hf-libero"}
    used = {name.split(".")[0] for path in sources() for name in imports(path)} - {"accerl_lerobot"}
    used = {distribution.get(name, name) for name in used - set(sys.stdlib_module_names)}
    assert used <= {requirement.name for requirement in requirements()}


def test_every_requirement_has_an_upper_bound_and_a_tested_version() -> None:
    constraints = map(Requirement, settings()["tool"]["uv"]["constraint-dependencies"])
    tested = {constraint.name: next(iter(constraint.specifier)) for constraint in constraints}
    for requirement in requirements():
        operators = {specifier.operator for specifier in requirement.specifier}
        if operators == {"=="}:
            continue
        assert operators == {">=", "<"}, requirement
        assert tested[requirement.name].operator == "=="
        assert requirement.specifier.contains(tested[requirement.name].version), requirement
    assert tested.keys() <= {requirement.name for requirement in requirements()}


def settings() -> dict[str, Any]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())


def requirements() -> list[Requirement]:
    project = settings()["project"]
    extras = project["optional-dependencies"].values()
    return [Requirement(text) for text in [*project["dependencies"], *sum(extras, [])]]


def test_no_paths_of_a_machine() -> None:
    pattern = re.compile(rb"/(root|home|work|usr/local|opt)/")
    files = [path for path in tracked() if path.suffix not in (".png", ".mp4", ".parquet")]
    assert [path.name for path in files if pattern.search(path.read_bytes())] == []


def documents() -> list[Path]:
    return [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *(ROOT / "datasets").rglob("*.md")]


def test_links_in_the_documents_lead_somewhere() -> None:
    broken = []
    for path in documents():
        for target in re.findall(r"\]\(([^)#]+)[^)]*\)", path.read_text()):
            if not target.startswith("http") and not (path.parent / target).exists():
                broken.append(f"{path.relative_to(ROOT)}: {target}")
    assert broken == []


def commands() -> list[tuple[str, str]]:
    """Lines `accerl …` and `python -m benchmarks …` of the documents' code blocks, continued lines joined."""
    found = []
    for path in documents():
        for block in re.findall(r"```(?:bash|sh)\n(.*?)```", path.read_text(), flags=re.DOTALL):
            for line in block.replace("\\\n", " ").splitlines():
                line = line.split("  #")[0].strip()
                if line.startswith(("accerl ", "python -m benchmarks ")):
                    found.append((str(path.relative_to(ROOT)), line))
    return found


@pytest.mark.parametrize(("path", "line"), commands())
def test_commands_in_the_documents_parse(path: str, line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Verb, fields, types and values; places that the reader fills in are written in capitals."""
    for package in (ROOT / "tests" / "packages").iterdir():
        monkeypatch.syspath_prepend(str(package))
    configs = CONFIGS if line.startswith("accerl ") else BENCHMARKS
    verb, *arguments = shlex.split(line.removeprefix("python -m ").partition(" ")[2])
    assert verb in configs, path
    # A run's own config is one that train resolved, so its place is taken by no recipe at all.
    here = [a.replace("recipes/", f"{ROOT}/recipes/") for a in arguments if "RUN/config.yaml" not in a]
    with patch.dict(POLICIES), patch.dict(PLUGINS):
        parse(configs[verb], here, recipe_class=RunConfig)
