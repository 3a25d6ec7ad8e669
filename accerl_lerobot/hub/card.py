# SPDX-License-Identifier: Apache-2.0
"""Types of artifacts that are pushed and pulled, the files that belong to each, and the card that tells them.

A number goes with a policy only if it was measured on it: a run's summary is about its last checkpoint, and
an evaluation names its policy. Also the fields of the two verbs.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from huggingface_hub import DatasetCard, ModelCard, ModelCardData

from accerl_lerobot.checkpoint import safety
from accerl_lerobot.checkpoint.layout import (
    AWAY,
    BACKBONE,
    BACKBONE_FILES,
    BACKBONE_WEIGHTS,
    CHECKPOINTS,
    FAST,
    PREPROCESSOR,
    PRETRAINED,
    SUMMARY,
)  # fmt: skip
from accerl_lerobot.checkpoint.layout import CONFIG as RECIPE
from accerl_lerobot.config.ranges import DatasetConfig, NewFolder, Pattern, Section
from accerl_lerobot.console import number
from accerl_lerobot.envs.base import lerobot_eval_arguments
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import discovery

POLICY, WORLD_MODEL, DATASET = "policy", "world model", "dataset"

CONFIG, WEIGHTS, POSTPROCESSOR = "config.json", "model.safetensors", "policy_postprocessor.json"
ADAPTER_CONFIG, ADAPTER = "adapter_config.json", "adapter_model.safetensors"
INFO, CARD = "meta/info.json", "README.md"
RECORD = "accerl_pulled.json"  # file that a pull adds: the commit that the others are from
NEEDED = {
    POLICY: (CONFIG, WEIGHTS, PREPROCESSOR, POSTPROCESSOR),
    WORLD_MODEL: (CONFIG, WEIGHTS),
    DATASET: (INFO, "meta/tasks.parquet", "meta/episodes", "data"),
}
CODEBASE_VERSION = "v3.0"
"""Version of LeRobotDatasets, and the tag under which LeRobot looks for them on the Hub."""
REPO_ID = r"(?=.{3,192}\Z)(?!.*\.\.)[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*"
RepoId = Annotated[str, Pattern(REPO_ID, "the name of a repository, user/name")]
RepoType = Literal["model", "dataset"]


@dataclass(frozen=True, kw_only=True)
class PushConfig(Section):
    """``accerl push``: a policy, a world model with its success model, or a dataset, as one commit."""

    path: Annotated[str, Pattern(r"(?s).+", "the name of the folder to push")] = ""
    """Folder to push; its type is told by its files."""
    repo_id: RepoId = ""
    """``user/name`` on the Hub; created if it does not exist."""
    private: bool = True
    """Keep the repository private. Only false writes to a public one, and a private one stays private."""
    evaluation: str | None = None
    """Folder or file that ``accerl eval`` wrote about this policy; its numbers go into the card. None: those
    of the policy's run."""


@dataclass(frozen=True, kw_only=True)
class PullConfig(Section):
    """``accerl pull``: an artifact from the Hub into a new folder, complete and checked or not at all."""

    repo_id: RepoId = ""
    """``user/name`` on the Hub; a model goes before a dataset of the same name."""
    revision: Annotated[str, Pattern(r".+", "a commit, tag or branch")] | None = None
    """Commit, tag or branch, which is resolved to a commit and recorded. None: the branch main."""
    output_dir: NewFolder = ""
    """Folder to create."""


def repo_type(artifact: str) -> RepoType:
    """Repository type for an artifact type."""
    return "dataset" if artifact == DATASET else "model"


def recognise(folder: Path, field: str = "path") -> str:
    """The artifact type of a complete folder; an unknown or incomplete one is refused, blaming `field`."""
    if not folder.is_dir():
        raise InputError(field, str(folder), "no such folder")
    artifact = likely([INFO] if (folder / INFO).exists() else [], read_json(folder / CONFIG))
    if artifact is None:
        raise InputError(field, str(folder), _hint(folder))
    if artifact == DATASET:
        from accerl_lerobot.demos.dataset_files import OLD_VERSION, another_version

        if OLD_VERSION.match(str(read_json(folder / INFO).get("codebase_version"))):
            old = DatasetConfig(repo_id="USER/NAME", root=str(folder))
            raise InputError(field, str(folder), another_version(old).hint)
    needed = (ADAPTER if name == WEIGHTS and is_adapter(folder) else name for name in NEEDED[artifact])
    missing = [name for name in needed if not (folder / name).exists()]
    if missing:
        hint = f"looks like a {artifact} but lacks {', '.join(missing)}; name a complete folder"
        raise InputError(field, str(folder), hint)
    return artifact


def is_adapter(folder: Path) -> bool:
    """True for an adapter of LeRobot's PEFT training, whose policy is elsewhere."""
    return (folder / ADAPTER_CONFIG).is_file() and not (folder / WEIGHTS).is_file()


