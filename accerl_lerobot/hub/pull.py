# SPDX-License-Identifier: Apache-2.0
"""From a commit on the Hub to a folder, whole and checked or not at all.

Everything is fetched into a folder beside the one that was asked for, which keeps what a cut pull had got,
and is renamed when it has been checked. What the server lists is somebody else's word: no name of it leads
out of that folder, no file may be longer than it says, and nothing that came may let code run.
"""

from __future__ import annotations

import json
import re
import shutil
import unicodedata
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Any

import yaml
from huggingface_hub import HfApi, hf_hub_download
from huggingface_hub.errors import RepositoryNotFoundError
from huggingface_hub.hf_api import RepoFile

from accerl_lerobot.checkpoint.layout import CHECKPOINTS, LAST, PRETRAINED, defect, relocate, write_manifest
from accerl_lerobot.checkpoint.layout import CONFIG as RECIPE
from accerl_lerobot.checkpoint.layout import MANIFEST as OF_CHECKPOINT
from accerl_lerobot.checkpoint.safety import JSON_MOST, REVISION, Origin, brief, read_bytes, unsafe_name
from accerl_lerobot.config.parsing import drop_consents, read_recipe
from accerl_lerobot.engine.stopping import LOCK
from accerl_lerobot.errors import InputError, check_absent, expanded
from accerl_lerobot.hub.config import REPO_TYPES, PullConfig
from accerl_lerobot.hub.contents import RECORD
from accerl_lerobot.hub.kinds import POLICY, RUN, recognise
from accerl_lerobot.hub.manifest import CARD, MANIFEST, Entry, read_manifest, verify
from accerl_lerobot.hub.trouble import ANSWERS_MOST, ANSWERS_S, REQUESTS_MOST, SLOWEST, check_commit, told

CACHE = ".cache"
"""Where the client keeps its books while it fetches into a folder."""
CODE = (".py", ".pyc", ".pyd", ".so")
"""Endings of what Python imports: a recipe beside it could name it as ``discover_packages_path``."""
FILES_MOST, SIZE_MOST, MANIFEST_MOST = 100_000, 2**53, 64 * 1024**2
"""Files of a repository, and bytes of one of them and of our list of them."""
TOGETHER = 8
"""Files that are fetched at a time."""
SHA256 = re.compile(r"[0-9a-f]{64}")


def pull(config: PullConfig) -> dict[str, Any]:
    """Pulls, and keeps all but Python's code; returns which commit it was and what is there now, plain JSON.

    Raises:
        InputError: it is not there, not to be had, or not what was pushed; there is no new folder then.
    """
    repo_id, home = str(config.repo_id), expanded(str(config.output_dir), "output_dir").absolute()
    check_absent(home)
    with told(repo_id, config.revision, writing=False) as allowance:
        api = HfApi()
        kind_of_repo, commit = _resolve(api, config)
        listed = api.list_repo_tree(repo_id, recursive=True, revision=commit, repo_type=kind_of_repo)
        expected = _expected(listed, repo_id)
        # Named after the commit, so that a cut pull goes on and no other one's files are in it.
        temporary = home.parent / f".pulling-{commit[:16]}-{home.name}"
        size = sum(entry.size for entry in expected.values())
        _check_space(home, temporary, size)
        requests, seconds = REQUESTS_MOST + 20 * len(expected), ANSWERS_S + size / SLOWEST
        allowance.renew(ANSWERS_MOST + 2 * size, requests, seconds)
        _fetch(repo_id, kind_of_repo, commit, list(expected), temporary)
    record = {"repo_id": repo_id, "repo_type": kind_of_repo, "revision": config.revision, "commit": commit}
    try:
        found = _receive(temporary, home, expected, repo_id) | record
        (temporary / RECORD).write_text(json.dumps(found, indent=2) + "\n")
        temporary.rename(home)
    except InputError:
        shutil.rmtree(temporary)  # it would not become better by going on
        raise
    except OSError as error:
        remedy = f"cannot be made ({error.strerror}); choose another"
        raise InputError("output_dir", str(home), remedy) from error
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        shutil.rmtree(temporary)
        why = f"one of its files is not what its name says ({type(error).__name__}: {brief(error)})"
        raise InputError("repo_id", repo_id, f"{why}; push it anew") from error
    return found | {"path": str(home)}


