# SPDX-License-Identifier: Apache-2.0
"""A Hub in memory, in place of huggingface_hub's client where ``accerl push`` and ``accerl pull`` call it.

A commit appears whole or not at all. A call fails once as `faults` says:

    hub.faults["create_commit"] = refused(412)
"""

import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
from huggingface_hub import CommitOperationAdd, get_token
from huggingface_hub.errors import HfHubHTTPError, RepositoryNotFoundError, RevisionNotFoundError
from huggingface_hub.utils import filter_repo_objects

WRITER, READER, STRANGER = "hf_writerwriterwriter", "hf_readerreaderreader", "hf_strangerstranger"
NOBODY = "hf_nobodysnobodys"  # which the Hub does not know
ACCOUNTS = {WRITER: ("alice", "write"), READER: ("alice", "read"), STRANGER: ("mallory", "write")}
"""Token → its owner and its role."""
CALLS = ("repo_info", "create_repo", "list_repo_files", "create_commit", "create_tag", "delete_tag")
"""Methods of HfApi."""
DOWNLOADS = ("hf_hub_download", "snapshot_download")


def refused(status: int, message: str = "no", kind: type[HfHubHTTPError] = HfHubHTTPError) -> HfHubHTTPError:
    """The client's error for an answer with this status."""
    response = httpx.Response(status, request=httpx.Request("GET", "https://hub.test"))
    return kind(message, response=response)


@dataclass
class Repo:
    """Branches and tags name commits, commits hold files."""

    private: bool
    commits: dict[str, dict[str, bytes]] = field(default_factory=dict)
    branches: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    messages: dict[str, str] = field(default_factory=dict)

    def commit(self, files: dict[str, bytes], message: str) -> str:
        oid = hashlib.sha1(f"{len(self.commits)} {message}".encode()).hexdigest()
        self.commits[oid], self.messages[oid], self.branches["main"] = files, message, oid
        return oid

    def resolve(self, revision: str | None) -> str:
        found = {oid: oid for oid in self.commits} | self.branches | self.tags
        if (revision or "main") not in found:
            raise refused(404, kind=RevisionNotFoundError)
        return found[revision or "main"]


class FakeHub:
    """The client and its server; `folder` is for downloads of single files."""

    endpoint = "https://hub.test"

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.repos: dict[tuple[str, str], Repo] = {}
        self.faults: dict[str, Exception] = {}
        self.fetched: list[str] = []

    def repo(self, repo_id: str, repo_type: str = "model") -> Repo:
        return self.repos[repo_type, repo_id]

    def files(self, repo_id: str, repo_type: str = "model", revision: str = "main") -> dict[str, bytes]:
        """Names and contents of a commit."""
        repo = self.repo(repo_id, repo_type)
        return repo.commits[repo.resolve(revision)]

    def plant(self, repo_id: str, files: dict[str, bytes], repo_type: str = "model") -> str:
        """Commits files without asking the client, under whatever names; returns the commit."""
        repo = self.repos.setdefault((repo_type, repo_id), Repo(private=False))
        before = repo.commits.get(repo.branches.get("main", ""), {})
        return repo.commit(before | files, "planted")

    def repo_info(self, repo_id: str, revision: str | None = None, repo_type: str | None = None) -> Any:
        repo = self._open("repo_info", repo_id, repo_type)
        return SimpleNamespace(sha=repo.resolve(revision), private=repo.private)

    def create_repo(self, repo_id: str, private: bool | None = None, repo_type: str | None = None) -> None:
        if ACCOUNTS[str(get_token())] != (repo_id.split("/")[0], "write"):
            raise refused(403)
        self.repos[repo_type or "model", repo_id] = Repo(private=bool(private))
        self.repo(repo_id, repo_type or "model").commit({}, "initial commit")

    def list_repo_files(
        self, repo_id: str, revision: str | None = None, repo_type: str | None = None
    ) -> list[str]:
        repo = self._open("list_repo_files", repo_id, repo_type)
        return list(repo.commits[repo.resolve(revision)])

    def create_commit(
        self,
        repo_id: str,
        operations: list[Any],
        commit_message: str,
        repo_type: str | None = None,
        revision: str | None = None,
        parent_commit: str | None = None,
    ) -> Any:
        repo = self._open("create_commit", repo_id, repo_type)
        assert parent_commit == repo.resolve(revision), "two pushes would mix"
        files = dict(repo.commits[parent_commit])
        for operation in operations:
            if isinstance(operation, CommitOperationAdd):
                with operation.as_file() as file:
                    files[operation.path_in_repo] = file.read()
            else:
                del files[operation.path_in_repo]
        same = files == repo.commits[parent_commit]  # the client makes no empty commit
        return SimpleNamespace(oid=parent_commit if same else repo.commit(files, commit_message))

    def create_tag(self, repo_id: str, tag: str, revision: str | None = None, repo_type: Any = None) -> None:
        repo = self._open("create_tag", repo_id, repo_type)
        repo.tags[tag] = repo.resolve(revision)

    def delete_tag(self, repo_id: str, tag: str, repo_type: str | None = None) -> None:
        if self._open("delete_tag", repo_id, repo_type).tags.pop(tag, None) is None:
            raise refused(404, kind=RevisionNotFoundError)

    def hf_hub_download(
        self, repo_id: str, filename: str, repo_type: str | None = None, revision: str | None = None
    ) -> str:
        repo = self._open("hf_hub_download", repo_id, repo_type)
        path = self.folder / filename
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(repo.commits[repo.resolve(revision)][filename])
        return str(path)

    def snapshot_download(
        self, repo_id: str, repo_type: str, revision: str, local_dir: Path, ignore_patterns: list[str]
    ) -> None:
        files = self.files(repo_id, repo_type, revision)
        for name in filter_repo_objects(sorted(files), ignore_patterns=ignore_patterns):
            (local_dir / name).parent.mkdir(parents=True, exist_ok=True)
            (local_dir / name).write_bytes(files[name])
            self.fetched.append(name)
            if "snapshot_download" in self.faults:  # after the first file
                raise self.faults.pop("snapshot_download")

    def _open(self, call: str, repo_id: str, repo_type: str | None) -> Repo:
        if call in self.faults:
            raise self.faults.pop(call)
        token = get_token()
        if token is not None and token not in ACCOUNTS:
            raise refused(401)
        repo = self.repos.get((repo_type or "model", repo_id))
        owner = ACCOUNTS[token][0] if token else None
        if repo is None or (repo.private and owner != repo_id.split("/")[0]):
            raise refused(404 if token else 401, kind=RepositoryNotFoundError)
        return repo
