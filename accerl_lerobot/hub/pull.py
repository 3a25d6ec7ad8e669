# SPDX-License-Identifier: Apache-2.0
"""Download one commit from the Hub into a new folder, complete and checked or not at all.

Files are fetched into a folder beside the one that was asked for, which keeps what an interrupted pull has
fetched, and is renamed when it has been checked. No name that the server lists leads out of it, no file is
Python code, and none names a place on this machine.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

from huggingface_hub import HfApi, snapshot_download
from huggingface_hub.errors import RepositoryNotFoundError

from accerl_lerobot.checkpoint.layout import check_names, relocate
from accerl_lerobot.checkpoint.safety import FileSource, unsafe_name
from accerl_lerobot.errors import InputError, check_absent, expanded, make_folder, reading
from accerl_lerobot.hub import card
from accerl_lerobot.hub.errors import check_commit, hub_errors

IGNORED = ["*.py", "*.pyc", "*.pyd", "*.so", ".git/*", ".gitattributes"]
"""Git's own files, and those that Python imports: a recipe beside one could name it as
``discover_packages_path``."""


def pull(config: card.PullConfig) -> dict[str, Any]:
    """Pulls all files but Python's code; returns the commit and the content, as plain JSON.

    There is no new folder if it is refused.
    """
    repo_id = config.repo_id
    home = expanded(config.output_dir, "output_dir").absolute()
    check_absent(home)
    with hub_errors(repo_id, config.revision):
        repo_type, commit = _resolve(config)
        for name in HfApi().list_repo_files(repo_id, repo_type=repo_type, revision=commit):
            why = unsafe_name(name)
            if why:
                raise InputError(
                    "repo_id", repo_id, f"its file {ascii(name)[:200]} is not safe to write: {why}"
                )
        # Named after the commit, so that an interrupted pull resumes and no other one's files are in it.
        temporary = home.parent / f".pulling-{commit[:16]}-{home.name}"
        make_folder(temporary, "output_dir", again=True)
        snapshot_download(
            repo_id, repo_type=repo_type, revision=commit, local_dir=temporary, ignore_patterns=IGNORED
        )
    shutil.rmtree(temporary / ".cache", ignore_errors=True)
    try:
        artifact = _check(temporary, home, repo_id)
    except InputError:
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
    (temporary / card.RECORD).write_text(json.dumps(record, indent=2) + "\n")
    temporary.rename(home)
    return record | {"path": str(home)}


def _resolve(config: card.PullConfig) -> tuple[card.RepoType, str]:
    """Repository type, and the commit that the revision resolves to now; a model goes before a dataset."""
    api = HfApi()
    try:
        info = api.repo_info(config.repo_id, repo_type="model", revision=config.revision)
        return "model", check_commit(info.sha)
    except RepositoryNotFoundError as missing:
        try:
            info = api.repo_info(config.repo_id, repo_type="dataset", revision=config.revision)
        except RepositoryNotFoundError:
            raise missing from None
        return "dataset", check_commit(info.sha)


def _check(folder: Path, home: Path, repo_id: str) -> str:
    """The type of what came, which is adapted to its future `home`."""
    with reading("repo_id", repo_id, "one of its files"):
        artifact = card.recognise(folder, "repo_id")
        check_names(folder, FileSource("repo_id", repo_id))
        if artifact == card.POLICY:
            relocate(folder, home)
    return artifact