def check_names(names: Iterable[str], repo_id: str) -> None:
    """Refuses names by which a server could write elsewhere, or write one file over another.

    Raises:
        InputError: there is one.
    """
    files: set[str] = set()
    folders: dict[str, str] = {}
    for name in names:
        parts = PurePosixPath(name).parts if not unsafe_name(name) else ()
        if not parts or name != "/".join(parts) or parts[0] in (CACHE, ".git") or "." in parts:
            raise InputError(
                "repo_id", repo_id, f"it has a file named {ascii(name)[:200]}, which is not safe to write"
            )
        above = ["/".join(parts[:depth]) for depth in range(1, len(parts))]
        same = _folded(name)
        clash = same in files or same in folders
        clash |= any(_folded(f) in files or folders.setdefault(_folded(f), f) != f for f in above)
        if clash:
            raise InputError(
                "repo_id", repo_id, f"{ascii(name)[:200]} and another file of it cannot both be written"
            )
        files.add(same)


def _folded(name: str) -> str:
    """The name as a file system that ignores case, or composes letters, takes it."""
    return unicodedata.normalize("NFC", name.casefold())


def _expected(listed: Iterable[Any], repo_id: str) -> dict[str, Entry]:
    """Name → what the file must be, of all files that a server lists.

    Raises:
        InputError: one has no good name, size or hash, or there are too many.
    """
    names, expected = [], {}
    for item in islice((i for i in listed if isinstance(i, RepoFile)), FILES_MOST + 1):
        sha256, oid = (item.lfs.sha256, None) if item.lfs else (None, item.blob_id)
        size, hash_of, wanted = item.size, sha256 or oid, SHA256 if item.lfs else REVISION
        good = isinstance(item.path, str) and type(size) is int and 0 <= size <= SIZE_MOST
        if not good or not isinstance(hash_of, str) or not wanted.fullmatch(hash_of):
            why = (
                f"{ascii(item.path)[:99]} is listed with size {str(size)[:40]} and hash {ascii(hash_of)[:80]}"
            )
            raise InputError("repo_id", repo_id, f"{why}, which no file has; use another server")
        names.append(item.path)
        expected[item.path] = Entry(size, sha256, oid)
    if len(names) > FILES_MOST:
        raise InputError("repo_id", repo_id, f"it has more than {FILES_MOST} files; split it")
    check_names([*names, *({RECORD} - set(names))], repo_id)
    return expected


def _check_space(home: Path, temporary: Path, size: int) -> None:
    """Refuses what the disk cannot hold.

    Raises:
        InputError: it cannot, or no folder can be made there.
    """
    try:
        home.parent.mkdir(parents=True, exist_ok=True)
        there = sum(path.stat().st_size for path in temporary.rglob("*") if path.is_file())
        free = shutil.disk_usage(home.parent).free + there
    except OSError as error:
        remedy = f"cannot be made ({error.strerror}); choose another"
        raise InputError("output_dir", str(home), remedy) from error
    if size > free:
        remedy = (
            f"{size / 1e9:,.1f} GB are to be fetched, and {free / 1e9:,.1f} are free there; choose another"
        )
        raise InputError("output_dir", str(home), remedy)


def _fetch(repo_id: str, repo_type: str, commit: str, names: list[str], folder: Path) -> None:
    """Fetches files by names that have been checked; `snapshot_download` would ask for the list again."""

    def one(name: str) -> None:
        hf_hub_download(repo_id, name, repo_type=repo_type, revision=commit, local_dir=folder)

    folder.mkdir(exist_ok=True)
    pool = ThreadPoolExecutor(TOGETHER)
    try:
        list(pool.map(one, names))
    finally:
        pool.shutdown(cancel_futures=True)


def _resolve(api: HfApi, config: PullConfig) -> tuple[str, str]:
    """The sort of repository, and the full commit that the revision stands for now.

    Raises:
        InputError: both sorts have this name, or the server names no commit.
        RepositoryNotFoundError: none has.
    """
    repo_id, found = str(config.repo_id), {}
    sorts = REPO_TYPES if config.repo_type is None else (config.repo_type,)
    missing: Exception | None = None
    for sort in sorts:
        try:
            found[sort] = api.repo_info(repo_id, repo_type=sort).sha
        except RepositoryNotFoundError as error:
            missing = missing or error
    if len(found) > 1:
        raise InputError("repo_type", None, f"{repo_id} is a model and a dataset; say which")
    if not found:
        assert missing is not None
        raise missing
    ((sort, commit),) = found.items()
    if config.revision is not None:
        commit = api.repo_info(repo_id, repo_type=sort, revision=config.revision).sha
    return sort, check_commit(commit, repo_id)


