# SPDX-License-Identifier: Apache-2.0
"""Push a folder to the Hub as one commit, and pull one commit into a new folder.

A push uploads large files first, each under its hash, and the commit that names them last: an interrupted
push leaves the repository as it was, and the next one uploads only what the Hub does not have yet. That is
why this is ``create_commit``: ``upload_folder`` may make several commits, each of which others see. A commit
names its parent, so two pushes at a time do not mix. No path of this machine is pushed.

A pull fetches files into a folder beside the one that was asked for, which keeps what an interrupted pull has
fetched, and is renamed when it has been checked. No name that the server lists leads out of it, no file is
Python code, and none names a place on this machine.
"""

from __future__ import annotations

import contextlib
import json
import logging
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import yaml
from huggingface_hub import (
    CommitOperationAdd,
    CommitOperationDelete,
    HfApi,
    get_token,
    hf_hub_download,
    snapshot_download,
)  # fmt: skip
from huggingface_hub.errors import HfHubHTTPError, RepositoryNotFoundError, RevisionNotFoundError
from huggingface_hub.utils import filter_repo_objects

from accerl_lerobot.checkpoint import layout
from accerl_lerobot.checkpoint.safety import FileSource, leads_out, matching_files, unsafe_name
from accerl_lerobot.errors import InputError, check_absent, expanded, last_exception
from accerl_lerobot.hub.card import (
    CARD,
    CONTENTS,
    DATASET,
    MARK,
    POLICY,
    RECORD,
    Files,
    PullConfig,
    PushConfig,
    dataset_card,
    model_card,
    read_json,
    recognise,
    run_files,
)

logger = logging.getLogger(__name__)

BRANCH = "main"
DATASET_TAG = "v3.0"  # version of LeRobotDatasets, by which LeRobot looks for them on the Hub
LOGIN = "log in with 'hf auth login', or set HF_TOKEN to a token"
AGAIN = "run the same command again, it resumes"
STATUS = {
    401: f"the Hub does not accept the token; {LOGIN} that may read and write it",
    403: "the token has no right to do this here; use another one, and a user/ it belongs to",
    404: f"it is not there, or private: mind the spelling, or {LOGIN} that may see it",
    412: "somebody else wrote to it meanwhile; look at what is there and run the same command again",
    429: "the Hub asks for fewer requests; wait a few minutes and run the same command again",
}
VOCABULARIES = ("tokenizer.json", "vocab.json", "added_tokens.json", "special_tokens_map.json")
ARGUMENT = re.compile(r"(--[\w.]+=)?(.*)", re.DOTALL)
"""An argument with its value, or a text alone."""
IGNORED = ["*.py", "*.pyc", "*.pyd", "*.so", ".git/*", ".gitattributes"]
"""Git's own files, and those that Python imports: a recipe beside one could name it as
``discover_packages_path``."""


@contextmanager
def hub_errors(repo_id: str, revision: str | None) -> Iterator[None]:
    """Turns all failures of the client into an `InputError` without the token."""
    try:
        yield
    except InputError:
        raise
    except RevisionNotFoundError:
        hint = f"{repo_id} has no such commit, tag or branch"
        raise InputError("revision", revision, hint) from None
    except Exception as error:
        code = 0
        if isinstance(error, HfHubHTTPError):
            code = error.response.status_code
        if code == 401 and get_token() is None:  # so the Hub answers where there is nothing, or it is private
            code = 404
        text = str(error).replace(get_token() or "<token>", "<token>")
        why = last_exception(text)[:160] or type(error).__name__
        hint = STATUS.get(code) or f"the Hub, the network or this disk does not work ({why}); {AGAIN}"
        raise InputError("repo_id", repo_id, hint) from None  # the client's own words may hold a header


def push(config: PushConfig) -> dict[str, Any]:
    """Pushes a folder; returns what was pushed and the new commit, as plain JSON.

    If it is refused, or fails, the repository is as before.
    """
    folder = expanded(config.path, "path")
    artifact = recognise(folder)
    files = stage(config, folder, artifact)
    if get_token() is None:
        raise InputError("repo_id", config.repo_id, f"pushing needs a token; {LOGIN} that may write")
    with hub_errors(config.repo_id, BRANCH):
        return _upload(config, artifact, files)


def stage(config: PushConfig, folder: Path, artifact: str) -> Files:
    """All files to upload, with a card and without paths of this machine."""
    source = FileSource("path", str(folder))
    found: Files = {**matching_files(folder, (*CONTENTS[artifact], "LICENSE*"), source)}
    if artifact == POLICY:
        _point_at_backbone(found, folder)
    found |= run_files(folder, artifact, config.evaluation)
    files = {name: without_paths(name, content) for name, content in found.items()}
    written = matching_files(folder, [CARD], source).get(CARD)
    if written is not None and not _is_ours(written.read_text()):
        files[CARD] = written
    elif artifact == DATASET:
        files[CARD] = dataset_card(config.repo_id, folder).encode()
    else:
        files[CARD] = model_card(config.repo_id, artifact, folder, files).encode()
    return files


def _point_at_backbone(files: Files, folder: Path) -> None:
    """Makes a policy name the backbone beside it instead of one elsewhere on this machine."""
    for name in layout.NAMING_BACKBONE:
        content = read_json(folder / name)
        for fields, key, place in layout.places_of_names(content):
            named = fields.get(key) or ""
            if not Path(named).is_absolute():
                continue
            if not (folder / place).is_dir():
                hint = f"put a copy into {layout.BACKBONE}/ beside {name}"
                raise InputError("path", str(folder), f"it needs {named}, which is not in it; {hint}")
            fields[key] = place
            files[name] = _as_json(content)