def read_json(path: Path) -> dict[str, Any]:
    """The mapping in a JSON file; empty if there is none, or a pipe or device in its place."""
    try:
        return safety.read_json(path, safety.FileSource("path", str(path)))
    except InputError:
        return {}


def likely(names: Collection[str], config: dict[str, Any]) -> str | None:
    """The artifact type, by names of files at hand and the content of ``config.json``."""
    if INFO in names:
        return DATASET
    if {"spec", "model"} <= config.keys():
        return WORLD_MODEL
    # LeRobot stores n_obs_steps in a policy's config, and nothing like it in a reward model's.
    return POLICY if {"type", "n_obs_steps"} <= config.keys() else None


def _hint(folder: Path) -> str:
    last = f"{CHECKPOINTS}/last/{PRETRAINED}"
    for below in (last, f"sft/{last}", PRETRAINED, "world_model"):
        if (folder / below).is_dir():
            return f"name the folder {below} in it"
    shapes = [f"a {artifact} has {', '.join(NEEDED[artifact])}" for artifact in NEEDED]
    return f"no known artifact: {'; '.join(shapes)}"


Files = dict[str, Path | bytes]  # name in the repository → a file, or its content
FOLDER = "accerl_run"  # folder in which a policy or world model carries files of its run
EVALUATION, VALIDATION = "evaluation.json", "validation.json"
KEPT = {
    POLICY: (RECIPE, SUMMARY, EVALUATION, "success_curve.png", "success_by_task.png", "before_after.mp4"),
    WORLD_MODEL: (RECIPE, VALIDATION, "preview.mp4", "preview_online.mp4"),
    DATASET: (),
}
"""Artifact type → files of its run that go with it."""
CONTENTS = {
    POLICY: (
        CONFIG, "train_config.json", "model*.safetensors", "model.safetensors.index.json",
        ADAPTER_CONFIG, ADAPTER,
        "policy_*processor.json", "*processor_step_*.safetensors",
        "accerl.json", "value_head.safetensors", "family.safetensors",
        *(f"{BACKBONE}/{name}" for name in BACKBONE_FILES + BACKBONE_WEIGHTS),
        *(f"{FAST}/{name}" for name in BACKBONE_FILES + BACKBONE_WEIGHTS),
        *(f"{FOLDER}/{name}" for name in KEPT[POLICY]),
    ),
    WORLD_MODEL: (
        CONFIG, WEIGHTS,
        *(f"{FOLDER}/{name}" for name in KEPT[WORLD_MODEL]),
    ),
    DATASET: ("meta/*", "meta/*/*/*.parquet", "data/*/*.parquet", "videos/*/*/*.mp4"),
}  # fmt: skip
"""Artifact type → its files, the only ones that are pushed beside a card and a licence."""
MARK = "<!-- Written by accerl push, and anew each time. Delete this line to keep what you change. -->"


def run_files(folder: Path, artifact: str, evaluation: str | None) -> dict[str, Path]:
    """Name in the repository → file of the run of a folder, if it lies in one, and of an evaluation.

    `evaluation` is a folder or file of ``accerl eval``; one of another policy is refused.
    """
    files: dict[str, Path] = {}
    home = None if (folder / FOLDER).is_dir() else _run_of(folder.resolve(), artifact)
    if home is not None:
        measured = artifact != POLICY or _is_last(folder.resolve().parent.name, home)
        names = KEPT[artifact] if measured else (RECIPE,)
        for name, path in safety.matching_files(home, names, safety.FileSource("path", str(folder))).items():
            files[f"{FOLDER}/{name}"] = path
    if evaluation is not None:
        if artifact != POLICY:
            raise InputError("evaluation", evaluation, f"only a policy is evaluated, this is a {artifact}")
        path = Path(evaluation).expanduser()
        path = path / EVALUATION if path.is_dir() else path
        _check_evaluation(path, folder)
        files[f"{FOLDER}/{EVALUATION}"] = path
    return files


def _run_of(folder: Path, artifact: str) -> Path | None:
    """The folder of the run, or of the training of a world model, in which a folder lies."""
    if artifact == POLICY and folder.name == PRETRAINED and folder.parents[1].name == CHECKPOINTS:
        home, sign = folder.parents[2], RECIPE
    elif artifact == WORLD_MODEL:
        home, sign = folder.parent, VALIDATION
    else:
        return None
    return home if (home / sign).is_file() else None


def _is_last(step: str, run: Path) -> bool:
    """True if the checkpoint of a step is the one that the run's summary is about."""
    return step.isdigit() and int(step) == read_json(run / SUMMARY).get("updates")


def _check_evaluation(path: Path, policy: Path) -> None:
    content = read_json(path)
    if "success" not in content or "ci95" not in content:
        raise InputError("evaluation", str(path), "not a file of accerl eval; name its output_dir")
    if Path(str(content.get("policy"))).expanduser().resolve() != policy.resolve():
        raise InputError("evaluation", str(path), f"it is of another policy, {content.get('policy')}")