def _receive(folder: Path, home: Path, expected: dict[str, Entry], repo_id: str) -> dict[str, Any]:
    """Checks what came and makes it at home in `home`; returns its kind and how much of it was checked.

    Raises:
        InputError: it is not what was pushed, or not what the server listed.
    """
    shutil.rmtree(folder / CACHE, ignore_errors=True)
    links = [path for path in folder.rglob("*") if path.is_symlink()]
    if links:
        raise InputError("repo_id", repo_id, f"{links[0].name} came as a link; pull again")
    manifest = None
    if (folder / MANIFEST).is_file():
        data = read_bytes(folder / MANIFEST, MANIFEST_MOST, Origin("repo_id", repo_id))
        manifest = read_manifest(data, repo_id)
        check_names(manifest.files, repo_id)
    files = manifest.files if manifest is not None else {}
    verify(
        folder, expected | {name: _both(entry, expected.get(name)) for name, entry in files.items()}, repo_id
    )
    code = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.name.endswith(CODE))
    if manifest is not None:
        (folder / MANIFEST).unlink()  # paths are set below, and then it does not hold any more
    (folder / ".gitattributes").unlink(missing_ok=True)
    _link_last(folder)
    kind = recognise(folder, "repo_id")
    if manifest is not None and kind != manifest.kind:
        raise InputError("repo_id", repo_id, f"its {MANIFEST} says {manifest.kind}, but this is a {kind}")
    checkpoints = [p for p in folder.glob("checkpoints/*") if kind == RUN and not p.is_symlink()]
    own = [checkpoint for checkpoint in checkpoints if (checkpoint / OF_CHECKPOINT).is_file()]
    for checkpoint in own:
        if (why := defect(checkpoint)) is not None:
            raise InputError("repo_id", repo_id, f"its checkpoint {checkpoint.name} is broken: {why}")
    if kind == POLICY:
        relocate(folder, home)
    for checkpoint in checkpoints:
        if (checkpoint / PRETRAINED).is_dir():
            relocate(checkpoint / PRETRAINED, home / CHECKPOINTS / checkpoint.name / PRETRAINED)
    if kind == RUN:
        (folder / LOCK).touch()  # so a run is known that can be gone on with
    dropped = _drop_consents(folder)
    for path in [p for p in folder.rglob("*") if p.name.endswith(CODE) and p.is_file()]:
        path.unlink()
    for checkpoint in own:
        write_manifest(checkpoint)
    unchecked = expected.keys() - files.keys() - {CARD, MANIFEST, ".gitattributes"}
    counts = {"files": len(expected), "checked": len(files), "unchecked": len(unchecked)}
    left = {"left_out": code, "dropped": dropped}
    return {"kind": kind} | counts | {name: value for name, value in left.items() if value}


def _both(pushed: Entry, listed: Entry | None) -> Entry:
    """Size and hash of a file by the list that was pushed and, where that agrees, by the server's."""
    oid = listed.oid if listed is not None else None
    return Entry(pushed.size, pushed.sha256, oid)


def _drop_consents(folder: Path) -> dict[str, dict[str, Any]]:
    """Removes from all configs of runs what would let code run; returns it, by file."""
    dropped: dict[str, dict[str, Any]] = {}
    for path in sorted(p for p in folder.rglob(RECIPE) if p.is_file() and not p.is_symlink()):
        if path.stat().st_size > JSON_MOST:
            continue  # no recipe; and what `parse` finds in it, it refuses
        try:
            tree = read_recipe(path)
        except InputError:
            continue
        if found := drop_consents(tree):
            path.write_text(yaml.safe_dump(tree, sort_keys=False))
            dropped[path.relative_to(folder).as_posix()] = found
    return dropped


def _link_last(run: Path) -> None:
    """A repository has no links; the checkpoint that came is the last one."""
    numbers = sorted(p.name for p in run.glob("checkpoints/*") if p.is_dir())
    if numbers and LAST not in numbers:
        (run / CHECKPOINTS / LAST).symlink_to(numbers[-1])
