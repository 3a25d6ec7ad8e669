# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""What can go wrong between here and the Hub, each as one line with its remedy and without the token."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

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

from accerl_lerobot.errors import InputError

CONNECT_S, SILENT_S = 30.0, 300.0
"""Seconds until a Hub that does not answer, or stops answering, counts as unreachable. The client has no
limit of its own; committing thousands of files takes a minute or two."""
LOGIN = "log in with 'hf auth login', or set HF_TOKEN to a token"
AGAIN = "run the same command again, it goes on where it was"


@contextmanager
def told(repo_id: str, revision: str | None, *, writing: bool) -> Iterator[None]:
    """Turns the client's failures into an `InputError`; nothing waits for ever meanwhile.

    Args:
        repo_id: what is talked about.
        revision: of it.
        writing: whether the token must be one that may write.

    Raises:
        InputError: whatever went wrong between here and the Hub.
    """
    set_client_factory(_patient_client)
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        found = explain(error, repo_id, revision, writing)
        if found is None:
            raise
        raise found from None  # the client's own words may hold a header
    finally:
        set_client_factory(default_client_factory)


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
    return None


def _answered(error: HfHubHTTPError, writing: bool) -> str:
    """What the Hub's answer means, and what to do."""
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


def _patient_client() -> httpx.Client:
    client = default_client_factory()
    client.timeout = httpx.Timeout(SILENT_S, connect=CONNECT_S)
    return client
