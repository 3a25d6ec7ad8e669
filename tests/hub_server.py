# SPDX-License-Identifier: Apache-2.0
"""A Hub on 127.0.0.1: as much of its protocol as huggingface_hub 1.33 speaks when it pushes and pulls.

Blobs, which any upload may leave behind, and commits, which name blobs and appear whole or not at all, are
apart as in a real one. Storage is by LFS, and not by Xet. `HubServer.faults` says what breaks.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

LARGE = (".safetensors", ".parquet", ".mp4", ".png", ".bin")  # stored as LFS objects
WRITER, READER, STRANGER = "hf_writerwriterwriter", "hf_readerreaderreader", "hf_strangerstranger"
NOBODY = "hf_nobodysnobodys"  # which the server does not know
ACCOUNTS = {WRITER: ("alice", "write"), READER: ("alice", "read"), STRANGER: ("mallory", "write")}


@dataclass
class Fault:
    """Requests of a method whose path has `match` in it get a `status`, or are cut after some bytes."""

    method: str
    match: str
    status: int = 0
    says: str = "as it was told to"
    cut_after: int = -1
    times: int = 1


Files = dict[str, bytes]


@dataclass
class Repo:
    """Branches and tags point at commits, commits hold files."""

    private: bool
    commits: dict[str, Files] = field(default_factory=dict)
    branches: dict[str, str] = field(default_factory=dict)
    tags: dict[str, str] = field(default_factory=dict)
    messages: dict[str, str] = field(default_factory=dict)

    def resolve(self, revision: str) -> str:
        commit = self.branches.get(revision) or self.tags.get(revision) or revision
        if commit not in self.commits:
            raise RefusedError(404, "RevisionNotFound", "Invalid rev id")
        return commit

    def commit(self, branch: str, files: Files, message: str) -> str:
        oid = hashlib.sha1(f"{len(self.commits)} {message} {time.monotonic_ns()}".encode()).hexdigest()
        self.commits[oid], self.messages[oid], self.branches[branch] = files, message, oid
        return oid


class RefusedError(Exception):
    """An answer that is an error."""

    def __init__(self, status: int, code: str = "", message: str = "no") -> None:
        super().__init__(message)
        self.status, self.code = status, code


class HubServer(ThreadingHTTPServer):
    """The server; `url` is what clients take for the Hub, `folder` is for large files that are uploaded."""

    daemon_threads = True

    def __init__(self, folder: Path) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.blobs = folder
        self.repos: dict[tuple[str, str], Repo] = {}
        self.faults: list[Fault] = []
        self.journal: list[tuple[str, str, int]] = []  # method, path and status of every answer
        self.uploaded: list[str] = []  # sha256 of every large file that came whole
        self.lock = threading.Lock()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"

    def repo(self, repo_id: str, repo_type: str = "model") -> Repo:
        return self.repos[repo_type, repo_id]

    def files(self, repo_id: str, repo_type: str = "model", revision: str = "main") -> Files:
        """Names and contents of a commit."""
        repo = self.repo(repo_id, repo_type)
        return dict(repo.commits[repo.resolve(revision)])

    def plant(self, repo_id: str, files: Files, repo_type: str = "model") -> str:
        """Commits files without asking any client, under whatever names; returns the commit."""
        repo = self.repos.setdefault((repo_type, repo_id), Repo(private=False))
        there = repo.commits.get(repo.branches.get("main", ""), {})
        return repo.commit("main", there | files, "planted")

    def fault(self, method: str, path: str) -> Fault | None:
        with self.lock:
            for fault in self.faults:
                if fault.times and fault.method == method and fault.match in path:
                    fault.times -= 1
                    return fault
        return None

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Connections that are cut end here; there is nobody to tell."""


