# SPDX-License-Identifier: Apache-2.0
"""Download one commit from the Hub into a new folder, complete and checked or not at all.

Files are fetched into a folder beside the one that was asked for, which keeps what an interrupted pull has
fetched, and is renamed when it has been checked. The server is not trusted: no name that it lists leads out
of that folder, every file must have its size and hash, and nothing that came may let code run.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import Any

from huggingface_hub import HfApi, hf_hub_download
from huggingface_hub.errors import RepositoryNotFoundError
from huggingface_hub.hf_api import RepoFile

from accerl_lerobot.checkpoint.layout import check_names, digest, relocate
from accerl_lerobot.checkpoint.safety import FileSource, brief, unsafe_name
from accerl_lerobot.errors import InputError, check_absent, expanded, make_folder
from accerl_lerobot.hub import card
from accerl_lerobot.hub.errors import check_commit, hub_errors

CACHE, ATTRIBUTES = ".cache", ".gitattributes"
CODE = (".py", ".pyc", ".pyd", ".so")
"""Suffixes of files that Python imports: a recipe beside one could name it as ``discover_packages_path``."""
THREADS = 8
BROKEN = (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError)


def pull(config: card.PullConfig) -> dict[str, Any]:
    """Pulls all files but Python's code; returns the commit and the content, as plain JSON.

    There is no new folder if it is refused.
    """
    repo_id, home = config.repo_id, expanded(config.output_dir, "output_dir").absolute()
    check_absent(home)
    with hub_errors(repo_id, config.revision, writing=False):
        repo_type, commit = _resolve(HfApi(), config)
        listed = HfApi().list_repo_tree(repo_id, recursive=True, revision=commit, repo_type=repo_type)
        files = _checked(listed, repo_id)
        # Named after the commit, so that an interrupted pull resumes and no other one's files are in it.
        temporary = home.parent / f".pulling-{commit[:16]}-{home.name}"
        make_folder(temporary, "output_dir", again=True)
        _check_space(temporary, sum(file.size for file in files.values()))
        # `snapshot_download` would ask for the names again, and these have been checked.
        pool = ThreadPoolExecutor(THREADS)
        options = {"repo_type": repo_type, "revision": commit, "local_dir": temporary}
        try:
            list(pool.map(lambda name: hf_hub_download(repo_id, name, **options), files))
        finally:
            pool.shutdown(cancel_futures=True)
    record = {"repo_id": repo_id, "repo_type": repo_type, "revision": config.revision, "commit": commit}
    try:
        record = _receive(temporary, home, files, repo_id) | record
        (temporary / card.RECORD).write_text(json.dumps(record, indent=2) + "\n")
        temporary.rename(home)
    except OSError as error:
        why = f"cannot be made ({error.strerror}); choose another"
        raise InputError("output_dir", str(home), why) from error
    except BROKEN as error:
        shutil.rmtree(temporary)  # resuming would not make it better
        if isinstance(error, InputError):
            raise
        why = f"one of its files is not what its name says ({type(error).__name__}: {brief(error)})"
        raise InputError("repo_id", repo_id, f"{why}; push it anew") from error
    return record | {"path": str(home)}


def _resolve(api: HfApi, config: card.PullConfig) -> tuple[str, str]:
    """Repository type, and the commit that the revision resolves to now."""
    missing: Exception | None = None
    for repo_type in card.REPO_TYPES:
        try:
            info = api.repo_info(config.repo_id, repo_type=repo_type, revision=config.revision)
            return repo_type, check_commit(info.sha)
        except RepositoryNotFoundError as error:
            missing = missing or error
    assert missing is not None
    raise missing


def _checked(listed: Iterable[Any], repo_id: str) -> dict[str, RepoFile]:
    """Files that a server lists, by name; one with which it could write elsewhere is refused."""
    files = [item for item in listed if isinstance(item, RepoFile)]
    for file in files:
        name = file.path
        parts = PurePosixPath(name).parts if not unsafe_name(name) else ()
        if not parts or name != "/".join(parts) or parts[0] in (CACHE, ".git") or "." in parts:
            why = f"it has a file named {ascii(name)[:200]}, which is not safe to write"
            raise InputError("repo_id", repo_id, why)
        if type(file.size) is not int or file.size < 0:
            why = f"{ascii(file.path)[:99]} is listed with size {str(file.size)[:40]}; use another server"
            raise InputError("repo_id", repo_id, why)
    return {file.path: file for file in files}


def _check_space(temporary: Path, size: int) -> None:
    """Refuses what the disk cannot hold, beside what an interrupted pull has fetched of it."""
    fetched = sum(path.stat().st_size for path in temporary.rglob("*") if path.is_file())
    free = shutil.disk_usage(temporary).free + fetched
    if size > free:
        why = f"{size / 1e9:,.1f} GB are to be fetched, and {free / 1e9:,.1f} are free there"
        raise InputError("output_dir", str(temporary.parent), f"{why}; choose another")


def _receive(folder: Path, home: Path, files: dict[str, RepoFile], repo_id: str) -> dict[str, Any]:
    """Checks what came and adapts it to `home`; returns its type and what of it is not kept."""

    def refuse(why: str) -> InputError:
        return InputError("repo_id", repo_id, f"{why}; pull again, or push it anew")

    shutil.rmtree(folder / CACHE, ignore_errors=True)
    if links := [path.name for path in folder.rglob("*") if path.is_symlink()]:
        raise refuse(f"{links[0]} came as a link")
    for name, file in files.items():
        if (size := (folder / name).stat().st_size) != file.size:
            raise refuse(f"{name} came with {size} bytes instead of the {file.size} that the server lists")
        if not _is_listed(folder / name, file):
            raise refuse(f"{name} is not what the server lists: its hash is another")
    (folder / ATTRIBUTES).unlink(missing_ok=True)
    artifact = card.recognise(folder, "repo_id")
    check_names(folder, FileSource("repo_id", repo_id))
    if artifact == card.POLICY:
        relocate(folder, home)
    code = sorted(path for path in folder.rglob("*") if path.name.endswith(CODE) and path.is_file())
    left_out = [path.relative_to(folder).as_posix() for path in code]
    for path in code:
        path.unlink()
    return {"kind": artifact, "files": len(files)} | ({"left_out": left_out} if left_out else {})


def _is_listed(path: Path, file: RepoFile) -> bool:
    """True if a file has the hash by which the Hub knows it: SHA-256 if it is large, git's otherwise."""
    if file.lfs:
        return digest(path) == file.lfs.sha256
    git = hashlib.sha1(b"blob %d\0" % file.size, usedforsecurity=False)
    with path.open("rb") as opened:
        return hashlib.file_digest(opened, lambda: git).hexdigest() == file.blob_id
