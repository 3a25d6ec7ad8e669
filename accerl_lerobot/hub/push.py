# SPDX-License-Identifier: Apache-2.0
"""Upload a folder to the Hub as one commit, without the paths of this machine.

Large files go first, each under its hash, and the commit that names them last: an interrupted push leaves the
repository as it was, and the next one uploads only what the Hub does not have yet. A commit names its parent,
so two pushes at a time do not mix.
"""

from __future__ import annotations

import json
import logging
import re
from pathlib import Path, PurePosixPath
from typing import Any

import yaml
from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi, get_token, hf_hub_download
from huggingface_hub.errors import RepositoryNotFoundError

from accerl_lerobot.checkpoint import layout
from accerl_lerobot.checkpoint.safety import FileSource, matching_files
from accerl_lerobot.errors import InputError, reading
from accerl_lerobot.hub import card
from accerl_lerobot.hub.errors import LOGIN, check_commit, hub_errors

logger = logging.getLogger(__name__)

BRANCH = "main"
NOT_CONTENTS = (card.CARD, card.RECORD, ".gitattributes")
PICTURES = (".png", ".jpg", ".gif", ".svg", ".mp4")
"""Endings of files that a card may show, which somebody may have added on the Hub."""
FOLDERS = (card.FOLDER, layout.BACKBONE, "success_model", "meta", "data", "videos", "images")
"""Top folders of what is pushed."""
RECORDS = (".json", ".jsonl", ".yaml", ".yml", ".md", ".txt", ".log", ".csv", ".html")
VOCABULARIES = ("tokenizer.json", "vocab.json", "merges.txt", "added_tokens.json", "special_tokens_map.json")
PATH = re.compile(r"(?<![\w:/.~}>\-])(?:~|)(?:/[\w.+@%,\-]+){2,}/?")
"""At least two names after a slash that nothing precedes which would make it a URL or a quotient."""
ROOTS = (
    "home", "Users", "root", "tmp", "mnt", "data", "workspace", "var", "srv", "opt", "private", "scratch",
)  # fmt: skip
"""Top folders of other machines, from where a file may have come here."""


def push(config: card.PushConfig) -> dict[str, Any]:
    """Pushes a folder; returns what was pushed and the new commit, as plain JSON.

    If it is refused, or fails, the repository is as before.
    """
    folder, repo_id = Path(config.path).expanduser(), config.repo_id
    artifact = card.recognise(folder)
    with reading("path", config.path, "a file of it, or of its run,"):
        files, own_card = stage(config, folder, artifact)
    if get_token() is None:
        raise InputError("repo_id", repo_id, f"pushing needs a token; {LOGIN} that may write")
    with hub_errors(repo_id, BRANCH, writing=True):
        return _upload(config, artifact, files, own_card)


def stage(config: card.PushConfig, folder: Path, artifact: str) -> tuple[card.Files, bool]:
    """All files to upload, and True if the card among them is the user's own."""
    provenance = card.find_provenance(folder, artifact, config.evaluation)
    files = contents(folder, artifact)
    for name, path in provenance.files.items():
        files[name] = scrubbed(name, path.read_bytes(), folder) if is_record(name) else path
    repo_id = config.repo_id
    readme = matching_files(folder, [card.CARD], FileSource("path", str(folder))).values()
    own = any(card.MARK not in path.read_text() for path in readme)
    if own:
        (path,) = readme
        text = path.read_text()
    elif artifact == card.DATASET:
        text = card.dataset_card(repo_id, folder)
    else:
        text = card.model_card(repo_id, artifact, folder, files, provenance)
    files[card.CARD] = scrubbed(card.CARD, text.encode(), folder)
    return files, own


