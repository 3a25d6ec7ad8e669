# SPDX-License-Identifier: Apache-2.0
"""Client of the Hub that does not trust the server, and its failures as one line without the token.

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
from pathlib import Path
from typing import Any

import httpx
from huggingface_hub import constants, get_token, set_client_factory
from huggingface_hub.errors import (
    EntryNotFoundError,
    HfHubHTTPError,
    HFValidationError,
    LocalTokenNotFoundError,
    OfflineModeIsEnabled,
    RepositoryNotFoundError,
    RevisionNotFoundError,
    XetDownloadError,
)
from huggingface_hub.utils._http import default_client_factory

from accerl_lerobot.checkpoint.safety import MIB, REVISION, brief
from accerl_lerobot.errors import InputError

CONNECT_S, SILENT_S = 30.0, 300.0
"""Seconds until a Hub that does not answer, or stops answering, counts as unreachable. The client has no
limit of its own; committing thousands of files takes a minute or two."""
WINDOW_S, SLOWEST = 60.0, 1024
"""Seconds over which an answer must come at so many bytes a second."""
ANSWERS_S, ANSWERS_MOST, REQUESTS_MOST = 600.0, 256 * MIB, 300
"""Seconds, bytes and requests until it is known what there is to fetch."""
ETAG = re.compile(r'(W/)?"?[\w-]{1,128}"?', re.ASCII)
LOGIN = "log in with 'hf auth login', or set HF_TOKEN to a token"
AGAIN = "run the same command again, it goes on where it was"


class Allowance:
    """Bytes, requests and seconds that answers of a server may take; without arguments, any number.

    Args:
        repo_id: whose server it is, for the error.
        count: bytes.
        requests: number of them.
        seconds: until all of it is over.
    """

    def __init__(
        self,
        repo_id: str,
        count: float = float("inf"),
        requests: float = float("inf"),
        seconds: float = float("inf"),
    ) -> None:
        self.repo_id, self.lock = repo_id, threading.Lock()
        self.renew(count, requests, seconds)

    def renew(self, count: float, requests: float, seconds: float) -> None:
        """Begins anew with other limits."""
        with self.lock:
            self.count, self.requests, self.end = count, requests, time.monotonic() + seconds

    def take(self, *, count: int = 0, requests: int = 0) -> None:
        """Uses some of it.

        Raises:
            InputError: there is none left.
        """
        with self.lock:
            self.count, self.requests = self.count - count, self.requests - requests
            left = {"bytes": self.count, "requests": self.requests, "time": self.end - time.monotonic()}
        for what, rest in left.items():
            if rest < 0:
                raise self.refuse(f"answering takes more {what} than what it holds can need")

    def refuse(self, why: str) -> InputError:
        """The error to raise about the server's answer."""
        return InputError(
            "repo_id", self.repo_id, f"{constants.ENDPOINT} cannot be trusted: {why}; use another"
        )


_allowance = Allowance("")


def guard_client() -> None:
    """Has huggingface_hub talk through a client that checks answers, from now on in this process."""
    set_client_factory(_guarded_client)


@contextmanager
def told(repo_id: str, revision: str | None, *, writing: bool) -> Iterator[Allowance]:
    """Turns the client's failures into an `InputError`; nothing waits for ever meanwhile.

    Args:
        repo_id: what is talked about.
        revision: of it.
        writing: whether the token must be one that may write.

    Returns:
        What the server may take, to be renewed once it is known how much there is to fetch.

    Raises:
        InputError: whatever went wrong between here and the Hub.
    """
    global _allowance
    _allowance = Allowance(repo_id) if writing else Allowance(repo_id, ANSWERS_MOST, REQUESTS_MOST, ANSWERS_S)
    guard_client()
    try:
        yield _allowance
    except InputError:
        raise
    except Exception as error:
        found = explain(error, repo_id, revision, writing)
        if found is None:
            raise
        raise found from None  # the client's own words may hold a header
    finally:
        _allowance = Allowance("")
        guard_client()  # closes the connections


def explain(error: BaseException, repo_id: str, revision: str | None, writing: bool) -> InputError | None:
    """The error in the user's words; None if it is not about the Hub."""
    chain = [error]
    while (cause := chain[-1].__cause__ or chain[-1].__context__) is not None and cause not in chain:
        chain.append(cause)
    field, value = "repo_id", repo_id
    for link in chain:
        if isinstance(link, OfflineModeIsEnabled):
            return InputError(field, value, "the Hub is switched off by HF_HUB_OFFLINE; unset it")
        if isinstance(link, LocalTokenNotFoundError):
            return InputError(field, value, f"there is no token; {LOGIN}")
        if isinstance(link, RevisionNotFoundError):
            return InputError("revision", revision, f"{repo_id} has no such commit, tag or branch")
        if isinstance(link, HFValidationError):
            return InputError(field, value, f"name a repository as user/name ({_brief(link)})")
        if isinstance(link, httpx.TooManyRedirects):
            return InputError(field, value, f"{constants.ENDPOINT} redirects in a circle; use another")
        if isinstance(link, HfHubHTTPError):
            return InputError(field, value, _answered(link, writing))
        if isinstance(link, httpx.TransportError | ConnectionError | TimeoutError):
            reached = f"{constants.ENDPOINT} cannot be reached ({type(link).__name__})"
            return InputError(field, value, f"{reached}; see to the network and {AGAIN}")
    if isinstance(error, XetDownloadError | EntryNotFoundError) or "xet" in type(error).__module__:
        return InputError(field, value, f"the transfer broke off ({_brief(error)}); {AGAIN}")
    if isinstance(error, ValueError) and ("LFS" in str(error) or "README.md" in str(error)):
        return InputError(field, value, f"the Hub refused it: {_brief(error)}")
    if isinstance(error, OSError) and "Consistency check failed" in str(error):
        return InputError(field, value, f"a file came incomplete; {AGAIN}")
    if any("huggingface_hub" in Path(frame.co_filename).parts for frame in _frames(error)):
        why = f"{type(error).__name__}: {_brief(error)}"
        return InputError(field, value, f"the Hub's answer, or this disk, cannot be used ({why})")
    return None


