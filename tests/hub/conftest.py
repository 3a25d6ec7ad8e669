# SPDX-License-Identifier: Apache-2.0
"""A Hub on this machine, and this process as one of its clients."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.hub_server import WRITER, HubServer, serving


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[HubServer]:
    """This process knows the server's address, has an empty cache, may write, and does not wait to retry."""
    from huggingface_hub import constants, file_download
    from huggingface_hub.utils import _http

    with serving(tmp_path / "hub") as server:
        template = f"{server.url}/{{repo_id}}/resolve/{{revision}}/{{filename}}"
        monkeypatch.setattr(constants, "ENDPOINT", server.url)
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
        monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(tmp_path / "no-token"))
        monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
        monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
        for module in (_http, file_download):  # which wait between two attempts
            monkeypatch.setattr(module, "time", SimpleNamespace(**vars(time) | {"sleep": lambda s: None}))
        monkeypatch.setenv("HF_TOKEN", WRITER)
        yield server