class Handler(BaseHTTPRequestHandler):
    """One connection."""

    server: HubServer
    protocol_version = "HTTP/1.1"
    wbufsize = -1  # head and body at once: two packets cost a delayed acknowledgement, 40 ms

    def log_message(self, format: str, *arguments: Any) -> None:
        pass

    def __getattr__(self, name: str) -> Any:
        if name.startswith("do_"):  # GET, HEAD, POST, PUT and DELETE differ in the answer only
            return self._answer
        raise AttributeError(name)

    def _answer(self) -> None:
        path = unquote(urlsplit(self.path).path)
        fault = self.server.fault(self.command, path)
        if fault is not None and fault.cut_after >= 0:
            self.rfile.read(fault.cut_after)
            self.close_connection = True
            self.connection.shutdown(2)
            return
        body = self._body()
        try:
            if fault is not None and fault.status:
                raise RefusedError(fault.status, message=fault.says)
            self._route(path, body)
        except RefusedError as refused:
            headers = {"X-Error-Message": str(refused)}
            if refused.code:
                headers["X-Error-Code"] = refused.code
            self._json({"error": str(refused)}, refused.status, headers)

    def _body(self) -> bytes:
        if self.headers.get("Transfer-Encoding") == "chunked":
            parts = []
            while size := int(self.rfile.readline(), 16):
                parts.append(self.rfile.read(size))
                self.rfile.readline()
            self.rfile.readline()
            return b"".join(parts)
        return self.rfile.read(int(self.headers.get("Content-Length") or 0))

    def _send(self, status: int, data: bytes, headers: dict[str, str]) -> None:
        with self.server.lock:
            self.server.journal.append((self.command, unquote(urlsplit(self.path).path), status))
        self.send_response(status)
        for key, value in ({"Content-Length": str(len(data))} | headers).items():
            self.send_header(key, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    def _json(self, value: Any, status: int = 200, headers: dict[str, str] | None = None) -> None:
        self._send(status, json.dumps(value).encode(), {"Content-Type": "application/json"} | (headers or {}))

    def _route(self, path: str, body: bytes) -> None:
        who = self._account()
        if path.startswith("/lfs/"):
            return self._receive(path.rsplit("/", 1)[1], body)
        if path == "/api/whoami-v2":
            return self._json({"name": who[0], "type": "user", "auth": {}} if who else None)
        if path == "/api/validate-yaml":  # of a card
            return self._json({"errors": [], "warnings": []})
        if path == "/api/repos/create":
            return self._create(json.loads(body), who)
        if found := re.fullmatch(r"/(datasets/)?([^/]+/[^/]+)\.git/info/lfs/objects/batch", path):
            self._open("dataset" if found[1] else "model", found[2], who, writing=True)
            return self._batch(json.loads(body))
        if found := re.fullmatch(r"/(datasets/)?([^/]+/[^/]+)/resolve/([^/]+)/(.+)", path):
            repo = self._open("dataset" if found[1] else "model", found[2], who)
            return self._resolve(repo, found[3], found[4])
        found = re.fullmatch(r"/api/(model|dataset)s/([^/]+/[^/]+)(?:/([a-z-]+)(?:/(.+))?)?", path)
        if found is None:
            raise RefusedError(404, message=f"no route {path}")
        kind, repo_id, verb, rest = found.groups()
        writing = verb in ("commit", "preupload", "tag")
        return self._api(self._open(kind, repo_id, who, writing=writing), repo_id, verb, rest, body)

    def _account(self) -> tuple[str, str] | None:
        given = self.headers.get("authorization", "").removeprefix("Bearer ")
        if given and given not in ACCOUNTS:
            raise RefusedError(401, message="Invalid credentials in Authorization header")
        return ACCOUNTS.get(given)

    def _open(self, kind: str, repo_id: str, who: tuple[str, str] | None, *, writing: bool = False) -> Repo:
        repo = self.server.repos.get((kind, repo_id))
        owner = who is not None and repo_id.split("/")[0] == who[0]
        if repo is None or repo.private and not owner:
            raise RefusedError(404 if who else 401, "RepoNotFound", "Repository not found")
        if writing and not (owner and who is not None and who[1] == "write"):
            raise RefusedError(403 if who else 401, message="you do not have the right to write here")
        return repo

    def _create(self, given: dict[str, Any], who: tuple[str, str] | None) -> None:
        if who is None:
            raise RefusedError(401, message="Invalid username or password.")
        owner = given.get("organization") or who[0]
        if owner != who[0] or who[1] != "write":
            raise RefusedError(403, message=f"you may not create repositories under {owner}")
        key = given.get("type", "model"), f"{owner}/{given['name']}"
        if key in self.server.repos:
            return self._json({"error": "exists", "url": f"{self.server.url}/{key[1]}"}, 409)
        repo = self.server.repos[key] = Repo(private=given.get("visibility") == "private")
        attributes = b"*.safetensors filter=lfs diff=lfs merge=lfs -text\n"
        repo.commit("main", {".gitattributes": attributes}, "initial commit")
        self._json({"url": f"{self.server.url}/{key[1]}", "name": key[1]})

    def _api(self, repo: Repo, repo_id: str, verb: str | None, rest: str | None, body: bytes) -> None:
        if verb == "refs":  # LeRobot asks for the tags of a dataset
            tags = [{"name": n, "ref": f"refs/{n}", "targetCommit": c} for n, c in repo.tags.items()]
            return self._json({"branches": [], "converts": [], "tags": tags})
        if verb == "tag" and self.command == "DELETE":
            if rest not in repo.tags:
                raise RefusedError(404, "RevisionNotFound", "Invalid rev id")
            return self._json(repo.tags.pop(rest))
        commit = repo.resolve(rest or "main")
        files = repo.commits[commit]
        if verb in (None, "revision"):
            told = {"id": repo_id, "sha": commit, "private": repo.private, "tags": []}
            return self._json(told | {"siblings": [{"rfilename": name} for name in files]})
        if verb in ("tree", "paths-info"):
            wanted = json.loads(body)["paths"] if body else files
            return self._json([_listed(name, files[name]) for name in files if name in wanted])
        if verb == "tag":
            repo.tags[json.loads(body)["tag"]] = commit
            return self._json({})
        if verb == "preupload":
            return self._json({"files": [_mode(f["path"], files) for f in json.loads(body)["files"]]})
        if verb == "commit":
            return self._commit(repo, repo_id, str(rest), body)
        raise RefusedError(404, message=f"no verb {verb}")

    def _commit(self, repo: Repo, repo_id: str, branch: str, body: bytes) -> None:
        lines = [json.loads(line) for line in body.decode().splitlines()]
        with self.server.lock:
            files = dict(repo.commits[repo.branches[branch]])
            header = lines[0]["value"]
            if header.get("parentCommit") not in (None, repo.branches[branch]):
                raise RefusedError(412, message="A commit has happened since. Please refresh and try again.")
            for line in lines[1:]:
                value = line["value"]
                if line["key"] == "file":
                    files[value["path"]] = base64.b64decode(value["content"])
                elif line["key"] == "lfsFile":
                    files[value["path"]] = (self.server.blobs / value["oid"]).read_bytes()
                else:
                    del files[value["path"]]
            oid = repo.commit(branch, files, header["summary"])
        self._json({"commitUrl": f"{self.server.url}/{repo_id}/commit/{oid}", "commitOid": oid})

    def _batch(self, asked: dict[str, Any]) -> None:
        for item in asked["objects"]:
            if not (self.server.blobs / item["oid"]).is_file():
                item["actions"] = {"upload": {"href": f"{self.server.url}/lfs/{item['oid']}"}}
        self._json({"transfer": "basic", "objects": asked["objects"]})

    def _receive(self, oid: str, body: bytes) -> None:
        if hashlib.sha256(body).hexdigest() != oid:
            raise RefusedError(400, message="the content is not what its hash says")
        (self.server.blobs / oid).write_bytes(body)
        self.server.uploaded.append(oid)
        self._json({})

    def _resolve(self, repo: Repo, revision: str, name: str) -> None:
        commit = repo.resolve(revision)
        if name not in repo.commits[commit]:
            raise RefusedError(404, "EntryNotFound", "Entry not found")
        data = repo.commits[commit][name]
        etag = f'"{_oid(name, data)}"'
        headers = {"X-Repo-Commit": commit, "ETag": etag, "Content-Type": "application/octet-stream"}
        self._send(200, data, headers)


def _oid(name: str, data: bytes) -> str:
    """What LFS or Git names a file by."""
    if name.endswith(LARGE):
        return hashlib.sha256(data).hexdigest()
    return hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()


def _listed(name: str, data: bytes) -> dict[str, Any]:
    entry: dict[str, Any] = {"type": "file", "path": name, "size": len(data), "oid": _oid(name, data)}
    if name.endswith(LARGE):
        entry["lfs"] = {"oid": entry["oid"], "size": len(data), "pointerSize": 130}
    return entry


def _mode(path: str, files: Files) -> dict[str, Any]:
    mode = "lfs" if path.endswith(LARGE) else "regular"
    answer = {"path": path, "uploadMode": mode, "shouldIgnore": False}
    return answer | ({"oid": _oid(path, files[path])} if path in files else {})


@contextmanager
def serving(folder: Path) -> Iterator[HubServer]:
    """A server of its own, until the end."""
    folder.mkdir(parents=True, exist_ok=True)
    with HubServer(folder) as server:
        threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
        try:
            yield server
        finally:
            server.shutdown()


def environment(server: HubServer, home: Path, token: str | None = WRITER) -> dict[str, str]:
    """Environment of a process that takes the server for the Hub, with an empty cache in `home`."""
    found = {
        "HF_ENDPOINT": server.url, "HF_HOME": str(home), "HF_HUB_OFFLINE": "0", "HF_HUB_DISABLE_XET": "1",
        "HF_HUB_DISABLE_PROGRESS_BARS": "1", "HF_HUB_DISABLE_TELEMETRY": "1",
        "HF_HUB_DISABLE_UPDATE_CHECK": "1",
    }  # fmt: skip
    return found | ({"HF_TOKEN": token} if token else {})
