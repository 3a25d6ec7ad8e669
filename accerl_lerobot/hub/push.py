# SPDX-License-Identifier: Apache-2.0
"""Upload a folder to the Hub as one commit, without the paths of this machine.

Large files go first, each under its hash, and the commit that names them last: an interrupted push leaves the
repository as it was, and the next one uploads only what the Hub does not have yet. That is why this is
``create_commit``: ``upload_folder`` makes several commits, each of which others see. A commit names its
parent, so two pushes at a time do not mix.
"""

from __future__ import annotations

import contextlib
import json
import logging
import re
from pathlib import Path, PurePosixPath
from typing import Any

import yaml
from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi, get_token, hf_hub_download
from huggingface_hub.errors import RepositoryNotFoundError, RevisionNotFoundError
from huggingface_hub.utils import filter_repo_objects

from accerl_lerobot.checkpoint import layout
from accerl_lerobot.checkpoint.safety import FileSource, matching_files
from accerl_lerobot.errors import InputError, expanded, reading
from accerl_lerobot.hub import card
from accerl_lerobot.hub.errors import LOGIN, hub_errors

logger = logging.getLogger(__name__)

BRANCH = "main"
VOCABULARIES = ("tokenizer.json", "vocab.json", "added_tokens.json", "special_tokens_map.json")
PATH = re.compile(r"(--[\w.]+=)?(~|/[^/\n]+)/[^\n]*")
"""A path, alone or given to an argument: ``~`` or a folder at the top, and something below it."""


def push(config: card.PushConfig) -> dict[str, Any]:
    """Pushes a folder; returns what was pushed and the new commit, as plain JSON.

    If it is refused, or fails, the repository is as before.
    """
    folder = expanded(config.path, "path")
    artifact = card.recognise(folder)
    with reading("path", config.path, "a file of it, or of its run,"):
        files = stage(config, folder, artifact)
    if get_token() is None:
        raise InputError("repo_id", config.repo_id, f"pushing needs a token; {LOGIN} that may write")
    with hub_errors(config.repo_id, BRANCH):
        return _upload(config, artifact, files)


def stage(config: card.PushConfig, folder: Path, artifact: str) -> card.Files:
    """All files to upload, with a card."""
    files = contents(folder, artifact)
    for name, path in card.run_files(folder, artifact, config.evaluation).items():
        files[name] = scrubbed(name, path)
    own = matching_files(folder, [card.CARD], FileSource("path", str(folder))).get(card.CARD)
    if own is not None and card.MARK not in own.read_text():
        files[card.CARD] = own
    elif artifact == card.DATASET:
        files[card.CARD] = card.dataset_card(config.repo_id, folder).encode()
    else:
        files[card.CARD] = card.model_card(config.repo_id, artifact, folder, files).encode()
    return files


def _upload(config: card.PushConfig, artifact: str, files: card.Files) -> dict[str, Any]:
    api, repo_id = HfApi(), config.repo_id
    where: dict[str, Any] = {"repo_id": repo_id, "repo_type": card.repo_type(artifact)}
    parent = _parent(api, config, where)
    listed = set(api.list_repo_files(revision=parent, **where))

    def fetched(name: str) -> Path:
        return Path(hf_hub_download(filename=name, revision=parent, **where))

    there = card.read_json(fetched(card.CONFIG)) if card.CONFIG in listed else {}
    held = card.likely(listed, there)
    if held not in (None, artifact):
        hint = f"it holds a {held}, and this is a {artifact}; choose another name"
        raise InputError("repo_id", repo_id, hint)
    if card.CARD in listed and _is_ours(files[card.CARD]) and not _is_ours(fetched(card.CARD)):
        logger.warning("the README.md on the Hub is left as it is, somebody wrote it")
        del files[card.CARD]
    ours = filter_repo_objects(sorted(listed), allow_patterns=list(card.CONTENTS[artifact]))
    stale = [name for name in ours if name not in files]
    if stale:
        logger.warning("deleted on the Hub, as not in this push: %s", ", ".join(stale))
    operations = [CommitOperationAdd(name, content) for name, content in files.items()]
    operations += [CommitOperationDelete(name, is_folder=False) for name in stale]
    message = f"{artifact.capitalize()} pushed with accerl-lerobot"
    commit = api.create_commit(
        operations=operations, commit_message=message, revision=BRANCH, parent_commit=parent, **where
    ).oid
    if artifact == card.DATASET:  # LeRobot looks for a dataset under the version of its format
        with contextlib.suppress(RevisionNotFoundError):
            api.delete_tag(tag=card.CODEBASE_VERSION, **where)
        api.create_tag(tag=card.CODEBASE_VERSION, revision=commit, **where)
    return {
        "kind": artifact,
        **where,
        "commit": commit,
        "unchanged": commit == parent,
        "private": bool(api.repo_info(**where).private),
        "files": len(files),
        "url": f"{api.endpoint}/{'datasets/' if artifact == card.DATASET else ''}{repo_id}",
    }


