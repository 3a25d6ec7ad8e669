# SPDX-License-Identifier: Apache-2.0
"""A pull is a whole folder that was checked, or none; what the server says is not taken on trust."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from accerl_lerobot import cli
from tests.hub.folders import refusal, told, write_policy_folder
from tests.hub_server import STRANGER, Fault, HubServer

NAME = "alice/door"


@pytest.fixture
def policy(hub: HubServer, tmp_path: Path) -> Path:
    """Has been pushed."""
    folder = write_policy_folder(tmp_path / "policy")
    assert cli.main(["push", f"--path={folder}", f"--repo_id={NAME}"]) == 0
    hub.journal.clear()
    return folder


@pytest.fixture
def pulled(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., dict[str, Any]]:
    place = f"--output_dir={tmp_path}"
    return lambda *more, to="pulled": told(capsys, "pull", f"--repo_id={NAME}", f"{place}/{to}", *more)


@pytest.fixture
def refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """The one line of a pull that is refused; there is no folder then, and nothing else new."""

    def do(*more: str, name: str = NAME) -> str:
        before = set(tmp_path.iterdir())
        line = refusal(capsys, "pull", f"--repo_id={name}", f"--output_dir={tmp_path / 'pulled'}", *more)
        assert {path for path in tmp_path.iterdir() if ".pulling-" not in path.name} <= before
        return line

    return do


def contents_of(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_what_comes_is_what_went(hub, policy, tmp_path, pulled):
    found = pulled()
    came = contents_of(tmp_path / "pulled")
    assert came.keys() - contents_of(policy).keys() == {"README.md", "accerl_pulled.json"}
    assert {n: came[n] for n in contents_of(policy)} == contents_of(policy)
    assert found["files"] == len(contents_of(policy)) + 1, "the card"
    hub.plant(NAME, {"README.md": b"# edited on the Hub", "demo.gif": b"GIF"})
    pulled(to="edited")
    assert (tmp_path / "edited" / "README.md").read_bytes() == b"# edited on the Hub"
    assert list(tmp_path.glob(".*")) == []


def test_branches_tags_and_commits_are_pinned(hub, policy, tmp_path, pulled, refused):
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
        weights = contents_of(tmp_path / f"to {i}")["model.safetensors"]
        assert (weights == (policy / "model.safetensors").read_bytes()) == (commit == second)
    assert "has no such commit, tag or branch" in refused("--revision=other")
    assert "has no such commit, tag or branch" in refused(f"--revision={'0' * 40}")


@pytest.mark.parametrize(
    "name", ["../escaped", "a/../../escaped", "/tmp/escaped-from-a-pull", "a\\..\\b", "C:/escaped"]
)
def test_names_that_lead_elsewhere(hub, policy, refused, name, tmp_path):
    hub.plant(NAME, {name: b"evil"})
    assert "not safe to write" in refused()
    assert not [path for method, path, _ in hub.journal if "/resolve/" in path], "nothing was fetched"
    assert not Path("/tmp/escaped-from-a-pull").exists() and list(tmp_path.glob(".pulling-*")) == []


@pytest.mark.parametrize(
    ("planted", "words"),
    [
        ({"policy_preprocessor.json": b"[1]"}, "policy_preprocessor.json: a mapping is wanted"),
        ({"config.json": b"[]"}, "neither a policy"),
    ],
)
def test_what_is_no_artifact_is_refused(hub, policy, refused, tmp_path, planted, words):
    hub.plant(NAME, {"backbone/config.json": b"{}"} | planted)
    assert words in refused()
    assert list(tmp_path.glob(".pulling-*")) == [], "resuming would not make it better"


def test_code_that_a_recipe_could_name_does_not_come(hub, policy, pulled, tmp_path):
    names = ("evil.py", "deep/er/x.so", ".git/config", "notes.txt")
    hub.plant(NAME, dict.fromkeys(names, b"raise SystemExit"))
    pulled()
    came = {path.name for path in (tmp_path / "pulled").rglob("*")}
    assert "notes.txt" in came and not {"evil.py", "x.so", ".git"} & came


def test_a_cut_download_goes_on(hub, policy, refused, pulled, tmp_path):
    hub.faults.append(Fault("GET", "/model.safetensors", cut_after=0, times=6))
    assert "run the same command again" in refused()
    pulled()
    fetched = [path for method, path, status in hub.journal if (method, status) == ("GET", 200)]
    files = [path for path in fetched if "/resolve/" in path]
    assert files and len(files) == len(set(files)), "what had come is not fetched again"
    weights = contents_of(tmp_path / "pulled")["model.safetensors"]
    assert weights == (policy / "model.safetensors").read_bytes()


def test_names_that_two_have_or_nobody(hub, policy, refused, pulled, monkeypatch):
    hub.plant(NAME, {"meta/info.json": b"{}"}, repo_type="dataset")
    assert pulled(to="other")["kind"] == "policy"
    monkeypatch.setenv("HF_TOKEN", STRANGER)
    assert "it is not there, or private" in refused(name="alice/nowhere")
    monkeypatch.delenv("HF_TOKEN")
    assert "it is not there, or private: mind the spelling, or log in" in refused(name="alice/nowhere")


ARENA = f"them/arena@{'0123456789' * 4}"


def test_no_recipe_that_was_pulled_lets_code_run(hub, policy, pulled, tmp_path, capsys):
    recipe = (
        "env: {type: lerobot, name: isaaclab_arena, trust_remote_code: true,\n"
        f"  kwargs: {{hub_path: '{ARENA}'}}}}\npolicy: {{path: a/b}}\nsft: {{steps: 0}}\n"
        "launch: {address: 'them:6379', placement: {rollout: all}}\n"
    )
    hub.plant(NAME, {"accerl_run/config.yaml": recipe.encode()})
    pulled()
    capsys.readouterr()
    run = tmp_path / "pulled" / "accerl_run"
    (run / ".lock").touch()
    (run / "episodes.jsonl").touch()
    for verb in (["train"], ["train", "--resume=true"], ["eval"], ["doctor"]):
        assert cli.main([*verb, f"--config_path={run / 'config.yaml'}"]) in (1, 2)
        assert "a file cannot allow this, only the command line can" in "".join(capsys.readouterr())
    assert cli.main(["export", f"--path={run}", f"--root={tmp_path / 'set'}"]) == 2
    assert f"add --env.trust_remote_code=true --env.kwargs.hub_path={ARENA}" in capsys.readouterr().err


STEP = {"registry_name": "tokenizer_processor", "config": {"tokenizer_name": "SECRET"}}


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("config.json", {"type": "smolvla", "n_obs_steps": 1, "vlm_model_name": "SECRET"}),
        ("policy_preprocessor.json", {"steps": [STEP]}),
        ("adapter_config.json", {"peft_type": "LORA", "base_model_name_or_path": "SECRET"}),
        ("backbone/tokenizer_config.json", {"vocab_file": "SECRET"}),
        ("accerl_run/config.yaml", {"dataset": {"repo_id": "a/b", "root": "SECRET"}}),
        ("accerl_run/config.yaml", {"policy": {"path": "SECRET"}}),
    ],
)
def test_no_place_of_this_machine_is_named(hub, policy, refused, tmp_path, monkeypatch, file, content):
    (tmp_path / "hub" / "secret").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "hub")
    for name in (str(tmp_path / "hub" / "secret"), "~/secret", "../secret"):
        text = json.dumps(content).replace("SECRET", name)
        hub.plant(NAME, {file: text.encode(), "adapter_model.safetensors": b"x"})
        assert f"{file}: " in (line := refused()) and "is a place on this machine" in line


def test_places_that_nothing_reads_are_no_reason_to_refuse(hub, policy, pulled, tmp_path):
    gone = {"vlm_model_name": "/gone/backbone", "pretrained_path": "/gone/pretrained"}
    files = {
        "config.json": json.loads((policy / "config.json").read_text()) | gone,
        "train_config.json": {"dataset": {"root": "/data/mine"}, "output_dir": "/data/out"},
        "backbone/config.json": {"_name_or_path": "/gone", "text_config": {"_name_or_path": "/gone"}},
        "backbone/tokenizer_config.json": {"name_or_path": "/gone", "pad_token": "/", "eos_token": "</s>"},
    }
    hub.plant(NAME, {name: json.dumps(content).encode() for name, content in files.items()})
    pulled()
    config = json.loads((tmp_path / "pulled" / "config.json").read_text())
    assert config["vlm_model_name"] == str(tmp_path / "pulled" / "backbone")


def test_a_folder_that_is_there_is_not_touched(hub, policy, tmp_path, refused):
    (tmp_path / "pulled").mkdir()
    (tmp_path / "pulled" / "mine").write_text("mine")
    assert "the folder exists; choose another or remove it" in refused()
    assert contents_of(tmp_path / "pulled") == {"mine": b"mine"} and hub.journal == []
