# SPDX-License-Identifier: Apache-2.0
"""Types of artifacts that are pushed and pulled, told by their files, and the fields of the two verbs.

Free of the Hub's client, which takes a second to import.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from accerl_lerobot.checkpoint import safety
from accerl_lerobot.checkpoint.layout import CHECKPOINTS, PREPROCESSOR, PRETRAINED, SUMMARY
from accerl_lerobot.checkpoint.layout import CONFIG as RECIPE
from accerl_lerobot.config.ranges import NewFolder, Pattern, Section
from accerl_lerobot.errors import InputError

POLICY, WORLD_MODEL, SUCCESS_MODEL = "policy", "world model", "success model"
DATASET, RUN = "dataset", "run"

CONFIG, WEIGHTS, POSTPROCESSOR = "config.json", "model.safetensors", "policy_postprocessor.json"
INFO, CARD = "meta/info.json", "README.md"
MANIFEST, MANIFEST_FORMAT = "accerl_manifest.json", 1
"""File that a push adds: sizes and SHA-256 of the others but the card, which people edit on the Hub. It
guards against accidents; whoever may write to the repository may write another manifest as well."""
RECORD = "accerl_pulled.json"
"""File that a pull adds: the commit that the others are from."""
LAST = f"checkpoints/last/{PRETRAINED}"
NEEDED = {
    POLICY: (CONFIG, WEIGHTS, PREPROCESSOR, POSTPROCESSOR),
    WORLD_MODEL: (CONFIG, WEIGHTS),
    SUCCESS_MODEL: (CONFIG, WEIGHTS),
    DATASET: (INFO, "meta/tasks.parquet", "meta/episodes", "data"),
    RUN: (RECIPE, SUMMARY, LAST),
}
"""Artifact type → files and folders that it has at least."""
CODEBASE_VERSION = "v3.0"
"""Version of LeRobotDatasets, and the tag under which LeRobot looks for them on the Hub."""
REPO_ID = r"(?=.{3,192}\Z)(?!.*\.\.)[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*"
RepoId = Annotated[str, Pattern(REPO_ID, "the name of a repository, user/name")]
RepoType = Literal["model", "dataset"]
REPO_TYPES: tuple[RepoType, ...] = ("model", "dataset")


@dataclass(frozen=True, kw_only=True)
class PushConfig(Section):
    """``accerl push``: a policy, world model, success model, dataset or whole run, as one commit."""

    path: Annotated[str, Pattern(r"(?s).+", "the name of the folder to push")] = ""
    """Folder to push; its type is told by its files."""
    repo_id: RepoId = ""
    """``user/name`` on the Hub; created if it does not exist."""
    revision: Annotated[str, Pattern(r".+", "a branch, or leave the field out")] = "main"
    """Existing branch."""
    private: bool = True
    """Keep the repository private. A public repository is written to only when this is false, and a private
    one stays private."""
    message: Annotated[str, Pattern(r"(?s).*\S.*", "some text")] | None = None
    """Commit message. None: names the type of the artifact."""
    include: list[str] = field(default_factory=list)
    """Folders of a run that are not pushed otherwise, such as ``[demos, sft, tensorboard]``."""
    evaluation: str | None = None
    """Folder or file that ``accerl eval`` wrote about this policy; its numbers go into the card. None: those
    of the policy's run."""


@dataclass(frozen=True, kw_only=True)
class PullConfig(Section):
    """``accerl pull``: an artifact from the Hub into a new folder, complete and checked or not at all."""

    repo_id: RepoId = ""
    """``user/name`` on the Hub."""
    revision: Annotated[str, Pattern(r".+", "a commit, tag or branch")] | None = None
    """Commit, tag or branch, which is resolved to a commit and recorded. None: the branch main."""
    repo_type: RepoType | None = None
    """model or dataset. None: whichever of them has this name."""
    output_dir: NewFolder = ""
    """Folder to create."""


def repo_type(artifact: str) -> RepoType:
    """Repository type for an artifact type."""
    return "dataset" if artifact == DATASET else "model"


def recognise(folder: Path, field: str = "path") -> str:
    """The artifact type of a complete folder; an unknown or incomplete one is refused, blaming `field`."""
    if not folder.is_dir():
        raise InputError(field, str(folder), "no such folder")
    artifact = _likely(folder)
    if artifact is None:
        raise InputError(field, str(folder), _hint(folder))
    missing = [name for name in NEEDED[artifact] if not (folder / name).exists()]
    if missing:
        remedy = f"looks like a {artifact} but lacks {', '.join(missing)}; name a complete folder"
        raise InputError(field, str(folder), remedy)
    version = read_json(folder / INFO).get("codebase_version") if artifact == DATASET else CODEBASE_VERSION
    if version != CODEBASE_VERSION:
        remedy = f"a LeRobotDataset of version {version}; convert it to {CODEBASE_VERSION} with LeRobot"
        raise InputError(field, str(folder), remedy)
    return artifact


def read_json(path: Path) -> dict[str, Any]:
    """The mapping in a JSON file; empty if there is none, or a pipe or device in its place."""
    try:
        return safety.read_json(path, safety.Origin("path", str(path)))
    except InputError:
        return {}


def _likely(folder: Path) -> str | None:
    if (folder / INFO).is_file():
        return DATASET
    config = read_json(folder / CONFIG)
    if {"spec", "model"} <= config.keys():
        return WORLD_MODEL
    if "type" in config:
        # LeRobot stores n_obs_steps in a policy's config, and nothing like it in a reward model's.
        return POLICY if "n_obs_steps" in config else SUCCESS_MODEL
    if (folder / CHECKPOINTS).is_dir() and (folder / RECIPE).is_file():
        return RUN
    return None


def _hint(folder: Path) -> str:
    for below in (PRETRAINED, "world_model"):
        if (folder / below).is_dir():
            return f"name the folder {below} in it"
    shapes = [f"a {artifact} has {', '.join(NEEDED[artifact])}" for artifact in NEEDED]
    return f"no known artifact: {'; '.join(shapes)}"
