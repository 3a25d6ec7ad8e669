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
from typing import Annotated, Any

import yaml
from huggingface_hub import ModelCard, ModelCardData

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
from accerl_lerobot.config.ranges import NewFolder, Pattern, Section
from accerl_lerobot.console import number
from accerl_lerobot.envs.base import lerobot_eval_arguments
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import discovery

POLICY = "policy"
WORLD_MODEL = "world model"
DATASET = "dataset"

CONFIG = "config.json"
WEIGHTS = "model.safetensors"
ADAPTER_CONFIG = "adapter_config.json"
ADAPTER = "adapter_model.safetensors"
INFO = "meta/info.json"
CARD = "README.md"
EVALUATION = "evaluation.json"
VALIDATION = "validation.json"
RECORD = "accerl_pulled.json"  # file that a pull adds: the commit that the others are from
FOLDER = "accerl_run"  # folder in which a policy or world model carries files of its run
NEEDED = {
    POLICY: (CONFIG, WEIGHTS, PREPROCESSOR, "policy_postprocessor.json"),
    WORLD_MODEL: (CONFIG, WEIGHTS),
    DATASET: (INFO, "meta/tasks.parquet", "meta/episodes", "data"),
}
KEPT = {
    POLICY: (RECIPE, SUMMARY, EVALUATION, "success_curve.png", "before_after.mp4"),
    WORLD_MODEL: (RECIPE, VALIDATION, "preview.mp4"),
    DATASET: (),
}
"""Artifact type → files of its run that go with it."""
OF_BACKBONE = BACKBONE_FILES + BACKBONE_WEIGHTS
CONTENTS = {
    POLICY: (
        CONFIG, "train_config.json", "model*.safetensors", "model.safetensors.index.json",
        ADAPTER_CONFIG, ADAPTER,
        "policy_*processor.json", "*processor_step_*.safetensors",
        "value_head.safetensors", "family.safetensors",
        *(f"{BACKBONE}/{name}" for name in OF_BACKBONE),
        *(f"{FAST}/{name}" for name in OF_BACKBONE),
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
REPO_ID = r"(?=.{3,192}\Z)(?!.*\.\.)[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*"
RepoId = Annotated[str, Pattern(REPO_ID, "the name of a repository, user/name")]
Files = dict[str, Path | bytes]  # name in the repository → a file, or its content


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


def recognise(folder: Path, field: str = "path") -> str:
    """The artifact type of a complete folder; an unknown or incomplete one is refused, blaming `field`."""
    if not folder.is_dir():
        raise InputError(field, str(folder), "no such folder")
    config = read_json(folder / CONFIG)
    if (folder / INFO).exists():
        artifact = DATASET
    elif {"spec", "model"} <= config.keys():
        artifact = WORLD_MODEL
    elif {"type", "n_obs_steps"} <= config.keys():  # a reward model's config has no n_obs_steps
        artifact = POLICY
    else:
        raise InputError(field, str(folder), _hint(folder))
    needed = list(NEEDED[artifact])
    # LeRobot's PEFT training writes an adapter, whose policy is elsewhere.
    if artifact == POLICY and (folder / ADAPTER_CONFIG).is_file():
        needed[needed.index(WEIGHTS)] = ADAPTER
    missing = [name for name in needed if not (folder / name).exists()]
    if missing:
        hint = f"looks like a {artifact} but lacks {', '.join(missing)}; name a complete folder"
        raise InputError(field, str(folder), hint)
    return artifact


def _hint(folder: Path) -> str:
    last = f"{CHECKPOINTS}/last/{PRETRAINED}"
    for below in (last, f"sft/{last}", PRETRAINED, "world_model"):
        if (folder / below).is_dir():
            return f"name the folder {below} in it"
    return "neither a policy, a world model nor a LeRobotDataset v3.0; name the folder of one"


def read_json(path: Path) -> dict[str, Any]:
    """The mapping in a JSON file; empty if there is none, or a pipe or device in its place."""
    try:
        return safety.read_json(path, safety.FileSource("path", str(path)))
    except InputError:
        return {}


def run_files(folder: Path, artifact: str, evaluation: str | None) -> dict[str, Path]:
    """Name in the repository → file of the run of a folder, if it lies in one, and of an evaluation.

    `evaluation` is a folder or file of ``accerl eval``; one of another policy is refused.
    """
    files: dict[str, Path] = {}
    run, names = _kept(folder, artifact)
    source = safety.FileSource("path", str(folder))
    for name, path in safety.matching_files(run, names, source).items():
        files[f"{FOLDER}/{name}"] = path
    if evaluation is not None:
        files[f"{FOLDER}/{EVALUATION}"] = _evaluation(folder, evaluation)
    return files


def _kept(folder: Path, artifact: str) -> tuple[Path, Collection[str]]:
    """Folder of the run that a folder lies in, and the names of the run's files that go with it."""
    run = folder.resolve().parent
    if (folder / FOLDER).is_dir():  # it carries files of its run already
        return run, ()
    if artifact == WORLD_MODEL and (run / VALIDATION).is_file():
        return run, KEPT[WORLD_MODEL]
    if artifact == POLICY and run.parent.name == CHECKPOINTS:
        step = run.name
        run = run.parents[1]
        if step.isdigit() and int(step) == read_json(run / SUMMARY).get("updates"):
            return run, KEPT[POLICY]
        return run, (RECIPE,)
    return run, ()


def _evaluation(folder: Path, given: str) -> Path:
    """The file that ``accerl eval`` wrote about the policy in a folder."""
    path = Path(given).expanduser()
    if path.is_dir():
        path = path / EVALUATION
    policy = read_json(path).get("policy")
    if policy is None or Path(policy).expanduser().resolve() != folder.resolve():
        hint = f"not an evaluation of {folder}; name the output_dir of accerl eval"
        raise InputError("evaluation", str(path), hint)
    return path


def model_card(repo_id: str, artifact: str, folder: Path, files: Files) -> str:
    """README.md of a model repository; pictures and videos among `files` are shown."""
    texts = {}
    for name in (RECIPE, SUMMARY, EVALUATION, VALIDATION):
        content = files.get(f"{FOLDER}/{name}", b"")
        assert isinstance(content, bytes)  # see `transfer.without_paths`
        texts[name] = content.decode()
    recipe = yaml.safe_load(texts[RECIPE]) or {}
    summary = json.loads(texts[SUMMARY] or "{}")
    config = read_json(folder / CONFIG)
    env = {name: value for name, value in (recipe.get("env") or {}).items() if name != "assets"}
    tags = ["accerl-lerobot", artifact.replace(" ", "-"), config.get("type"), env.get("type")]
    if summary:
        tags += ["reinforcement-learning", summary.get("algorithm")]
    local = repo_id.split("/")[1]
    renames = (recipe.get("policy") or {}).get("rename_map") or {}
    card = ModelCard.from_template(
        ModelCardData(
            library_name="lerobot",
            pipeline_tag="robotics",
            tags=[tag for tag in tags if tag],
            datasets=_datasets(recipe),
            base_model=_base_model(recipe),
        ),
        template_str=Path(__file__).with_name("card.md.jinja").read_text(),
        mark=MARK,
        repo_id=repo_id,
        local=local,
        artifact=artifact,
        config=config,
        summary=summary,
        evaluation=json.loads(texts[EVALUATION] or "{}"),
        validation=json.loads(texts[VALIDATION] or "{}"),
        number=number,
        shown=sorted(name for name in files if name.startswith(f"{FOLDER}/")),
        recipe=texts[RECIPE],
        recipe_path=f"{local}/{FOLDER}/{RECIPE}",
        learns_online=bool(env),  # only runs of `accerl offline` have no environment
        stock=lerobot_eval_command(local, config, env, renames),
        # With one of its own, LeRobot finds the backbone only once a pull has set its place.
        has_backbone=str(config.get("vlm_model_name") or "").startswith(("/", BACKBONE)),
    )
    return f"{card}\n"


def lerobot_eval_command(
    policy: str, config: Mapping[str, Any], env: Mapping[str, Any], renames: Mapping[str, str]
) -> str | None:
    """Stock LeRobot's evaluation of a policy with this config.json in this environment of a recipe.

    `renames` is the recipe's ``policy.rename_map``.
    """
    stock = lerobot_eval_arguments(env, renames)
    if not stock:
        return None
    flags = [f"--policy.path={policy}", *discovery(config.get("type")), *stock]
    return f"lerobot-eval {' '.join(flags)} --eval.n_episodes=50 --eval.batch_size=5"


def dataset_card(repo_id: str, folder: Path) -> str:
    """README.md of a LeRobotDataset: LeRobot's own card, and how to use it here."""
    from lerobot.datasets.io_utils import load_info
    from lerobot.datasets.utils import create_lerobot_dataset_card

    command = f"accerl sft --config_path=RECIPE --dataset.repo_id={repo_id}"
    card = create_lerobot_dataset_card(
        tags=["accerl-lerobot"],
        dataset_info=load_info(folder),
        repo_id=repo_id,
        dataset_description=f"{MARK}\n\n```bash\n{command}\n```",
    )
    return str(card)


def _datasets(recipe: Mapping[str, Any]) -> list[str] | None:
    """The dataset of a run on the Hub; beside a folder the name is a label."""
    dataset = recipe.get("dataset") or {}
    if dataset.get("root") or not dataset.get("repo_id"):
        return None
    return [dataset["repo_id"]]


def _base_model(recipe: Mapping[str, Any]) -> str | None:
    """The policy on the Hub that a run began with; a folder may look like one, such as ``outputs/door``."""
    policy = recipe.get("policy") or {}
    sft = recipe.get("sft") or {}
    name = str(policy.get("path") or sft.get("init_path"))
    if name.startswith(f"{AWAY}/") or Path(name).is_dir():
        return None
    if not re.fullmatch(REPO_ID, name):
        return None
    return name
