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
from huggingface_hub.errors import HfHubHTTPError, OfflineModeIsEnabled, RevisionNotFoundError
from huggingface_hub.utils._http import default_client_factory

from accerl_lerobot.checkpoint.safety import REVISION
from accerl_lerobot.errors import InputError, causes

CONNECT_S, SILENT_S = 30.0, 300.0
"""Timeouts of connecting and of each read; committing thousands of files takes a minute or two."""
ETAG = re.compile(r'(W/)?"?[\w-]{1,128}"?', re.ASCII)
LOGIN = "log in with 'hf auth login', or set HF_TOKEN to a token"
AGAIN = "run the same command again, it resumes"
STATUS = {
    401: f"the Hub does not accept the token; {LOGIN} that may read and write it",
    403: "the token has no right to do this here; use another one, and a user/ it belongs to",
    404: f"it is not there, or private: mind the spelling, or {LOGIN} that may see it",
    412: "somebody else wrote to it meanwhile; look at what is there and run the same command again",
    429: "the Hub asks for fewer requests; wait a few minutes and run the same command again",
}


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
    if "x-repo-commit" not in headers:
        return
    check_commit(headers["x-repo-commit"])
    for name in ("etag", "x-linked-etag"):
        if name in headers and not ETAG.fullmatch(headers[name]):
            why = f"its {name} {ascii(headers[name])[:99]} is no hash; use another server"
            raise InputError("HF_ENDPOINT", constants.ENDPOINT, why)


@contextmanager
def hub_errors(repo_id: str, revision: str | None) -> Iterator[None]:
    """Turns all failures of the client into an `InputError`."""
    guard_client()
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        explained = _explain(error, repo_id, revision)
        if explained is None:
            raise
        raise explained from None  # the client's own words may hold a header


def _explain(error: BaseException, repo_id: str, revision: str | None) -> InputError | None:
    """The error in the user's words; None if it is not about the Hub."""
    for link in causes(error):
        if isinstance(link, RevisionNotFoundError):
            return InputError("revision", revision, f"{repo_id} has no such commit, tag or branch")
        if isinstance(link, HfHubHTTPError):
            return InputError("repo_id", repo_id, _status(link))
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


def _status(error: HfHubHTTPError) -> str:
    code = error.response.status_code
    if code == 401 and get_token() is None:  # the Hub's answer to a stranger who asks for what is not there
        code = 404
    return STATUS.get(code) or f"the Hub answered {code}: {_last_line(error)}; {AGAIN}"


def _last_line(error: BaseException) -> str:
    """The last line of an error's text, which is what the server said, without the token."""
    text = str(error).strip() or type(error).__name__
    token = get_token()
    if token:
        text = text.replace(token, "<token>")
    return text.splitlines()[-1].strip()[:160]