def _upload(config: card.PushConfig, artifact: str, files: card.Files, own_card: bool) -> dict[str, Any]:
    api, repo_id = HfApi(), config.repo_id
    where: dict[str, Any] = {"repo_id": repo_id, "repo_type": card.repo_type(artifact)}
    parent = _parent(api, config, artifact)
    listed = set(api.list_repo_files(revision=parent, **where))

    def fetched(name: str) -> Path:
        return Path(hf_hub_download(filename=name, revision=parent, **where))

    if card.CARD in listed and not own_card:
        readme = fetched(card.CARD).read_bytes()
        if card.MARK.encode() not in readme and readme.strip():
            logger.warning("the README.md on the Hub is left as it is, somebody wrote it")
            files[card.CARD] = readme
    theirs = {name for name in listed if "/" in name or not name.endswith((*PICTURES, *NOT_CONTENTS))}
    there = card.read_json(fetched(card.CONFIG)) if card.CONFIG in listed else {}
    if theirs and (kind := card.likely(theirs, there)) != artifact:
        held = f"a {kind}" if kind else "other files"
        raise InputError(
            "repo_id", repo_id, f"it holds {held}, and this is a {artifact}; choose another name"
        )
    stale = sorted(name for name in theirs - files.keys() if _ours(name))
    if stale:
        logger.warning("deleted on the Hub, as not in this push: %s", ", ".join(stale))
    operations = [CommitOperationAdd(name, content) for name, content in files.items()]
    operations += [CommitOperationDelete(name, is_folder=False) for name in stale]
    message = f"{artifact.capitalize()} pushed with accerl-lerobot"
    commit = api.create_commit(
        operations=operations, commit_message=message, revision=BRANCH, parent_commit=parent, **where
    ).oid
    if artifact == card.DATASET:
        _tag(api, where, commit)
    sizes = (len(file) if isinstance(file, bytes) else file.stat().st_size for file in files.values())
    return {
        "kind": artifact,
        **where,
        "commit": commit,
        "unchanged": commit == parent,
        "private": bool(api.repo_info(**where).private),
        "files": len(files),
        "bytes": sum(sizes),
        "url": f"{api.endpoint}/{'datasets/' if artifact == card.DATASET else ''}{repo_id}",
    }


def _ours(name: str) -> bool:
    """True for a file such as a push writes; others, a licence or a notebook, somebody added on the Hub."""
    folder, _, below = name.partition("/")
    return folder in FOLDERS if below else name.endswith((".json", ".jsonl", ".yaml", ".safetensors"))


def _parent(api: HfApi, config: card.PushConfig, artifact: str) -> str:
    """The commit to go on top of; the repository is created if need be."""
    repo_id, kind = config.repo_id, card.repo_type(artifact)
    try:
        info = api.repo_info(repo_id, repo_type=kind)
    except RepositoryNotFoundError:
        (other,) = set(card.REPO_TYPES) - {kind}
        if api.repo_exists(repo_id, repo_type=other):
            hint = f"it is a {other} repository, and this is a {artifact}; choose another name"
            raise InputError("repo_id", repo_id, hint) from None
        api.create_repo(repo_id, private=config.private, repo_type=kind, exist_ok=True)
        info = api.repo_info(repo_id, repo_type=kind)
    if config.private and info.private is False:
        hint = "this repository is public: add --private=false, or choose another name"
        raise InputError("private", True, hint)
    return check_commit(info.sha)


def _tag(api: HfApi, where: dict[str, Any], commit: str) -> None:
    """Tags a commit with the version of the dataset's format, under which LeRobot looks for it."""
    tags = {tag.name: tag.target_commit for tag in api.list_repo_refs(**where).tags}
    if tags.get(card.CODEBASE_VERSION) != commit:
        if card.CODEBASE_VERSION in tags:
            api.delete_tag(tag=card.CODEBASE_VERSION, **where)
        api.create_tag(tag=card.CODEBASE_VERSION, revision=commit, **where)


