# SPDX-License-Identifier: Apache-2.0
"""Environments, policies and tools that other people published, tried by this project's own command lines.

    python -m benchmarks third_party

Each package that is installed is tried in its situations (third_party.yaml) with a tiny random policy, in
processes of their own without a display. Writes third_party.json and .md into the output folder.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from dataclasses import asdict, dataclass
from importlib.metadata import distributions
from pathlib import Path
from string import Template
from typing import Annotated, Any

import yaml
from rich.table import Table

from accerl_lerobot.config.ranges import Range, Section
from accerl_lerobot.console import Console
from benchmarks.tables import as_markdown, as_table, host, output_folder, write

COLUMNS = ("package", "version", "tried", "came out", "right")
HIDDEN = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY")
"""Environment variables that the commands do not see."""
PYTHON_ERROR = r"accerl: [A-Z]\w*(Error|Exception)\b"
"""Pattern that no output has, unless a situation names another."""


@dataclass(frozen=True, kw_only=True)
class BenchThirdPartyConfig(Section):
    """Fields of the study."""

    packages: tuple[str, ...] = ()
    """Distributions to try; empty: all."""
    timeout_s: Annotated[float, Range("[10, 7200]")] = 900.0
    """Longest time that one command may take."""
    output_dir: str = "outputs/third_party"
    """Folder of policies, logs and results; empty or absent."""


def bench_third_party(config: BenchThirdPartyConfig) -> dict[str, Any]:
    """Tries all situations of the packages that are installed.

    Returns:
        ``rows`` (package, version, tried, came_out, right), ``skipped``, ``config`` and ``host``.
    """
    console, root = Console(), output_folder(config.output_dir).resolve()
    wanted = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text())
    versions = {one.name.lower().replace("_", "-"): one.version for one in distributions()}
    rows: list[dict[str, Any]] = []
    skipped: list[str] = []
    for situation in wanted["situations"]:
        package = situation["package"]
        if package in skipped or (config.packages and package not in config.packages):
            continue
        if package not in versions:
            console.say(f"{package}: not installed, skipped")
            skipped.append(package)
            continue
        outcome = attempt(situation, wanted, root / f"{len(rows):02}", config.timeout_s)
        rows.append(
            {"package": package, "version": versions[package], "tried": situation["tried"], **outcome}
        )
        console.say(f"{package}, {situation['tried']}: {outcome['came_out']}")
    result = {"config": asdict(config), "host": host(), "rows": rows, "skipped": skipped}
    write(root, "third_party", result, as_markdown(COLUMNS, _rows(result)))
    return result


def attempt(
    situation: dict[str, Any], table: dict[str, Any], folder: Path, timeout_s: float
) -> dict[str, Any]:
    """Builds the policy and runs the commands: ``came_out`` and ``right``."""
    folder.mkdir()
    texts = table["texts"]
    commands = [[sys.executable, "-m", "accerl_lerobot.cli", *words(situation["command"], texts, folder)]]
    if "policy" in situation:
        try:
            write_policy(table["policies"][situation["policy"]], folder / "policy")
        except Exception as error:  # somebody else's package may fail in any way
            return {"came_out": f"no policy could be built: {error!r}"[:300], "right": False}
        commands[0].append(f"--policy.path={folder / 'policy'}")
    if "then" in situation:
        commands.append(words(situation["then"], texts, folder))
    code: int | None = 0
    printed = ""
    for command in commands:
        if code == 0:
            code, text = run(command, timeout_s)
            printed += text
    (folder / "log.txt").write_text(printed)
    right = code == situation.get("exit", 0)
    right = right and re.search(situation.get("prints", ""), printed) is not None
    right = right and re.search(situation.get("not_prints", PYTHON_ERROR), printed) is None
    return {"came_out": came_out(code, printed), "right": right}


def words(command: str, texts: dict[str, str], folder: Path) -> list[str]:
    """The arguments of a command in which names stand for texts."""
    while "$" in command:
        command = Template(command).substitute(texts)
    return [word.replace("{folder}", str(folder)) for word in shlex.split(command)]


def run(command: list[str], timeout_s: float) -> tuple[int | None, str]:
    """Exit code (None: no end in time) and output of a command."""
    environment = {name: value for name, value in os.environ.items() if name not in HIDDEN}
    environment["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), environment.get("PATH", "")])
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    try:
        done = subprocess.run(command, env=environment, timeout=timeout_s, check=False, **pipes)
    except subprocess.TimeoutExpired as error:
        return None, (error.stdout or b"").decode(errors="replace")
    return done.returncode, done.stdout.decode(errors="replace")


def came_out(code: int | None, printed: str) -> str:
    """The line of the error, or what was warned of."""
    lines = [line.strip() for line in printed.splitlines() if line.strip()]
    if code is None:
        return "no end within the time allowed"
    if code:
        errors = [line for line in lines if line.startswith("accerl: ")]
        return f"exit code {code}: {(errors or lines)[-1]}"
    warnings = [line for line in lines if line.startswith("WARNING accerl")]
    return "; ".join(["done", *dict.fromkeys(warnings)])


def write_policy(policy: dict[str, Any], folder: Path) -> None:
    """Saves a policy with random weights, and its processors, as a LeRobot ``pretrained_model`` folder."""
    import torch
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors
    from lerobot.utils.import_utils import register_third_party_plugins

    if policy["type"] not in PreTrainedConfig.get_known_choices():
        register_third_party_plugins()
    kind, cameras = policy["type"], [f"observation.images.{name}" for name in policy["cameras"]]
    sizes = policy["cameras"].values()
    visual = {
        k: PolicyFeature(FeatureType.VISUAL, (3, *size)) for k, size in zip(cameras, sizes, strict=True)
    }
    state = PolicyFeature(FeatureType.STATE, (policy["state"],))
    config = PreTrainedConfig.get_choice_class(kind)(
        input_features=visual | {"observation.state": state},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (policy["action"],))},
        device="cpu",
        push_to_hub=False,
        **{"chunk_size": 4, "n_action_steps": 4, "dim_model": 32, "n_heads": 2, "dim_feedforward": 64},
        **(turbovla_fields(folder.parent) if kind == "turbovla" else {"pretrained_backbone_weights": None}),
    )
    torch.manual_seed(0)
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(cameras, (3, 1, 1))
    shapes |= {"observation.state": (policy["state"],), "action": (policy["action"],)}
    values = {"mean": 0.0, "std": 0.5, "min": -1.0, "max": 1.0}
    stats = {key: {n: torch.full(shape, v) for n, v in values.items()} for key, shape in shapes.items()}
    for part in (get_policy_class(kind)(config), *make_pre_post_processors(config, dataset_stats=stats)):
        part.save_pretrained(folder)
    if "file" in policy:
        content = json.loads((folder / "config.json").read_text())
        (folder / "config.json").write_text(json.dumps(content | {"type": policy["file"]}))


def turbovla_fields(folder: Path) -> dict[str, Any]:
    """Fields of a small TurboVLA; its backbones' configs and its tokeniser are written into `folder`."""
    from transformers import BertConfig, BertTokenizer, Dinov2Config

    vision, language = str(folder / "vision"), str(folder / "language")
    small = {"hidden_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
    Dinov2Config(**small, patch_size=16, image_size=32).save_pretrained(vision)
    vocabulary = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", "match", "the", "target"]
    BertConfig(**small, intermediate_size=64, vocab_size=len(vocabulary)).save_pretrained(language)
    BertTokenizer(vocab={word: number for number, word in enumerate(vocabulary)}).save_pretrained(language)
    fields = {
        "load_pretrained_backbones": False,
        "image_size": 32,
        "n_fusion_layers": 1,
        "n_decoder_layers": 1,
    }
    return {"vision_backbone": vision, "language_backbone": language, **fields}


def table(result: dict[str, Any]) -> Table:
    """Rows for people."""
    return as_table("packages that other people published", COLUMNS, _rows(result))


def _rows(result: dict[str, Any]) -> list[list[str]]:
    names = ("package", "version", "tried", "came_out")
    rows = [[row[name] for name in names] + ["yes" if row["right"] else "no"] for row in result["rows"]]
    return rows + [[package, "not installed", "", "skipped", ""] for package in result["skipped"]]
