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
"""A pull is a whole folder that was checked, or none; what the server says is not taken on trust."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from accerl_lerobot import cli
from accerl_lerobot.checkpoint import defect, write_manifest
from accerl_lerobot.hub.manifest import MANIFEST
from tests.hub.folders import write_policy_folder, write_run_folder
from tests.hub_server import STRANGER, Fault, HubServer

NAME = "alice/door"
Files = dict[str, bytes]


@pytest.fixture
def policy(hub: HubServer, tmp_path: Path) -> Path:
    """Has been pushed."""
    folder = write_policy_folder(tmp_path / "policy")
    assert cli.main(["push", f"--path={folder}", f"--repo_id={NAME}"]) == 0
    hub.journal.clear()
    return folder


@pytest.fixture
def pulled(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., dict[str, Any]]:
    def do(*more: str, to: str = "pulled") -> dict[str, Any]:
        capsys.readouterr()
        assert cli.main(["pull", f"--repo_id={NAME}", f"--output_dir={tmp_path / to}", *more]) == 0
        found: dict[str, Any] = json.loads(capsys.readouterr().out)
        return found

    return do


@pytest.fixture
def refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """The one line of a pull that is refused; there is no folder then, and nothing else new."""

    def do(*more: str) -> str:
        before = {p for p in tmp_path.rglob("*") if not {"cache", "hub"} & set(p.relative_to(tmp_path).parts)}
        capsys.readouterr()
        assert cli.main(["pull", f"--repo_id={NAME}", f"--output_dir={tmp_path / 'pulled'}", *more]) == 2
        out, err = capsys.readouterr()
        (line,) = [line for line in err.splitlines() if line.startswith("accerl: ")]
        after = {p for p in tmp_path.rglob("*") if not {"cache", "hub"} & set(p.relative_to(tmp_path).parts)}
        assert out == "" and "Traceback" not in err
        assert {
            p for p in after - before if not p.relative_to(tmp_path).parts[0].startswith(".pulling-")
        } == set()
        return line

    return do


def contents_of(folder: Path) -> Files:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_what_comes_is_what_went(policy: Path, tmp_path: Path, pulled: Callable[..., dict[str, Any]]):
    found = pulled()
    came = contents_of(tmp_path / "pulled")
    assert came.keys() - contents_of(policy).keys() == {"README.md", "accerl_pulled.json"}
    assert {n: came[n] for n in contents_of(policy)} == contents_of(policy)
    assert found["checked"] == len(contents_of(policy)) and found["unchecked"] == 0
    assert list(tmp_path.glob(".*")) == []


def test_branches_tags_and_commits_are_pinned(
    hub: HubServer, policy: Path, tmp_path: Path, pulled: Callable[..., dict[str, Any]], refused: Any
):
    first = hub.repo(NAME).branches["main"]
    hub.repo(NAME).tags["best"] = hub.repo(NAME).branches["dev"] = first
    write_policy_folder(policy, seed=1)
    assert cli.main(["push", f"--path={policy}", f"--repo_id={NAME}"]) == 0
    second = hub.repo(NAME).branches["main"]
    wanted = {None: second, "main": second, "best": first, "dev": first, first: first}
    for i, (revision, commit) in enumerate(wanted.items()):
        found = pulled(*([f"--revision={revision}"] if revision else []), to=f"to {i}")
        record = json.loads((tmp_path / f"to {i}" / "accerl_pulled.json").read_text())
        assert found["commit"] == record["commit"] == commit and record["revision"] == revision
        same = (
            contents_of(tmp_path / f"to {i}")["model.safetensors"]
            == (policy / "model.safetensors").read_bytes()
        )
        assert same == (commit == second)
    assert "has no such commit, tag or branch" in refused("--revision=other")
    assert "has no such commit, tag or branch" in refused(f"--revision={'0' * 40}")


def test_a_folder_that_is_there_is_not_touched(
    hub: HubServer, policy: Path, tmp_path: Path, refused: Callable[..., str]
):
    (tmp_path / "pulled").mkdir()
    (tmp_path / "pulled" / "mine").write_text("mine")
    assert "the folder exists; choose another or remove it" in refused()
    assert contents_of(tmp_path / "pulled") == {"mine": b"mine"} and hub.journal == []


@pytest.mark.parametrize(
    "name",
    [
        "../escaped", "a/../../escaped", "/tmp/escaped-from-a-pull", "a//b", "./a", "..", "a/..", "a\\..\\b",
        ".cache/huggingface/download/x.metadata", ".git/config", "C:/escaped", "a/./b", "nul\0byte",
    ],
)  # fmt: skip
def test_names_that_lead_elsewhere(
    hub: HubServer, policy: Path, refused: Callable[..., str], name: str, tmp_path: Path
):
    hub.plant(NAME, {name: b"evil"})
    assert "which is not safe to write" in refused()
    assert not [path for method, path, _ in hub.journal if "/resolve/" in path], "nothing was fetched"
    assert not Path("/tmp/escaped-from-a-pull").exists() and list(tmp_path.glob(".pulling-*")) == []


def test_a_manifest_that_leads_elsewhere(
    hub: HubServer, policy: Path, refused: Callable[..., str], tmp_path: Path
):
    entry = {"size": 4, "sha256": "0" * 64}
    for files in ({"../policy/config.json": entry}, {"/etc/passwd": entry}):
        hub.plant(NAME, {MANIFEST: json.dumps({"format": 1, "kind": "policy", "files": files}).encode()})
        assert "not safe" in refused()
    for broken in (
        b"[]",
        b"{",
        b'{"format": 2}',
        b'{"format": 1, "kind": "policy", "files": {"a": 1}}',
        b'{"format": 1, "kind": "pickle", "files": {}}',
    ):
        hub.plant(NAME, {MANIFEST: broken})
        assert f"its {MANIFEST} is broken" in refused()
    assert list(tmp_path.glob(".pulling-*")) == []


@pytest.mark.parametrize(
    ("planted", "words"),
    [
        ({"model.safetensors": b"x" * 3000}, "model.safetensors is not what was pushed"),
        ({"model.safetensors": b"short"}, "came with 5 bytes instead of 3000"),
        ({"accerl.json": b"{}"}, "accerl.json came with 2 bytes instead of"),
    ],
)
def test_files_changed_since_the_push(
    hub: HubServer, policy: Path, refused: Callable[..., str], tmp_path: Path, planted: Files, words: str
):
    hub.plant(NAME, planted)
    assert words in refused()
    assert list(tmp_path.glob(".pulling-*")) == [], "going on would not make it better"


@pytest.mark.parametrize(
    ("planted", "words"),
    [
        ({"policy_preprocessor.json": b"[1]"}, "is not one of LeRobot's"),
        ({"config.json": b'{"spec": {}, "model": {}}'}, "says policy, but this is a world model"),
        ({"config.json": b"[]"}, "nothing that we know"),
    ],
)
def test_files_that_are_no_policy(
    hub: HubServer, policy: Path, refused: Callable[..., str], tmp_path: Path, planted: Files, words: str
):
    manifest = json.dumps({"format": 1, "kind": "policy", "files": {}}).encode()
    hub.plant(NAME, {MANIFEST: manifest, "backbone/config.json": b"{}"} | planted)
    assert words in refused()
    assert list(tmp_path.glob(".pulling-*")) == []


def test_files_gone_since_the_push(hub: HubServer, policy: Path, refused: Callable[..., str]):
    repo = hub.repo(NAME)
    del repo.commits[repo.branches["main"]]["accerl.json"]
    assert "accerl.json is missing there" in refused()


def test_an_edited_card_and_added_files_are_fine(
    hub: HubServer, policy: Path, pulled: Callable[..., dict[str, Any]], tmp_path: Path
):
    hub.plant(NAME, {"README.md": b"# edited on the Hub", "demo.gif": b"GIF"})
    pulled()
    assert (tmp_path / "pulled" / "README.md").read_bytes() == b"# edited on the Hub"


def test_code_that_a_recipe_could_name_does_not_come(
    hub: HubServer, policy: Path, pulled: Callable[..., dict[str, Any]], tmp_path: Path
):
    hub.plant(NAME, {"evil.py": b"raise SystemExit", "deep/er/x.so": b"\x7fELF", "notes.txt": b"py"})
    found = pulled()
    assert found["left_out"] == ["deep/er/x.so", "evil.py"]
    came = {path.name for path in (tmp_path / "pulled").rglob("*")}
    assert "notes.txt" in came and not {"evil.py", "x.so"} & came


def test_what_was_pushed_with_code_comes_without_it(
    hub: HubServer, pulled: Callable[..., dict[str, Any]], tmp_path: Path
):
    run = write_run_folder(tmp_path / "run")
    last = (run / "checkpoints" / "last").resolve()
    (last / "pretrained_model" / "convert.py").write_text("raise SystemExit")
    write_manifest(last)
    assert cli.main(["push", f"--path={run}", f"--repo_id={NAME}"]) == 0
    name = f"checkpoints/{last.name}"
    found = pulled(to="second")
    assert found["left_out"] == [f"{name}/pretrained_model/convert.py"] and found["kind"] == "run"
    assert not list((tmp_path / "second").rglob("*.py"))
    assert defect(tmp_path / "second" / name) is None, "its own list is of what is there"


def test_bytes_that_change_on_the_way(hub: HubServer, policy: Path, refused: Callable[..., str]):
    hub.faults.append(Fault("GET", "/model.safetensors", spoil=True))
    assert "model.safetensors is not what was pushed" in refused()


def test_a_cut_download_goes_on(
    hub: HubServer, policy: Path, refused: Any, pulled: Callable[..., dict[str, Any]], tmp_path: Path
):
    hub.faults.append(Fault("GET", "/model.safetensors", cut_after=0, times=6))
    line = refused()
    assert "run the same command again" in line and not (tmp_path / "pulled").exists()
    hub.faults.clear()
    fetched = {p for m, p, s in hub.journal if m == "GET" and s == 200 and "/resolve/" in p}
    hub.journal.clear()
    pulled()
    again = {p for m, p, s in hub.journal if m == "GET" and s == 200 and "/resolve/" in p}
    assert fetched and not fetched & again, "what had come is not fetched again"
    assert (
        contents_of(tmp_path / "pulled")["model.safetensors"] == (policy / "model.safetensors").read_bytes()
    )


def test_what_others_uploaded_has_no_manifest(
    hub: HubServer, tmp_path: Path, pulled: Callable[..., dict[str, Any]], refused: Any
):
    hub.plant(NAME, contents_of(write_policy_folder(tmp_path / "theirs")))
    found = pulled()
    assert found["kind"] == "policy" and found["checked"] == 0 and found["unchecked"] == 6
    hub.plant("alice/door", {"config.json": b"{}"})
    assert cli.main(["pull", f"--repo_id={NAME}", f"--output_dir={tmp_path / 'other'}"]) == 2
    assert not (tmp_path / "other").exists()


def test_names_that_two_have_or_nobody(
    hub: HubServer, policy: Path, refused: Any, pulled: Any, monkeypatch: Any
):
    hub.plant(NAME, {"meta/info.json": b"{}"}, repo_type="dataset")
    assert "alice/door is a model and a dataset; say which" in refused()
    assert pulled("--repo_type=model", to="other")["kind"] == "policy"
    monkeypatch.setenv("HF_TOKEN", STRANGER)
    assert "the token's account may not see it" in refused("--repo_id=alice/nowhere")
    monkeypatch.delenv("HF_TOKEN")
    assert "it is not there, or private; log in" in refused("--repo_id=alice/nowhere")
