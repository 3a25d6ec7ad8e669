# SPDX-License-Identifier: Apache-2.0
"""A push is one commit or none, whatever breaks, and every refusal is one line that says what to do."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from accerl_lerobot.checkpoint.layout import digest
from tests.hub.folders import refusal, told, write_json, write_policy_folder
from tests.hub_server import NOBODY, READER, WRITER, Fault

TINY = Path(__file__).parents[2] / "datasets" / "metaworld_tiny"
NAME = "alice/door"


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    return write_policy_folder(tmp_path / "policy")


@pytest.fixture
def pushed(capsys: pytest.CaptureFixture[str]) -> Callable[..., dict[str, Any]]:
    return lambda path, *more: told(capsys, "push", f"--path={path}", f"--repo_id={NAME}", *more)


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    return lambda path, *more: refusal(capsys, "push", f"--path={path}", f"--repo_id={NAME}", *more)


def test_one_commit_that_holds_everything(hub, policy, pushed):
    found = pushed(policy)
    repo, files = hub.repo(NAME), hub.files(NAME)
    assert len(repo.commits) == 2 and repo.private
    assert set(files) - {".gitattributes", "README.md"} == {p.name for p in policy.iterdir()}
    assert found["kind"] == "policy" and found["files"] == len(files) - 1
    assert all(files[path.name] == path.read_bytes() for path in policy.iterdir())
    again = pushed(policy)
    assert again["commit"] == found["commit"] and again["unchanged"] and not found["unchanged"]
    assert len(repo.commits) == 2 and len(hub.uploaded) == 2, "nothing is sent twice"


def test_a_cut_upload_leaves_the_repository_as_it_was_and_goes_on(hub, policy, pushed, refused):
    pushed(policy)
    before = dict(hub.repo(NAME).branches)
    hub.uploaded.clear()
    write_policy_folder(policy, size=400_000, seed=1)
    large = digest(policy / "model.safetensors")
    hub.faults.append(Fault("PUT", large, cut_after=1000, times=6))  # the client tries six times
    line = refused(policy)
    assert "the network or this disk does not work" in line and "run the same command again" in line
    assert hub.repo(NAME).branches == before and len(hub.repo(NAME).commits) == 2
    pushed(policy)
    small = digest(policy / "value_head.safetensors")
    assert hub.uploaded == [small, large], "the small one is not sent again"
    assert hub.files(NAME)["model.safetensors"] == (policy / "model.safetensors").read_bytes()


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (Fault("POST", "/commit/", status=412), "somebody else wrote to it meanwhile"),
        (Fault("POST", "/commit/", cut_after=0), "the Hub, the network or this disk does not work"),
        (Fault("POST", "/commit/", status=400, says=f"bad token {WRITER}"), "bad token <token>"),
    ],
)
def test_whatever_breaks_there_is_no_half_a_commit(hub, policy, pushed, refused, fault, words):
    fault = Fault(**vars(fault))  # the table is shared
    hub.faults.append(fault)
    assert words in refused(policy)
    assert set(hub.files(NAME)) == {".gitattributes"}
    fault.times = 0
    pushed(policy)
    assert hub.files(NAME)["model.safetensors"] == (policy / "model.safetensors").read_bytes()


def test_tokens(hub, policy, refused, monkeypatch, tmp_path):
    monkeypatch.delenv("HF_TOKEN")
    assert "pushing needs a token; log in with 'hf auth login', or set HF_TOKEN" in refused(policy)
    monkeypatch.setenv("HF_TOKEN", NOBODY)
    assert "the Hub does not accept the token" in refused(policy)
    monkeypatch.setenv("HF_TOKEN", READER)
    assert "the token has no right to do this here; use another one" in refused(policy)
    assert hub.repos == {}
    assert "no such field" in refused(policy, f"--token={WRITER}")


def test_what_is_private_does_not_go_where_all_can_see(hub, policy, pushed, refused):
    assert not pushed(policy, "--private=false")["private"] and not hub.repo(NAME).private
    write_policy_folder(policy, seed=1)
    assert "this repository is public: add --private=false" in refused(policy)
    pushed(policy, "--private=false")


def test_a_push_replaces_what_the_last_one_left_but_not_what_a_card_shows(hub, policy, pushed):
    (policy / "family.safetensors").write_bytes(b"x")
    pushed(policy)
    assert "family.safetensors" in hub.files(NAME)
    added = {"added on the Hub.gif": b"by hand", "LICENSE": b"mine", "notes/a.json": b"{}"}
    hub.plant(NAME, added)
    (policy / "family.safetensors").unlink()
    pushed(policy)
    assert "family.safetensors" not in hub.files(NAME) and added.items() <= hub.files(NAME).items()


def test_a_card_written_on_the_hub_stays(hub, policy, pushed):
    pushed(policy)
    hub.plant(NAME, {"README.md": b"# ours, edited\n"})
    write_policy_folder(policy, seed=1)
    pushed(policy)
    assert hub.files(NAME)["README.md"] == b"# ours, edited\n"


def test_a_dataset_is_tagged_where_lerobot_looks(hub, tmp_path, pushed, refused):
    dataset = shutil.copytree(TINY, tmp_path / "dataset")
    hub.faults.append(Fault("POST", "/tag/", status=500))
    assert "does not work" in refused(dataset)
    first = pushed(dataset)  # the commit is there, the tag is not
    repo = hub.repo(NAME, "dataset")
    assert first["unchanged"] and repo.tags == {"v3.0": first["commit"]}
    write_json(dataset / "meta" / "more.json", {"origin": str(tmp_path)})
    assert repo.tags == {"v3.0": pushed(dataset)["commit"]} != {"v3.0": first["commit"]}