def without_paths(name: str, content: Path | bytes) -> Path | bytes:
    """The content of a JSON or YAML file without paths of this machine; any other file as it is.

    Of a path only the last name is kept. Vocabularies may hold any text.
    """
    path = PurePosixPath(name)
    if path.suffix not in (".json", ".yaml") or path.name in VOCABULARIES:
        return content
    if isinstance(content, Path):
        content = content.read_bytes()
    is_yaml = path.suffix == ".yaml"
    tree = yaml.safe_load(content) if is_yaml else json.loads(content)
    changed = _without_paths(tree)
    if changed == tree:
        return content
    if is_yaml:
        return yaml.safe_dump(changed, sort_keys=False).encode()
    return _as_json(changed)


def _without_paths(value: Any) -> Any:
    if isinstance(value, dict):
        tree = dict(value)
        for key in value.keys() - set(layout.PATTERNS):
            tree[key] = _without_paths(value[key])
        if tree.get("output_dir") != value.get("output_dir"):
            tree["output_dir"] = None  # a repeated run gets a folder of its own
        return tree
    if isinstance(value, list):
        return [_without_paths(below) for below in value]
    if not isinstance(value, str):
        return value
    match = ARGUMENT.fullmatch(value)
    assert match is not None
    if not leads_out(match[2]):
        return value
    return f"{match[1] or ''}{layout.AWAY}/{PurePosixPath(match[2]).name.removeprefix('..')}"


def _as_json(tree: Any) -> bytes:
    return (json.dumps(tree, indent=4, ensure_ascii=False) + "\n").encode()


def _is_ours(text: str) -> bool:
    """True for a card that a push has written, and an empty one."""
    return MARK in text or not text.strip()


def _upload(config: PushConfig, artifact: str, files: Files) -> dict[str, Any]:
    api = HfApi()
    repo_id = config.repo_id
    repo_type = "dataset" if artifact == DATASET else "model"
    where: dict[str, Any] = {"repo_id": repo_id, "repo_type": repo_type}
    api.create_repo(**where, private=config.private, exist_ok=True)
    before = api.repo_info(**where)
    if config.private and before.private is False:
        hint = "this repository is public: add --private=false, or choose another name"
        raise InputError("private", True, hint)
    listed = api.list_repo_files(revision=before.sha, **where)
    if CARD in listed:
        fetched = hf_hub_download(filename=CARD, revision=before.sha, **where)
        ours = files[CARD]
        if isinstance(ours, bytes) and not _is_ours(Path(fetched).read_text()):
            logger.warning("the README.md on the Hub is left as it is, somebody wrote it")
            del files[CARD]
    known = filter_repo_objects(sorted(listed), allow_patterns=list(CONTENTS[artifact]))
    stale = [name for name in known if name not in files]
    operations = [CommitOperationAdd(name, content) for name, content in files.items()]
    operations += [CommitOperationDelete(name, is_folder=False) for name in stale]
    commit = api.create_commit(
        operations=operations,
        commit_message=f"{artifact.capitalize()} pushed with accerl-lerobot",
        revision=BRANCH,
        parent_commit=before.sha,
        **where,
    ).oid
    url = f"{api.endpoint}/{repo_id}"
    if artifact == DATASET:
        url = f"{api.endpoint}/datasets/{repo_id}"
        with contextlib.suppress(RevisionNotFoundError):
            api.delete_tag(tag=DATASET_TAG, **where)
        api.create_tag(tag=DATASET_TAG, revision=commit, **where)
    return {
        "kind": artifact,
        **where,
        "commit": commit,
        "unchanged": commit == before.sha,
        "private": bool(before.private),
        "files": len(files),
        "url": url,
    }


def pull(config: PullConfig) -> dict[str, Any]:
    """Pulls all files but Python's code; returns the commit and the content, as plain JSON.

    There is no new folder if it is refused.
    """
    repo_id = config.repo_id
    source = FileSource("repo_id", repo_id)
    home = expanded(config.output_dir, "output_dir").absolute()
    check_absent(home)
    with hub_errors(repo_id, config.revision):
        repo_type, commit = _resolved(config)
        for name in HfApi().list_repo_files(repo_id, repo_type=repo_type, revision=commit):
            why = unsafe_name(name)
            if why:
                raise source.refuse(name, f"not safe to write: {why}")
        # Named after the commit, so that an interrupted pull resumes and no other one's files are in it.
        temporary = home.parent / f".pulling-{commit[:16]}-{home.name}"
        temporary.mkdir(parents=True, exist_ok=True)
        snapshot_download(
            repo_id, repo_type=repo_type, revision=commit, local_dir=temporary, ignore_patterns=IGNORED
        )
    shutil.rmtree(temporary / ".cache", ignore_errors=True)
    try:
        artifact = recognise(temporary, "repo_id")
        layout.check_names(temporary, source)
        if artifact == POLICY:
            layout.relocate(temporary, home)
    except Exception:
        shutil.rmtree(temporary)  # resuming would not make it better
        raise
    record = {
        "kind": artifact,
        "repo_id": repo_id,
        "repo_type": repo_type,
        "revision": config.revision,
        "commit": commit,
        "files": sum(path.is_file() for path in temporary.rglob("*")),
    }
    (temporary / RECORD).write_text(json.dumps(record, indent=2) + "\n")
    temporary.rename(home)
    return record | {"path": str(home)}


def _resolved(config: PullConfig) -> tuple[Literal["model", "dataset"], str]:
    """Repository type, and the commit that the revision resolves to now; a model goes before a dataset."""
    api = HfApi()
    try:
        return "model", str(api.repo_info(config.repo_id, revision=config.revision).sha)
    except RepositoryNotFoundError:
        info = api.repo_info(config.repo_id, repo_type="dataset", revision=config.revision)
        return "dataset", str(info.sha)