def model_card(repo_id: str, artifact: str, folder: Path, files: Files) -> str:
    """README.md of a model repository; pictures and videos among `files` are shown."""
    recipe_text = _carried(files, RECIPE)
    recipe = yaml.safe_load(recipe_text) or {}
    summary = json.loads(_carried(files, SUMMARY) or "{}")
    config = read_json(folder / CONFIG)
    env = dict(recipe.get("env") or {})
    env.pop("assets", None)
    tags = ["accerl-lerobot", artifact.replace(" ", "-"), config.get("type"), env.get("type")]
    if summary:
        tags += ["reinforcement-learning", (recipe.get("algorithm") or {}).get("type")]
    data = ModelCardData(
        library_name="lerobot",
        pipeline_tag="robotics",
        tags=list(dict.fromkeys(str(tag) for tag in tags if tag)),
        datasets=_datasets(recipe) or None,
        base_model=_base_model(recipe),
    )
    local = repo_id.split("/")[1]
    card = ModelCard.from_template(
        data,
        template_str=Path(__file__).with_name("card.md.jinja").read_text(),
        mark=MARK,
        repo_id=repo_id,
        local=local,
        artifact=artifact,
        config=config,
        measurements=_measurements(summary, json.loads(_carried(files, EVALUATION) or "{}")),
        summary=summary,
        validation=json.loads(_carried(files, VALIDATION) or "{}"),
        number=number,
        shown=sorted(name for name in files if name.startswith(f"{FOLDER}/")),
        recipe=recipe_text,
        recipe_path=f"{local}/{FOLDER}/{RECIPE}",
        learns_online=bool(env),  # only runs of `accerl offline` have no environment
        stock=lerobot_eval_command(local, config, env),
        # With one of its own, LeRobot finds the backbone only once a pull has set its place.
        has_backbone=str(config.get("vlm_model_name") or "").startswith(("/", BACKBONE)),
    )
    return f"{card}\n"


def _carried(files: Files, name: str) -> str:
    """Text of a record of the run that goes with a folder; empty if there is none."""
    content = files.get(f"{FOLDER}/{name}", b"")
    return content.read_text() if isinstance(content, Path) else content.decode()


def lerobot_eval_command(policy: str, config: Mapping[str, Any], env: Mapping[str, Any]) -> str | None:
    """Stock LeRobot's evaluation of a policy with this config.json in this environment of a recipe."""
    stock = lerobot_eval_arguments(env)
    if not stock:
        return None
    flags = [f"--policy.path={policy}", *discovery(config.get("type")), *stock]
    return f"lerobot-eval {' '.join(flags)} --eval.n_episodes=50 --eval.batch_size=5"


def dataset_card(repo_id: str, folder: Path) -> str:
    """README.md of a LeRobotDataset: LeRobot's own card, and how to use it here."""
    from lerobot.datasets.io_utils import load_info
    from lerobot.datasets.utils import create_lerobot_dataset_card

    command = f"accerl sft --config_path=RECIPE --dataset.repo_id={repo_id}"
    card: DatasetCard = create_lerobot_dataset_card(
        tags=["accerl-lerobot"],
        dataset_info=load_info(folder),
        repo_id=repo_id,
        dataset_description=f"```bash\n{command}\n```",
    )
    head, _, body = str(card).partition("\n---\n")
    return f"{head}\n---\n\n{MARK}\n{body}"


def _datasets(recipe: Mapping[str, Any]) -> list[str]:
    sections = [recipe.get(name) or {} for name in ("dataset", "online")]
    # Beside a folder the name is a label, and no dataset on the Hub.
    return [section["repo_id"] for section in sections if section.get("repo_id") and not section.get("root")]


def _base_model(recipe: Mapping[str, Any]) -> str | None:
    for name in ((recipe.get("policy") or {}).get("path"), (recipe.get("sft") or {}).get("init_path")):
        if name and re.fullmatch(REPO_ID, name) and not name.startswith(f"{AWAY}/"):
            return str(name)
    return None


def _measurements(
    summary: dict[str, Any], evaluation: dict[str, Any]
) -> list[tuple[str, str, dict[str, Any]]]:
    """(when, task, {success, n, ci95}) of every measurement: all tasks together first, then each."""
    sources = []
    for when in ("before", "after"):
        if summary.get(f"success_{when}") is not None:
            result = {key: summary.get(f"{key}_{when}") for key in ("success", "n", "ci95", "tasks")}
            sources.append((f"{when} RL", result))
    if evaluation:
        sources.append(("accerl eval", evaluation))
    rows = []
    for when, result in sources:
        tasks = result.get("tasks") or {}
        rows.append((when, next(iter(tasks)) if len(tasks) == 1 else "all tasks", result))
        if len(tasks) > 1:
            rows += [(when, task, each) for task, each in tasks.items()]
    return rows