def _frames(error: BaseException) -> Iterator[Any]:
    trace = error.__traceback__
    while trace is not None:
        yield trace.tb_frame.f_code
        trace = trace.tb_next


def _answered(error: HfHubHTTPError, writing: bool) -> str:
    """Meaning of the Hub's answer, and the remedy."""
    code = error.response.status_code
    has_token = get_token() is not None
    if code == 401 and has_token and not isinstance(error, RepositoryNotFoundError):
        return f"the Hub does not accept the token; {LOGIN}{' that may write' if writing else ''}"
    if code in (401, 404) and not has_token:
        what = "needs a token" if writing else "is not there, or private"
        return f"it {what}; {LOGIN}{' that may write' if writing else ' of an account that may see it'}"
    if code in (401, 404):
        return "it is not there, or the token's account may not see it; mind the spelling and repo_type"
    if code == 403:
        role = "write" if writing else "read"
        return f"the token may not {role} here; use one with the right to {role}, and a user/ it belongs to"
    if code in (409, 412):
        return "somebody else wrote to it meanwhile; look at what is there and run the same command again"
    if code == 429:
        return "the Hub asks for fewer requests; wait a few minutes and run the same command again"
    if code >= 500:
        return f"the Hub is in trouble, it answered {code}; {AGAIN}"
    return f"the Hub answered {code}: {_brief(error)}"


def _brief(error: BaseException) -> str:
    """The last line of an error's words, which is what the server said."""
    token, text = get_token(), str(error)
    lines = [line.strip() for line in (text.replace(token, "<token>") if token else text).splitlines()]
    return ([line for line in lines if line] or [type(error).__name__])[-1][:160]


def _guarded_client() -> httpx.Client:
    client = default_client_factory()
    client.timeout = httpx.Timeout(SILENT_S, connect=CONNECT_S)
    client.headers["Accept-Encoding"] = "identity"  # what is packed has another size than was listed
    client.event_hooks = {**client.event_hooks, "response": [_check_answer]}
    for transport in (client._transport, *client._mounts.values()):
        if isinstance(transport, httpx.HTTPTransport):
            transport._pool._network_backend = _Backend(transport._pool._network_backend)
    return client


def _check_answer(response: httpx.Response) -> None:
    """Looks at an answer before huggingface_hub does.

    Raises:
        InputError: it is packed, no JSON, or names a commit or a hash that is none.
    """
    _allowance.take(requests=1)
    headers = response.headers
    if headers.get("content-encoding", "identity") not in ("", "identity"):
        raise _allowance.refuse("its answers are packed, though they must not be")
    for name in ("retry-after", "ratelimit"):
        headers.pop(name, None)  # the client's own pauses grow, and end
    if (commit := headers.get("x-repo-commit")) is not None:
        check_commit(commit, _allowance.repo_id)
        for name in ("etag", "x-linked-etag"):
            if name in headers and not ETAG.fullmatch(headers[name]):
                raise _allowance.refuse(f"{name} {brief(ValueError(headers[name]))!r} is no hash")
    if response.is_success and "/api/" in response.url.path and response.request.method in ("GET", "POST"):
        response.read()
        try:
            content = response.json() if response.content else None
        except (ValueError, RecursionError) as error:
            raise _allowance.refuse(f"its answer is not JSON ({brief(error)})") from None
        for commit in _commits(content):
            check_commit(commit, _allowance.repo_id)


def _commits(content: Any) -> Iterator[object]:
    """Commits that an answer names."""
    if not isinstance(content, dict):
        return
    yield from (content[key] for key in ("sha", "commitOid") if content.get(key) is not None)
    for key in ("branches", "tags"):
        refs = content.get(key)
        yield from (
            ref["targetCommit"] for ref in (refs if isinstance(refs, list) else ()) if _has_commit(ref)
        )


def _has_commit(ref: object) -> bool:
    return isinstance(ref, dict) and "targetCommit" in ref


def check_commit(commit: object, repo_id: str) -> str:
    """A commit as a server names it, which becomes part of paths.

    Raises:
        InputError: it is not 40 hexadecimal digits.
    """
    if not isinstance(commit, str) or not REVISION.fullmatch(commit):
        shown = brief(ValueError(ascii(commit)))
        remedy = f"its server calls {shown} a commit, which has 40 hexadecimal digits; use another server"
        raise InputError("repo_id", repo_id, remedy)
    return commit


class _Stream:
    """A connection that ends when answers come too slowly or are too long.

    Not by timeouts: these begin anew with every byte, and huggingface_hub tries again after them.
    """

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self._since, self._count = 0.0, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        data: bytes = self._stream.read(max_bytes, min(timeout or SILENT_S, SILENT_S))
        _allowance.take(count=len(data))
        now = time.monotonic()
        self._since = self._since or now
        self._count += len(data)
        if now - self._since > WINDOW_S:
            if self._count < SLOWEST * WINDOW_S:
                raise _allowance.refuse(f"it sends less than {SLOWEST} bytes a second")
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
