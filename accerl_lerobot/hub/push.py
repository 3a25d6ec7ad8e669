# SPDX-License-Identifier: Apache-2.0
"""From a folder to one commit on the Hub.

Large files go first, each under its hash, and the commit that names them last: a push that is cut leaves the
repository as it was, and the next one uploads only what the Hub does not have yet. A commit says what it is
on top of, so two pushes at a time do not mix.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from huggingface_hub import CommitOperationAdd, CommitOperationDelete, HfApi, get_token, hf_hub_download
from huggingface_hub.errors import EntryNotFoundError, RepositoryNotFoundError

from accerl_lerobot.errors import InputError
from accerl_lerobot.hub.around import look_around
from accerl_lerobot.hub.card import MARK, dataset_card, model_card
from accerl_lerobot.hub.config import REPO_TYPES, PushConfig
from accerl_lerobot.hub.contents import Files, contents
from accerl_lerobot.hub.kinds import CODEBASE_VERSION, DATASET, recognise, repo_type
from accerl_lerobot.hub.manifest import CARD, MANIFEST, Manifest, entry_of, read_manifest, write_manifest
from accerl_lerobot.hub.portable import cleaned, is_record
from accerl_lerobot.hub.trouble import LOGIN, told

logger = logging.getLogger(__name__)


def push(config: PushConfig) -> dict[str, Any]:
    """Pushes; returns what was pushed and the commit it has become, plain JSON.

    Raises:
        InputError: the folder is nothing that can be pushed, or the Hub does not take it; whatever was there
            is as before.
    """
    folder, repo_id = Path(str(config.path)).expanduser(), str(config.repo_id)
    kind = recognise(folder)
    files, own_card = staged(config, folder, kind)
    if get_token() is None:
        raise InputError("repo_id", repo_id, f"pushing needs a token; {LOGIN} that may write")
    with told(repo_id, config.revision, writing=True):
        return _Push(config, kind, files, own_card).run()


def staged(config: PushConfig, folder: Path, kind: str) -> tuple[Files, bool]:
    """Everything that will be uploaded but the manifest, and whether the card is the user's own."""
    around = look_around(folder, kind, config.evaluation)
    files = contents(folder, kind, config.include)
    for name, path in around.files.items():
        files[name] = cleaned(name, path.read_bytes(), folder) if is_record(name) else path
    card = folder / CARD
    if card.is_file() and MARK not in (text := card.read_text()):
        files[CARD] = cleaned(CARD, text.encode(), folder)
        return files, True
    repo_id = str(config.repo_id)
    text = (
        dataset_card(repo_id, folder) if kind == DATASET else model_card(repo_id, kind, folder, files, around)
    )
    files[CARD] = cleaned(CARD, text.encode(), folder)
    return files, False


