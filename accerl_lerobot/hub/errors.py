# SPDX-License-Identifier: Apache-2.0
"""A client of the Hub that does not trust the server, and its failures as one line without the token.

`guard_client` makes huggingface_hub refuse answers by which a server could write elsewhere, and end what
would not end: version 1.33 joins commits and hashes from headers to paths as they are, follows pages as long
as there are any, sleeps as long as it is told to, and waits for a byte a second.
"""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import httpx
from huggingface_hub import constants, get_token, set_client_factory
from huggingface_hub.errors import (
    HfHubHTTPError,
    OfflineModeIsEnabled,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)
from huggingface_hub.utils._http import default_client_factory

from accerl_lerobot.checkpoint.safety import MIB, REVISION, brief
from accerl_lerobot.errors import InputError

CONNECT_S, SILENT_S = 30.0, 300.0
"""Timeouts of connecting and of each read; committing thousands of files takes a minute or two."""
WINDOW_S, SLOWEST = 60.0, 1024
"""Seconds over which an answer must come at so many bytes a second."""
ANSWERS_S, ANSWERS_MOST, REQUESTS_MOST = 600.0, 256 * MIB, 300
"""Seconds, bytes and requests until it is known how much there is to fetch."""
ETAG = re.compile(r'(W/)?"?[\w-]{1,128}"?', re.ASCII)
LOGIN = "log in with 'hf auth login', or set HF_TOKEN to a token"
AGAIN = "run the same command again, it resumes"


class Limits:
    """Bytes, requests and seconds that a server's answers may still take; unlimited until they are set."""

    def __init__(self, repo_id: str = "") -> None:
        self.repo_id, self._lock = repo_id, threading.Lock()
        self.set(float("inf"), float("inf"), float("inf"))

    def set(self, size: float, requests: float, seconds: float) -> None:
        self._size, self._requests, self._end = size, requests, time.monotonic() + seconds

    def take(self, size: int = 0, requests: int = 0) -> None:
        """Uses up some of it, and refuses the server where nothing is left."""
        with self._lock:
            self._size, self._requests = self._size - size, self._requests - requests
        left = {"bytes": self._size, "requests": self._requests, "time": self._end - time.monotonic()}
        for what in (what for what, rest in left.items() if rest < 0):
            raise self.distrust(f"answering takes more {what} than its files can need")

    def distrust(self, why: str) -> InputError:
        """The error to raise about the server's answer."""
        why = f"{constants.ENDPOINT} cannot be trusted: {why}; use another"
        return InputError("repo_id", self.repo_id, why)


_limits = Limits()


def guard_client() -> None:
    """Makes huggingface_hub use a client that checks answers, from now on in this process."""
    set_client_factory(_guarded_client)


@contextmanager
def hub_errors(repo_id: str, revision: str | None, *, writing: bool) -> Iterator[Limits]:
    """Turns all failures of the client into an `InputError`, and limits what answers to a pull may take.

    Yields:
        The limits, to be set again once it is known how much there is to fetch.
    """
    global _limits
    _limits = Limits(repo_id)
    if not writing:
        _limits.set(ANSWERS_MOST, REQUESTS_MOST, ANSWERS_S)
    guard_client()
    try:
        yield _limits
    except InputError:
        raise
    except Exception as error:
        if (explained := _explain(error, repo_id, revision, writing)) is None:
            raise
        raise explained from None  # the client's own words may hold a header
    finally:
        _limits = Limits()
        guard_client()  # closes the connections


def check_commit(commit: object, repo_id: str) -> str:
    """A commit as a server names it, which becomes part of paths: 40 hexadecimal digits, or refused."""
    if not isinstance(commit, str) or not REVISION.fullmatch(commit):
        shown = brief(ValueError(ascii(commit)))
        remedy = f"its server calls {shown} a commit, which has 40 hexadecimal digits; use another server"
        raise InputError("repo_id", repo_id, remedy)
    return commit


def _explain(error: BaseException, repo_id: str, revision: str | None, writing: bool) -> InputError | None:
    """The error in the user's words; None if it is not about the Hub."""
    chain = [error]
    while (cause := chain[-1].__cause__ or chain[-1].__context__) is not None and cause not in chain:
        chain.append(cause)
    for link in chain:
        if isinstance(link, RevisionNotFoundError):
            return InputError("revision", revision, f"{repo_id} has no such commit, tag or branch")
        if isinstance(link, HfHubHTTPError):
            return InputError("repo_id", repo_id, _status(link, writing))
        if isinstance(link, OfflineModeIsEnabled):
            return InputError("repo_id", repo_id, "the Hub is switched off by HF_HUB_OFFLINE; unset it")
        if isinstance(link, httpx.TransportError | ConnectionError | TimeoutError):
            why = f"{constants.ENDPOINT} cannot be reached ({type(link).__name__})"
            return InputError("repo_id", repo_id, f"{why}; see to the network and {AGAIN}")
    trace = error.__traceback__
    while trace is not None:
        if str(trace.tb_frame.f_globals.get("__name__")).startswith("huggingface_hub"):
            why = f"{type(error).__name__}: {_last_line(error)}"
            return InputError("repo_id", repo_id, f"the Hub, or this disk, does not work ({why}); {AGAIN}")
        trace = trace.tb_next
    return None


