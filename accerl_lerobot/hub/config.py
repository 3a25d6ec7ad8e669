# SPDX-License-Identifier: Apache-2.0
"""Fields of ``accerl push`` and ``accerl pull``; free of the Hub's client."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Literal

from accerl_lerobot.config.ranges import Section
from accerl_lerobot.errors import InputError

REPO_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
RepoType = Literal["model", "dataset"]
REPO_TYPES: tuple[RepoType, ...] = ("model", "dataset")


@dataclass(frozen=True, kw_only=True)
class PushConfig(Section):
    """``accerl push``: a policy, world model, success model, dataset or whole run, as one commit."""

    path: str | None = None
    """The folder. What it is is seen from what is in it."""
    repo_id: str | None = None
    """``user/name`` on the Hub; made if it is not there."""
    revision: str = "main"
    """A branch that is there."""
    private: bool = True
    """Keep the repository private. A repository that is public is written to only when this is false, and one
    that is private stays so."""
    message: str | None = None
    """Message of the commit. None: says what was pushed."""
    include: list[str] = field(default_factory=list)
    """Folders of a run that are left at home otherwise, such as ``[demos, sft, tensorboard]``."""
    evaluation: str | None = None
    """Folder or file that ``accerl eval`` wrote about this policy; its numbers go into the card. None: those
    of the run around the policy."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.path is None:
            raise InputError("path", None, "name the folder to push")
        check_repo_id(self.repo_id)
        if not self.revision:
            raise InputError("revision", self.revision, "name a branch, or leave the field out")
        if self.message is not None and not self.message.strip():
            raise InputError("message", self.message, "say something, or leave the field out")


@dataclass(frozen=True, kw_only=True)
class PullConfig(Section):
    """``accerl pull``: what is on the Hub into a new folder, whole and checked or not at all."""

    repo_id: str | None = None
    """``user/name`` on the Hub."""
    revision: str | None = None
    """Commit, tag or branch; the commit it stands for is recorded beside the files. None: the branch main."""
    repo_type: RepoType | None = None
    """model or dataset. None: whichever of them has this name."""
    output_dir: str | None = None
    """Folder to create."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_repo_id(self.repo_id)
        if self.output_dir is None:
            raise InputError("output_dir", None, "name the folder to create")
        if self.revision == "":
            raise InputError("revision", "", "name a commit, tag or branch, or leave the field out")


def check_repo_id(repo_id: str | None) -> None:
    """Refuses what cannot be the name of a repository.

    Raises:
        InputError: it is none.
    """
    if repo_id is None or not REPO_ID.fullmatch(repo_id) or ".." in repo_id or len(repo_id) > 192:
        raise InputError("repo_id", repo_id, "name a repository as user/name")