def contents(folder: Path, artifact: str) -> card.Files:
    """Files of a folder that are pushed, without paths of this machine.

    Their names are those of the artifact's type. A link that leads out is refused, and so is a policy without
    its backbone.
    """
    origin = FileSource("path", str(folder))
    patterns = (*card.CONTENTS[artifact], "LICENSE*")
    files: card.Files = {**matching_files(folder, patterns, origin)}
    others = [path.name for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    if left := sorted(set(others) - files.keys() - set(NOT_CONTENTS)):
        logger.warning("not pushed, as no part of a %s: %s", artifact, ", ".join(left))
    if artifact == card.POLICY:
        if (folder / card.RECORD).is_file():
            layout.check_names(folder, origin)
        _bring_backbone(files, folder)
        if card.is_adapter(folder):
            _check_base(folder)
    for name, content in files.items():
        if is_record(name):
            data = content if isinstance(content, bytes) else content.read_bytes()
            files[name] = scrubbed(name, data, folder)
    return files


def _bring_backbone(files: card.Files, home: Path) -> None:
    """Points a policy at the backbone beside it, which is copied there if it is elsewhere on this machine."""
    config, processor = card.read_json(home / card.CONFIG), card.read_json(home / layout.PREPROCESSOR)
    before = json.dumps([config, processor])
    elsewhere = Path(config.get("vlm_model_name") or "")
    if elsewhere.is_absolute() and not (home / layout.BACKBONE).is_dir():
        # The policy's own file holds its weights, unless LeRobot builds it from the backbone's.
        weights = layout.BACKBONE_WEIGHTS if config.get("load_vlm_weights") else ()
        origin = FileSource("path", str(elsewhere))
        for name, path in matching_files(elsewhere, layout.BACKBONE_FILES + weights, origin).items():
            files[f"{layout.BACKBONE}/{name}"] = path
    ours = layout.CONFIG_FOLDERS.values()
    has = {own for own in ours if any(name.startswith(f"{own}/") for name in files)}
    for fields, key, own in layout.places_of_names(config, processor):
        if not Path(named := fields.get(key) or "").is_absolute():
            continue
        if own not in has:
            hint = f"put a copy into {layout.BACKBONE}/ beside {card.CONFIG}"
            raise InputError("path", str(home), f"it needs {named}, which is not in it; {hint}")
        fields[key] = own
    if json.dumps([config, processor]) != before:
        files[card.CONFIG] = (json.dumps(config, indent=4) + "\n").encode()
        files[layout.PREPROCESSOR] = (json.dumps(processor, indent=4) + "\n").encode()


def _check_base(folder: Path) -> None:
    """Refuses an adapter of a policy that is on this machine, or that it does not name."""
    base = card.read_json(folder / card.ADAPTER_CONFIG).get("base_model_name_or_path")
    if not re.fullmatch(card.REPO_ID, str(base)) or Path(str(base)).exists():
        why = (
            f"it is an adapter of {base!r}, which others cannot load; push that policy first, then write its"
        )
        hint = f"{why} name on the Hub into {card.ADAPTER_CONFIG} as base_model_name_or_path"
        raise InputError("path", str(folder), hint)


def is_record(name: str) -> bool:
    """True for text that may name paths, such as configs, metrics and cards; vocabularies hold any text."""
    path = PurePosixPath(name)
    return path.suffix in RECORDS and path.name not in VOCABULARIES


def scrubbed(name: str, data: bytes, folder: Path) -> bytes:
    """A record without paths of this machine; the bytes themselves if it has none.

    A path below the pushed folder becomes relative to it; of any other only the last name is kept.
    """
    try:
        text = data.decode()
    except UnicodeDecodeError:
        return data
    if _scrub(text, folder) == text:
        return data
    suffix = PurePosixPath(name).suffix
    try:
        if suffix == ".json":
            tree = _scrub_tree(json.loads(text), folder)
            return (json.dumps(tree, indent=4, ensure_ascii=False) + "\n").encode()
        if suffix in (".yaml", ".yml"):
            return yaml.safe_dump(_scrub_tree(yaml.safe_load(text), folder), sort_keys=False).encode()
    except (ValueError, yaml.YAMLError):
        pass  # not what its name says: treated as text
    return _scrub(text, folder).encode()


def _scrub_tree(value: Any, folder: Path) -> Any:
    if isinstance(value, dict):
        # null lets whoever repeats the run choose a folder.
        return {
            k: None if k == "output_dir" and _is_path(v) else _scrub_tree(v, folder) for k, v in value.items()
        }
    if isinstance(value, list):
        return [_scrub_tree(v, folder) for v in value]
    return _scrub(value, folder) if isinstance(value, str) else value


def _scrub(text: str, folder: Path) -> str:
    """Text with its paths replaced; a text that is one path may hold blanks."""
    if _is_path(text):
        return _portable(text, folder)
    for root in {str(folder.absolute()), str(folder.resolve())}:
        text = text.replace(f"{root}/", "")
    return PATH.sub(lambda m: _portable(m[0], folder) if _is_path(m[0]) else m[0], text)


def _is_path(value: Any) -> bool:
    """True for a path of this machine or a likely one of another."""
    if not isinstance(value, str) or not value.startswith(("/", "~/")) or "\n" in value:
        return False
    top = value.split("/")[1]
    return value[0] == "~" or value.count("/") > 1 and (top in ROOTS or Path("/", top).is_dir())


def _portable(path: str, folder: Path) -> str:
    for root in (folder.absolute(), folder.resolve()):
        if Path(path).is_relative_to(root):
            return Path(path).relative_to(root).as_posix()
    return f"{layout.AWAY}/{Path(path).name}"