def _status(error: HfHubHTTPError, writing: bool) -> str:
    """Meaning of an HTTP status, and the remedy."""
    code, has_token = error.response.status_code, get_token() is not None
    role = "write" if writing else "read"
    if code == 401 and has_token and not isinstance(error, RepositoryNotFoundError):
        return f"the Hub does not accept the token; {LOGIN} that may {role}"
    if code in (401, 404) and not has_token:
        return f"it is not there, or private; {LOGIN} that may {role} it"
    if code in (401, 404):
        return "it is not there, or the token's account may not see it; mind the spelling and repo_type"
    if code == 403:
        return f"the token may not {role} here; use one with the right to {role}, and a user/ it belongs to"
    if code in (409, 412):
        return "somebody else wrote to it meanwhile; look at what is there and run the same command again"
    if code == 429:
        return "the Hub asks for fewer requests; wait a few minutes and run the same command again"
    if code >= 500:
        return f"the Hub is in trouble, it answered {code}; {AGAIN}"
    return f"the Hub answered {code}: {_last_line(error)}"


def _last_line(error: BaseException) -> str:
    """The last line of an error's text, which is what the server said, without the token."""
    token, text = get_token(), str(error).strip() or type(error).__name__
    return (text.replace(token, "<token>") if token else text).splitlines()[-1].strip()[:160]


def _guarded_client() -> httpx.Client:
    client = default_client_factory()
    client.timeout = httpx.Timeout(SILENT_S, connect=CONNECT_S)
    client.headers["Accept-Encoding"] = "identity"  # a compressed file has another size than was listed
    client.event_hooks = {**client.event_hooks, "response": [_check_answer]}
    for transport in (client._transport, *client._mounts.values()):
        if isinstance(transport, httpx.HTTPTransport):
            transport._pool._network_backend = _Backend(transport._pool._network_backend)
    return client


def _check_answer(response: httpx.Response) -> None:
    """Refuses an answer that is compressed, no JSON, or names a commit or a hash that is none."""
    _limits.take(requests=1)
    headers = response.headers
    if headers.get("content-encoding", "identity") not in ("", "identity"):
        raise _limits.distrust("its answers are compressed, though they must not be")
    for name in ("retry-after", "ratelimit"):
        headers.pop(name, None)  # the client's own pauses are bounded
    if (commit := headers.get("x-repo-commit")) is not None:
        check_commit(commit, _limits.repo_id)
        for name in ("etag", "x-linked-etag"):
            if name in headers and not ETAG.fullmatch(headers[name]):
                raise _limits.distrust(f"{name} {brief(ValueError(headers[name]))!r} is no hash")
    if response.is_success and "/api/" in response.url.path and response.request.method in ("GET", "POST"):
        response.read()
        try:
            content = response.json() if response.content else None
        except (ValueError, RecursionError) as error:
            raise _limits.distrust(f"its answer is not JSON ({brief(error)})") from None
        for commit in _commits(content):
            check_commit(commit, _limits.repo_id)


def _commits(content: Any) -> Iterator[object]:
    """Commits that an answer names."""
    if isinstance(content, dict):
        refs = [content[key] for key in ("branches", "tags") if isinstance(content.get(key), list)]
        named = [(ref, "targetCommit") for ref in sum(refs, []) if isinstance(ref, dict)]
        named += [(content, "sha"), (content, "commitOid")]
        yield from (mapping[key] for mapping, key in named if mapping.get(key) is not None)


class _Stream:
    """A connection that ends when answers come too slowly or are too long.

    Timeouts do not do that: they begin anew with every byte.
    """

    def __init__(self, stream: Any) -> None:
        self._stream, self._since, self._count = stream, 0.0, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        data: bytes = self._stream.read(max_bytes, min(timeout or SILENT_S, SILENT_S))
        _limits.take(size=len(data))
        now = time.monotonic()
        self._since, self._count = self._since or now, self._count + len(data)
        if now - self._since > WINDOW_S:
            if self._count < SLOWEST * WINDOW_S:
                raise _limits.distrust(f"it sends less than {SLOWEST} bytes a second")
            self._since, self._count = now, 0
        return data

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        self._since, self._count = 0.0, 0
        self._stream.write(buffer, timeout)

    def start_tls(self, *arguments: Any, **options: Any) -> _Stream:
        return _Stream(self._stream.start_tls(*arguments, **options))


class _Backend:
    """Opens connections that are a `_Stream`."""

    def __init__(self, backend: Any) -> None:
        self._backend = backend

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backend, name)

    def connect_tcp(self, *arguments: Any, **options: Any) -> _Stream:
        return _Stream(self._backend.connect_tcp(*arguments, **options))
