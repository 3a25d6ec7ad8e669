# SPDX-License-Identifier: Apache-2.0
"""The list of files that goes with them, by which a pull knows that it has them all, unchanged.

README.md is not on it: people edit cards on the Hub. The list is no signature: whoever may write to the
repository may write a list as well.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from accerl_lerobot import __version__
from accerl_lerobot.checkpoint.layout import digest
from accerl_lerobot.checkpoint.safety import brief
from accerl_lerobot.errors import InputError
from accerl_lerobot.hub.kinds import NEEDED

MANIFEST = "accerl_manifest.json"
CARD = "README.md"
FORMAT = 1


@dataclass(frozen=True)
class Entry:
    """Size and hash that a file must have."""

    size: int
    """Bytes."""
    sha256: str | None = None
    oid: str | None = None
    """The hash that git has of it."""


@dataclass(frozen=True)
class Manifest:
    """Files of a push."""

    kind: str
    files: Mapping[str, Entry]


def entry_of(content: Path | bytes) -> Entry:
    """Size and hash of a file, or of bytes."""
    if isinstance(content, bytes):
        return Entry(len(content), hashlib.sha256(content).hexdigest())
    return Entry(content.stat().st_size, digest(content))


def write_manifest(manifest: Manifest) -> bytes:
    """As it goes to the Hub."""
    files = {name: {"size": e.size, "sha256": e.sha256} for name, e in sorted(manifest.files.items())}
    content = {"format": FORMAT, "kind": manifest.kind, "accerl": __version__, "files": files}
    return (json.dumps(content, indent=1) + "\n").encode()


def read_manifest(data: bytes, repo_id: str) -> Manifest:
    """As it came from the Hub.

    Raises:
        InputError: it is not one of ours.
    """
    try:
        content = json.loads(data)
        if content["format"] != FORMAT:
            raise ValueError(f"format {content['format']}")
        entries = content["files"].items()
        files = {str(name): Entry(int(e["size"]), str(e["sha256"])) for name, e in entries}
        if content["kind"] not in NEEDED:
            raise ValueError("no such kind")
        return Manifest(content["kind"], files)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        remedy = f"its {MANIFEST} is broken ({type(error).__name__}: {brief(error)}); push it anew"
        raise InputError("repo_id", repo_id, remedy) from error


def verify(folder: Path, files: Mapping[str, Entry], repo_id: str) -> None:
    """Compares files on disk with what they must be.

    Raises:
        InputError: one is missing, cut short or another.
    """
    for name, expected in files.items():
        path = folder / name
        if not path.is_file():
            raise InputError("repo_id", repo_id, f"{name} is missing there; push it anew")
        if (size := path.stat().st_size) != expected.size:
            remedy = f"{name} came with {size} bytes instead of {expected.size}; pull again, or push it anew"
            raise InputError("repo_id", repo_id, remedy)
        if expected.sha256 is not None and entry_of(path).sha256 != expected.sha256:
            remedy = f"{name} is not what was pushed: its sha256 is another; pull again, or push it anew"
            raise InputError("repo_id", repo_id, remedy)
        if expected.oid is not None and git_hash(path) != expected.oid:
            remedy = f"{name} is not what the server lists: its git hash is another; pull again"
            raise InputError("repo_id", repo_id, remedy)


def git_hash(path: Path) -> str:
    """The hash by which git knows a file."""
    digest = hashlib.sha1(b"blob %d\0" % path.stat().st_size, usedforsecurity=False)
    with path.open("rb") as file:
        while block := file.read(2**20):
            digest.update(block)
    return digest.hexdigest()