def _is_ours(text: Path | bytes) -> bool:
    """True for a card that a push has written, and an empty one."""
    content = text if isinstance(text, bytes) else text.read_bytes()
    return card.MARK.encode() in content or not content.strip()


def _parent(api: HfApi, config: card.PushConfig, where: dict[str, Any]) -> str | None:
    """The commit to go on top of; the repository is created if need be."""
    try:
        info = api.repo_info(**where)
    except RepositoryNotFoundError:
        api.create_repo(**where, private=config.private, exist_ok=True)
        info = api.repo_info(**where)
    if config.private and info.private is False:
        hint = "this repository is public: add --private=false, or choose another name"
        raise InputError("private", True, hint)
    return info.sha


def contents(folder: Path, artifact: str) -> card.Files:
    """Files of a folder that are pushed, without paths of this machine.

    Their names are those of the artifact's type. A link that leads out is refused, and so is a policy without
    its backbone.
    """
    source = FileSource("path", str(folder))
    files: card.Files = {**matching_files(folder, (*card.CONTENTS[artifact], "LICENSE*"), source)}
    known = {*files, card.CARD, card.RECORD}
    others = {path.name for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")}
    if not others <= known:
        left = ", ".join(sorted(others - known))
        logger.warning("not pushed, as no part of a %s: %s", artifact, left)
    if artifact == card.POLICY:
        if (folder / card.RECORD).is_file():
            layout.check_names(folder, source)
        _bring_backbone(files, folder)
        if card.is_adapter(folder):
            _check_base(folder)
    return {name: scrubbed(name, content) for name, content in files.items()}


def _bring_backbone(files: card.Files, folder: Path) -> None:
    """Points a policy at the backbone beside it, which is copied there if it is elsewhere on this machine."""
    config = card.read_json(folder / card.CONFIG)
    processor = card.read_json(folder / layout.PREPROCESSOR)
    elsewhere = Path(config.get("vlm_model_name") or "")
    if elsewhere.is_absolute() and not (folder / layout.BACKBONE).is_dir():
        # The policy's own file holds its weights, unless LeRobot builds it from the backbone's.
        weights = layout.BACKBONE_WEIGHTS if config.get("load_vlm_weights") else ()
        source = FileSource("path", str(elsewhere))
        for name, path in matching_files(elsewhere, layout.BACKBONE_FILES + weights, source).items():
            files[f"{layout.BACKBONE}/{name}"] = path
    for fields, key, own in layout.places_of_names(config, processor):
        named = fields.get(key) or ""
        if not Path(named).is_absolute():
            continue
        if not any(name.startswith(f"{own}/") for name in files):
            hint = f"put a copy into {layout.BACKBONE}/ beside {card.CONFIG}"
            raise InputError("path", str(folder), f"it needs {named}, which is not in it; {hint}")
        fields[key] = own
        files[card.CONFIG] = _as_json(config)
        files[layout.PREPROCESSOR] = _as_json(processor)


def _check_base(folder: Path) -> None:
    """Refuses an adapter of a policy that is on this machine, or that it does not name."""
    base = card.read_json(folder / card.ADAPTER_CONFIG).get("base_model_name_or_path")
    if not re.fullmatch(card.REPO_ID, str(base)) or Path(str(base)).exists():
        why = (
            f"it is an adapter of {base!r}, which others cannot load; push that policy first, then write its"
        )
        hint = f"{why} name on the Hub into {card.ADAPTER_CONFIG} as base_model_name_or_path"
        raise InputError("path", str(folder), hint)


def scrubbed(name: str, content: Path | bytes) -> Path | bytes:
    """A JSON or YAML file without paths of this machine, as bytes; any other file as it is.

    Of a path only the last name is kept. Vocabularies may hold any text.
    """
    path = PurePosixPath(name)
    if path.suffix not in (".json", ".yaml") or path.name in VOCABULARIES:
        return content
    data = content if isinstance(content, bytes) else content.read_bytes()
    tree = json.loads(data) if path.suffix == ".json" else yaml.safe_load(data)
    without = _without_paths(tree)
    if without == tree:
        return data
    if path.suffix == ".json":
        return _as_json(without)
    return yaml.safe_dump(without, sort_keys=False).encode()


def _without_paths(value: Any) -> Any:
    if isinstance(value, dict):
        tree = {key: _without_paths(below) for key, below in value.items()}
        if tree.get("output_dir") != value.get("output_dir"):
            tree["output_dir"] = None  # whoever repeats the run chooses a folder
        return tree
    if isinstance(value, list):
        return [_without_paths(below) for below in value]
    match = PATH.fullmatch(value) if isinstance(value, str) else None
    if match is None:
        return value
    return f"{match[1] or ''}{layout.AWAY}/{PurePosixPath(value).name}"


def _as_json(tree: Any) -> bytes:
    return (json.dumps(tree, indent=4, ensure_ascii=False) + "\n").encode()
