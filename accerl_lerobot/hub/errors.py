# SPDX-License-Identifier: Apache-2.0
"""A client of the Hub whose answers cannot lead it elsewhere, and its failures as one line without the token.

huggingface_hub 1.33 joins commits and hashes from headers to paths as they are, and has no timeout.
"""

from __future__ import annotations

import re
import traceback
from collections.abc import Iterator
from contextlib import contextmanager

import httpx
from huggingface_hub import constants, get_token, set_client_factory
from huggingface_hub.errors import (
    HfHubHTTPError,
    OfflineModeIsEnabled,
    RepositoryNotFoundError,
    RevisionNotFoundError,
)
from huggingface_hub.utils._http import default_client_factory

from accerl_lerobot.checkpoint.safety import REVISION
from accerl_lerobot.errors import InputError, causes

CONNECT_S, SILENT_S = 30.0, 300.0
"""Timeouts of connecting and of each read; committing thousands of files takes a minute or two."""
ETAG = re.compile(r'(W/)?"?[\w-]{1,128}"?', re.ASCII)
LOGIN = "log in with 'hf auth login', or set HF_TOKEN to a token"
AGAIN = "run the same command again, it resumes"


def guard_client() -> None:
    """Makes huggingface_hub use a client that checks answers, from now on in this process."""
    set_client_factory(_guarded_client)


def check_commit(commit: object) -> str:
    """A commit as a server names it, which becomes part of paths: 40 hexadecimal digits, or refused."""
    if not isinstance(commit, str) or not REVISION.fullmatch(commit):
        why = f"it calls {ascii(commit)[:99]} a commit, which has 40 hexadecimal digits"
        raise InputError("HF_ENDPOINT", constants.ENDPOINT, f"{why}; use another server")
    return commit


def _guarded_client() -> httpx.Client:
    client = default_client_factory()
    client.timeout = httpx.Timeout(SILENT_S, connect=CONNECT_S)
    client.event_hooks = {**client.event_hooks, "response": [_check_answer]}
    return client


def _check_answer(response: httpx.Response) -> None:
    headers = response.headers
    if (commit := headers.get("x-repo-commit")) is not None:
        check_commit(commit)
        for name in ("etag", "x-linked-etag"):
            if name in headers and not ETAG.fullmatch(headers[name]):
                why = f"its {name} {ascii(headers[name])[:99]} is no hash; use another server"
                raise InputError("HF_ENDPOINT", constants.ENDPOINT, why)


@contextmanager
def hub_errors(repo_id: str, revision: str | None, *, writing: bool) -> Iterator[None]:
    """Turns all failures of the client into an `InputError`."""
    guard_client()
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        if (explained := _explain(error, repo_id, revision, writing)) is None:
            raise
        raise explained from None  # the client's own words may hold a header


def _explain(error: BaseException, repo_id: str, revision: str | None, writing: bool) -> InputError | None:
    """The error in the user's words; None if it is not about the Hub."""
    for link in causes(error):
        if isinstance(link, RevisionNotFoundError):
            return InputError("revision", revision, f"{repo_id} has no such commit, tag or branch")
        if isinstance(link, HfHubHTTPError):
            return InputError("repo_id", repo_id, _status(link, "write" if writing else "read"))
        if isinstance(link, OfflineModeIsEnabled):
            return InputError("repo_id", repo_id, "the Hub is switched off by HF_HUB_OFFLINE; unset it")
        if isinstance(link, httpx.TransportError | ConnectionError | TimeoutError):
            why = f"{constants.ENDPOINT} cannot be reached ({type(link).__name__})"
            return InputError("repo_id", repo_id, f"{why}; see to the network and {AGAIN}")
    modules = (str(frame.f_globals.get("__name__")) for frame, _ in traceback.walk_tb(error.__traceback__))
    if any(module.startswith("huggingface_hub") for module in modules):
        why = f"{type(error).__name__}: {_last_line(error)}"
        return InputError("repo_id", repo_id, f"the Hub, or this disk, does not work ({why}); {AGAIN}")
    return None


def _status(error: HfHubHTTPError, role: str) -> str:
    code = error.response.status_code
    if code in (401, 404):
        if get_token() is None:
            return f"it is not there, or private; {LOGIN} that may {role} it"
        if code == 401 and not isinstance(error, RepositoryNotFoundError):
            return f"the Hub does not accept the token; {LOGIN} that may {role}"
        return "it is not there, or the token's account may not see it; mind the spelling"
    if code == 403:
        return f"the token may not {role} here; use one with the right to {role}, and a user/ it belongs to"
    if code in (409, 412):
        return "somebody else wrote to it meanwhile; look at what is there and run the same command again"
    if code == 429:
        return "the Hub asks for fewer requests; wait a few minutes and run the same command again"
    return f"the Hub answered {code}: {_last_line(error)}; {AGAIN}"


def _last_line(error: BaseException) -> str:
    """The last line of an error's text, which is what the server said, without the token."""
    token, text = get_token(), str(error).strip() or type(error).__name__
    return (text.replace(token, "<token>") if token else text).splitlines()[-1].strip()[:160]
