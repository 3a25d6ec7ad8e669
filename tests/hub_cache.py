# SPDX-License-Identifier: Apache-2.0
"""The layout of the Hub's cache, as after a download."""

from pathlib import Path


def cached_repo(cache: Path, name: str, commit: str) -> Path:
    """The folder of a model's `commit`, still empty, which is now the newest of its ``main``."""
    folder = cache / f"models--{name.replace('/', '--')}"
    snapshot = folder / "snapshots" / commit
    for made in (snapshot, folder / "refs"):
        made.mkdir(parents=True, exist_ok=True)
    (folder / "refs" / "main").write_text(commit)
    return snapshot
