# SPDX-License-Identifier: Apache-2.0
"""A Hub in memory, and this process as one of its clients."""

from pathlib import Path

import pytest
from huggingface_hub import constants

from accerl_lerobot.hub import transfer
from tests.hub.fake_hub import DOWNLOADS, WRITER, FakeHub


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> FakeHub:
    """This process may write."""
    made = FakeHub(tmp_path / "hub")
    monkeypatch.setattr(transfer, "HfApi", lambda: made)
    for name in DOWNLOADS:
        monkeypatch.setattr(transfer, name, getattr(made, name))
    monkeypatch.setattr(constants, "HF_TOKEN_PATH", str(tmp_path / "no-token"))
    monkeypatch.setenv("HF_TOKEN", WRITER)
    return made
