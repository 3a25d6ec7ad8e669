# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""From a commit on the Hub to a folder, whole and checked or not at all.

Everything is fetched into a folder beside the one that was asked for, which keeps what a cut pull had got,
and is renamed when it has been checked. What the server lists is somebody else's word: no name of it leads
out of that folder.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from huggingface_hub import HfApi
from huggingface_hub.errors import RepositoryNotFoundError
from huggingface_hub.hf_api import RepoFile

from accerl_lerobot.checkpoint import (
    CHECKPOINTS,
    LAST,
    PREPROCESSOR,
    PRETRAINED,
    defect,
    relocate,
    write_manifest,
)
from accerl_lerobot.checkpoint import MANIFEST as OF_CHECKPOINT
from accerl_lerobot.errors import InputError
from accerl_lerobot.hub.config import REPO_TYPES, PullConfig
from accerl_lerobot.hub.contents import RECORD
from accerl_lerobot.hub.kinds import CONFIG, POLICY, RUN, recognise
from accerl_lerobot.hub.manifest import CARD, MANIFEST, Entry, read_manifest, verify
from accerl_lerobot.hub.trouble import told
from accerl_lerobot.resume import LOCK

CACHE = ".cache"
"""Where the client keeps its books while it fetches into a folder."""
CODE = (".py", ".pyc", ".pyd", ".so")
"""Endings of what Python imports: a recipe beside it could name it as ``discover_packages_path``."""


def pull(config: PullConfig) -> dict[str, Any]:
    """Pulls, and keeps all but Python's code; returns which commit it was and what is there now, plain JSON.

    Raises:
        InputError: it is not there, not to be had, or not what was pushed; there is no new folder then.
    """
    repo_id, home = str(config.repo_id), Path(str(config.output_dir)).expanduser().absolute()
    if home.exists() or home.is_symlink():
        raise InputError("output_dir", str(home), "the folder exists; choose another or remove it")
    with told(repo_id, config.revision, writing=False):
        api = HfApi()
        kind_of_repo, commit = _resolve(api, config)
        listed = list(api.list_repo_tree(repo_id, recursive=True, revision=commit, repo_type=kind_of_repo))
        expected = {
            item.path: Entry(item.size, item.lfs.sha256 if item.lfs else None)
            for item in listed
            if isinstance(item, RepoFile)
        }
        check_names(list(expected), repo_id)
        home.parent.mkdir(parents=True, exist_ok=True)
        # Named after the commit, so that a cut pull goes on and no other one's files are in it.
        temporary = home.parent / f".pulling-{commit[:16]}-{home.name}"
        api.snapshot_download(repo_id, repo_type=kind_of_repo, revision=commit, local_dir=temporary)
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
    return found | {"path": str(home)}


def check_names(names: Sequence[str], repo_id: str) -> None:
    """Refuses names by which a server could write elsewhere, or over the client's books.

    Raises:
        InputError: there is one.
    """
    for name in names:
        parts = PurePosixPath(name).parts
        odd = "\\" in name or "\0" in name or ":" in name.split("/")[0] or name != "/".join(parts)
        if (
            odd
            or not parts
            or name.startswith("/")
            or {"..", "."} & set(parts)
            or parts[0] in (CACHE, ".git")
        ):
            raise InputError("repo_id", repo_id, f"it has a file named {name!r}, which is not safe to write")


def _resolve(api: HfApi, config: PullConfig) -> tuple[str, str]:
    """The sort of repository, and the full commit that the revision stands for now.

    Raises:
        InputError: both sorts have this name.
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
    return sort, str(commit)


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
        manifest = read_manifest((folder / MANIFEST).read_bytes(), repo_id)
        check_names(list(manifest.files), repo_id)
    files = manifest.files if manifest is not None else {}
    verify(folder, {**expected, **files}, repo_id)
    code = sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.name.endswith(CODE))
    if manifest is not None:
        (folder / MANIFEST).unlink()  # paths are set below, and then it does not hold any more
    (folder / ".gitattributes").unlink(missing_ok=True)
    _link_last(folder)
    kind = recognise(folder, "repo_id")
    if manifest is not None and kind != manifest.kind:
        raise InputError("repo_id", repo_id, f"its {MANIFEST} says {manifest.kind}, but this is a {kind}")
    if kind == POLICY:
        _move_in(folder, home, repo_id)
    elif kind == RUN:
        (folder / LOCK).touch()  # so a run is known that can be gone on with
        for checkpoint in (p for p in folder.glob("checkpoints/*") if not p.is_symlink()):
            _arrive(checkpoint, home / CHECKPOINTS / checkpoint.name, repo_id)
    _drop_code(folder)
    unchecked = expected.keys() - files.keys() - {CARD, MANIFEST, ".gitattributes"}
    counts = {"files": len(expected), "checked": len(files), "unchecked": len(unchecked)}
    return {"kind": kind} | counts | ({"left_out": code} if code else {})


def _drop_code(folder: Path) -> None:
    """Once all that came has been checked; see `CODE`."""
    for path in [p for p in folder.rglob("*") if p.name.endswith(CODE) and p.is_file()]:
        path.unlink()


def _arrive(checkpoint: Path, home: Path, repo_id: str) -> None:
    """Makes a checkpoint one of the place it will be in, its own manifest included, where it has one.

    Raises:
        InputError: it is broken.
    """
    own = (checkpoint / OF_CHECKPOINT).is_file()
    if own and (why := defect(checkpoint)) is not None:
        raise InputError("repo_id", repo_id, f"its checkpoint {checkpoint.name} is broken: {why}")
    if (checkpoint / PRETRAINED).is_dir():
        _move_in(checkpoint / PRETRAINED, home / PRETRAINED, repo_id)
    _drop_code(checkpoint)
    if own:
        write_manifest(checkpoint)


def _move_in(policy: Path, home: Path, repo_id: str) -> None:
    """Has a policy's files name the folders beside them, where they will be.

    Raises:
        InputError: they are not LeRobot's.
    """
    try:
        relocate(policy, home)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        remedy = f"its {CONFIG} or {PREPROCESSOR} is not one of LeRobot's ({type(error).__name__}: {error})"
        raise InputError("repo_id", repo_id, remedy) from error


def _link_last(run: Path) -> None:
    """A repository has no links; the checkpoint that came is the last one."""
    numbers = sorted(p.name for p in run.glob("checkpoints/*") if p.is_dir())
    if numbers and LAST not in numbers:
        (run / CHECKPOINTS / LAST).symlink_to(numbers[-1])