class _Push:
    """One push, under way.

    Args:
        config: what the user wants.
        kind: of the folder.
        files: to upload.
        own_card: whether the card among them is the user's.
    """

    def __init__(self, config: PushConfig, kind: str, files: Files, own_card: bool) -> None:
        self.config, self.kind, self.files, self.own_card = config, kind, files, own_card
        self.repo_id, self.revision = str(config.repo_id), config.revision
        self.type = repo_type(kind)
        self.api = HfApi()

    def run(self) -> dict[str, Any]:
        parent = self._prepare()
        before = self._before(parent)
        self._keep_their_card(parent)
        entries = {name: entry_of(content) for name, content in self.files.items() if name != CARD}
        uploads = dict(self.files) | {MANIFEST: write_manifest(Manifest(self.kind, entries))}
        operations: list[CommitOperationAdd | CommitOperationDelete] = []
        for name, content in uploads.items():
            operation = CommitOperationAdd(name, content)
            if name in entries:  # it has been read once already
                operation.upload_info.sha256 = bytes.fromhex(str(entries[name].sha256))
            operations.append(operation)
        gone = sorted(before.files.keys() - uploads.keys()) if before is not None else []
        there = self._names(parent) if gone else set()
        operations += [CommitOperationDelete(name, is_folder=False) for name in gone if name in there]
        message = self.config.message or f"{self.kind.capitalize()} pushed with accerl-lerobot"
        commit = self.api.create_commit(
            self.repo_id,
            operations,
            commit_message=message,
            repo_type=self.type,
            revision=self.revision,
            parent_commit=parent,
        ).oid
        if self.kind == DATASET and self.revision == "main":
            self._tag(commit)
        prefix = "datasets/" if self.type == "dataset" else ""
        return {
            "kind": self.kind,
            "repo_id": self.repo_id,
            "repo_type": self.type,
            "revision": self.revision,
            "commit": commit,
            "unchanged": commit == parent,
            "private": bool(self._info().private),
            "files": len(uploads),
            "bytes": sum(entry.size for entry in entries.values()),
            "url": f"{self.api.endpoint}/{prefix}{self.repo_id}",
        }

    def _prepare(self) -> str:
        """Makes the repository if need be; returns the commit to go on top of.

        Raises:
            InputError: there is another kind of thing under this name, it is public, or has no such branch.
        """
        try:
            info = self._info()
        except RepositoryNotFoundError:
            self._create()
            info = self._info()
        if self.config.private and info.private is False:
            remedy = "this repository is public: add --private=false, or choose another name"
            raise InputError("private", True, remedy)
        refs = self.api.list_repo_refs(self.repo_id, repo_type=self.type)
        branches = {branch.name: branch.target_commit for branch in refs.branches}
        if self.revision not in branches:
            there = ", ".join(sorted(branches)) or "none"
            make = f"hf repos branch create {self.repo_id} {self.revision}"
            remedy = f"{self.repo_id} has no such branch, but {there}; make it with '{make}'"
            raise InputError("revision", self.revision, remedy)
        return str(branches[self.revision])

    def _create(self) -> None:
        (other,) = set(REPO_TYPES) - {self.type}
        if self.api.repo_exists(self.repo_id, repo_type=other):
            remedy = f"it is a {other} repository, and this is a {self.kind}; choose another name"
            raise InputError("repo_id", self.repo_id, remedy)
        if self.revision != "main":
            remedy = f"{self.repo_id} is new, and has only main; push to main first"
            raise InputError("revision", self.revision, remedy)
        self.api.create_repo(self.repo_id, private=self.config.private, repo_type=self.type, exist_ok=True)

    def _before(self, commit: str) -> Manifest | None:
        """Manifest of the last push there.

        Raises:
            InputError: something of another kind.
        """
        data = self._read(MANIFEST, commit)
        if data is None:
            return None
        try:
            before = read_manifest(data, self.repo_id)
        except InputError as error:
            logger.warning("%s", error)  # which this push does
            return None
        if before.kind != self.kind:
            remedy = f"it holds a {before.kind}, and this is a {self.kind}; choose another name or branch"
            raise InputError("repo_id", self.repo_id, remedy)
        return before

    def _keep_their_card(self, commit: str) -> None:
        """Somebody may have written a card on the Hub; it gives way only to one of the user's own."""
        if self.own_card:
            return
        there = self._read(CARD, commit)
        if there is not None and MARK.encode() not in there and there.strip():
            logger.warning("the README.md on the Hub is left as it is, somebody wrote it")
            self.files[CARD] = there

    def _read(self, name: str, commit: str) -> bytes | None:
        try:
            path = hf_hub_download(
                self.repo_id, name, repo_type=self.type, revision=commit, endpoint=self.api.endpoint
            )
        except EntryNotFoundError:
            return None
        return Path(path).read_bytes()

    def _names(self, commit: str) -> set[str]:
        return set(self.api.list_repo_files(self.repo_id, revision=commit, repo_type=self.type))

    def _tag(self, commit: str) -> None:
        """LeRobot looks for a dataset under the tag of its format's version."""
        refs = self.api.list_repo_refs(self.repo_id, repo_type=self.type)
        tagged = {tag.name: tag.target_commit for tag in refs.tags}
        if tagged.get(CODEBASE_VERSION) == commit:
            return
        if CODEBASE_VERSION in tagged:
            self.api.delete_tag(self.repo_id, tag=CODEBASE_VERSION, repo_type=self.type)
        self.api.create_tag(self.repo_id, tag=CODEBASE_VERSION, revision=commit, repo_type=self.type)

    def _info(self) -> Any:
        return self.api.repo_info(self.repo_id, repo_type=self.type)
