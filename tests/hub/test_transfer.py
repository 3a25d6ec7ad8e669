# SPDX-License-Identifier: Apache-2.0
"""A push is one commit or none, a pull a checked folder or none; a refusal is one line without a token."""

import inspect
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import huggingface_hub
import pytest
import torch

from accerl_lerobot import cli
from accerl_lerobot.checkpoint.layout import check_names, save_checkpoint
from accerl_lerobot.checkpoint.safety import FileSource
from accerl_lerobot.errors import InputError
from accerl_lerobot.hub.card import MARK
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.loading import load_adapter
from accerl_lerobot.policies.saving import save_pretrained
from accerl_lerobot.testing import perturb
from accerl_lerobot.world_model.imagined import World, load_world, read_content, save_world
from tests.hub.fake_hub import CALLS, DOWNLOADS, NOBODY, READER, STRANGER, WRITER, FakeHub, refused
from tests.hub.folders import SUMMARY, refusal, write_json, write_policy_folder
from tests.world_model.test_pixels import dots, model, windows

TINY = Path(__file__).parents[2] / "datasets" / "metaworld_tiny"
NAME = "alice/door"
LAST = "checkpoints/last/pretrained_model"
Verb = Callable[..., dict[str, Any]]
Refusal = Callable[..., str]


@pytest.fixture
def policy(tmp_path: Path) -> Path:
    return write_policy_folder(tmp_path / "policy")


@pytest.fixture
def pushed(capsys: pytest.CaptureFixture[str]) -> Verb:
    def do(path: Path, *more: str, name: str = NAME) -> dict[str, Any]:
        capsys.readouterr()
        assert cli.main(["push", f"--path={path}", f"--repo_id={name}", *more]) == 0
        found: dict[str, Any] = json.loads(capsys.readouterr().out)
        return found

    return do


@pytest.fixture
def pulled(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Verb:
    def do(*more: str, to: str = "pulled", name: str = NAME) -> dict[str, Any]:
        capsys.readouterr()
        assert cli.main(["pull", f"--repo_id={name}", f"--output_dir={tmp_path / to}", *more]) == 0
        found: dict[str, Any] = json.loads(capsys.readouterr().out)
        return found

    return do


@pytest.fixture
def push_refused(capsys: pytest.CaptureFixture[str]) -> Refusal:
    """The one line of a push that is refused."""
    return lambda path, *more: refusal(capsys, "push", f"--path={path}", f"--repo_id={NAME}", *more)


@pytest.fixture
def pull_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Refusal:
    """The one line of a pull that is refused; there is no folder then."""

    def do(*more: str, name: str = NAME) -> str:
        line = refusal(capsys, "pull", f"--repo_id={name}", f"--output_dir={tmp_path / 'pulled'}", *more)
        assert not (tmp_path / "pulled").exists()
        return line

    return do


def contents_of(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_one_commit_that_holds_everything(hub: FakeHub, policy: Path, pushed: Verb):
    found = pushed(policy)
    repo = hub.repo(NAME)
    assert len(repo.commits) == 2 and repo.private
    assert repo.messages[found["commit"]] == "Policy pushed with accerl-lerobot"
    files = hub.files(NAME)
    assert set(files) - {"README.md"} == {p.name for p in policy.iterdir()}
    assert found["kind"] == "policy" and found["files"] == len(files)
    assert all(files[path.name] == path.read_bytes() for path in policy.iterdir())


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (refused(412), "somebody else wrote to it meanwhile"),
        (refused(403), "the token has no right to do this here"),
        (ConnectionError("cut"), "the Hub, the network or this disk does not work (cut); run"),
        (refused(400, f"bad token {WRITER}"), "bad token <token>"),
    ],
)
def test_whatever_breaks_there_is_no_half_a_commit(hub, policy, pushed, push_refused, fault, words):
    hub.faults["create_commit"] = fault
    assert words in push_refused(policy)
    assert hub.files(NAME) == {}
    pushed(policy)
    assert hub.files(NAME)["model.safetensors"] == (policy / "model.safetensors").read_bytes()


def test_tokens(hub, policy, push_refused, monkeypatch, tmp_path):
    monkeypatch.delenv("HF_TOKEN")
    assert "pushing needs a token; log in with 'hf auth login', or set HF_TOKEN" in push_refused(policy)
    monkeypatch.setenv("HF_TOKEN", NOBODY)
    assert "the Hub does not accept the token" in push_refused(policy)
    monkeypatch.setenv("HF_TOKEN", READER)
    assert "the token has no right to do this here; use another one" in push_refused(policy)
    assert hub.repos == {}
    assert "no such field" in push_refused(policy, f"--token={WRITER}")


def test_what_is_private_does_not_go_where_all_can_see(hub, policy, pushed, push_refused):
    assert not pushed(policy, "--private=false")["private"] and not hub.repo(NAME).private
    write_policy_folder(policy, seed=1)
    assert "this repository is public: add --private=false" in push_refused(policy)
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


def test_a_card_written_on_the_hub_stays(hub: FakeHub, policy: Path, pushed: Verb):
    pushed(policy)
    assert MARK.encode() in hub.files(NAME)["README.md"]
    hub.plant(NAME, {"README.md": b"# ours, edited\n"})
    write_policy_folder(policy, seed=1)
    pushed(policy)
    assert hub.files(NAME)["README.md"] == b"# ours, edited\n"
    (policy / "README.md").write_text("# mine\n")
    pushed(policy)
    assert hub.files(NAME)["README.md"] == b"# mine\n"


def test_a_dataset_is_tagged_where_lerobot_looks(hub, tmp_path, pushed, push_refused):
    dataset = shutil.copytree(TINY, tmp_path / "dataset")
    hub.faults["create_tag"] = refused(500)
    assert "does not work" in push_refused(dataset)
    first = pushed(dataset)  # the commit is there, the tag is not
    repo = hub.repo(NAME, "dataset")
    assert first["unchanged"] and repo.tags == {"v3.0": first["commit"]}
    write_json(dataset / "meta" / "more.json", {"origin": str(tmp_path)})
    assert repo.tags == {"v3.0": pushed(dataset)["commit"]} != {"v3.0": first["commit"]}


def test_branches_tags_and_commits_are_pinned(hub, policy, tmp_path, pushed, pulled, pull_refused):
    pushed(policy)
    first = hub.repo(NAME).branches["main"]
    hub.repo(NAME).tags["best"] = hub.repo(NAME).branches["dev"] = first
    write_policy_folder(policy, seed=1)
    pushed(policy)
    second = hub.repo(NAME).branches["main"]
    wanted = {None: second, "main": second, "best": first, "dev": first, first: first}
    for i, (revision, commit) in enumerate(wanted.items()):
        found = pulled(*([f"--revision={revision}"] if revision else []), to=f"to {i}")
        record = json.loads((tmp_path / f"to {i}" / "accerl_pulled.json").read_text())
        assert found["commit"] == record["commit"] == commit and record["revision"] == revision
        came, newest = (folder / "model.safetensors" for folder in (tmp_path / f"to {i}", policy))
        assert (came.read_bytes() == newest.read_bytes()) is (commit == second)
    assert "has no such commit, tag or branch" in pull_refused("--revision=other")
    assert "has no such commit, tag or branch" in pull_refused(f"--revision={'0' * 40}")


@pytest.mark.parametrize(
    "name", ["../escaped", "a/../../escaped", "/tmp/escaped-from-a-pull", "a\\..\\b", "C:/escaped"]
)
def test_names_that_lead_elsewhere(hub: FakeHub, pull_refused: Refusal, name: str, tmp_path: Path):
    hub.plant(NAME, {name: b"evil"})
    assert "not safe to write" in pull_refused() and hub.fetched == []
    assert not Path("/tmp/escaped-from-a-pull").exists() and list(tmp_path.glob(".pulling-*")) == []


@pytest.mark.parametrize(
    ("planted", "words"),
    [
        ({"policy_preprocessor.json": b"[1]"}, "policy_preprocessor.json: a mapping is wanted"),
        ({"config.json": b"[]"}, "neither a policy"),
    ],
)
def test_what_is_no_artifact_is_refused(hub, policy, pushed, pull_refused, tmp_path, planted, words):
    pushed(policy)
    hub.plant(NAME, {"backbone/config.json": b"{}"} | planted)
    assert words in pull_refused()
    assert list(tmp_path.glob(".pulling-*")) == [], "resuming would not make it better"


def test_code_that_a_recipe_could_name_does_not_come(hub, policy, pushed, pulled, tmp_path):
    pushed(policy)
    hub.plant(NAME, {"evil.py": b"raise", "deep/er/x.so": b"", ".git/config": b"", "notes.txt": b"py"})
    pulled()
    came = {path.name for path in (tmp_path / "pulled").rglob("*")}
    assert "notes.txt" in came and not {"evil.py", "x.so", ".git"} & came


def test_a_cut_download_goes_on(hub, policy, pushed, pull_refused, pulled, tmp_path):
    pushed(policy)
    hub.faults["snapshot_download"] = ConnectionError("cut")
    assert "run the same command again" in pull_refused()
    (begun,) = tmp_path.glob(".pulling-*")
    assert [path.name for path in begun.iterdir()] == hub.fetched, "what has come is kept"
    pulled()
    assert not begun.exists() and contents_of(policy).items() <= contents_of(tmp_path / "pulled").items()


def test_names_that_two_have_or_nobody(hub, policy, pushed, pull_refused, pulled, monkeypatch):
    pushed(policy, "--private=false")
    hub.plant(NAME, {"meta/info.json": b"{}"}, repo_type="dataset")
    assert pulled(to="other")["kind"] == "policy"
    monkeypatch.setenv("HF_TOKEN", STRANGER)
    assert "it is not there, or private" in pull_refused(name="alice/nowhere")
    monkeypatch.delenv("HF_TOKEN")
    assert "it is not there, or private: mind the spelling, or log in" in pull_refused(name="alice/nowhere")


ARENA = f"them/arena@{'0123456789' * 4}"


def test_no_recipe_that_was_pulled_lets_code_run(hub, policy, pushed, pulled, tmp_path, capsys):
    pushed(policy)
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
def test_no_place_of_this_machine_is_named(
    hub, policy, pushed, pull_refused, tmp_path, monkeypatch, file, content
):
    pushed(policy)
    monkeypatch.chdir(policy)
    names = [str(tmp_path), "~/secret", "../secret"]
    for name in names:
        write_json(policy / file, json.loads(json.dumps(content).replace("SECRET", name)))
        with pytest.raises(InputError, match=f"{file}: .* is a place on this machine"):
            check_names(policy, FileSource("policy.path", "theirs"))
    hub.plant(NAME, {file: (policy / file).read_bytes(), "adapter_model.safetensors": b"x"})
    assert f"{file}: " in (line := pull_refused()) and "is a place on this machine" in line


def test_no_place_of_this_machine_is_named_by_a_world_model_or_dataset(hub: FakeHub, pull_refused: Refusal):
    environment = {"spec": {}, "model": {"type": "theirs", "backbone": "/etc/ssl"}}
    hub.plant(
        "alice/environment", {"config.json": json.dumps(environment).encode(), "model.safetensors": b"x"}
    )
    assert "config.json: backbone: '/etc/ssl' is a place" in pull_refused(name="alice/environment")
    info = {"codebase_version": "v3.0", "data_path": "../{chunk_index}/{file_index}.parquet"}
    files = {"meta/info.json": json.dumps(info).encode(), "meta/episodes/x": b"", "data/x": b""}
    hub.plant("alice/data", files | {"meta/tasks.parquet": b""}, repo_type="dataset")
    assert "meta/info.json: data_path" in pull_refused(name="alice/data")


def test_a_policy_comes_back_as_it_was_and_loads(hub, tiny_checkpoint, tmp_path, pushed, pulled):
    """The last checkpoint of a run, with a critic and a backbone of its own; the run is moved meanwhile."""
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors

    config, run = PolicyConfig(path=str(tiny_checkpoint), device="cpu"), tmp_path / "run"
    adapter = load_adapter(config)
    perturb(adapter, 0.1)

    def write(directory: Path) -> int:
        save_pretrained(adapter, directory / "pretrained_model", config)
        return 12

    save_checkpoint(run / "checkpoints", write)
    (run / "config.yaml").write_text(f"output_dir: {tmp_path}/run\njob_name: tiny\n")
    write_json(run / "summary.json", SUMMARY)
    pushed(run / LAST)
    run.rename(tmp_path / "moved")
    came = pulled()["path"]
    again = load_adapter(PolicyConfig(path=came, device="cpu"))
    for one, other in ((adapter.policy, again.policy), (adapter.value_head, again.value_head)):
        assert all(torch.equal(value, other.state_dict()[name]) for name, value in one.state_dict().items())
    stock = get_policy_class("smolvla").from_pretrained(came)
    make_pre_post_processors(stock.config, pretrained_path=came)
    carried = Path(came) / "accerl_run"
    assert json.loads((carried / "summary.json").read_text()) == SUMMARY
    assert (carried / "config.yaml").read_text() == "output_dir: null\njob_name: tiny\n"
    assert pushed(came)["unchanged"], "there and back changes nothing"


def test_a_dataset_comes_back_as_it_was_and_is_pushed_once(hub, tmp_path, pushed, pulled):
    pushed(TINY)
    hub.plant(NAME, {"README.md": b"# edited on the Hub", "demo.gif": b"GIF"}, repo_type="dataset")
    found = pulled()
    came, edited = contents_of(tmp_path / "pulled"), {"README.md": b"# edited on the Hub"}
    assert (contents_of(TINY) | edited).items() <= came.items()
    assert found["files"] == len(came) - 1, "the record"
    commits = len(hub.repo(NAME, "dataset").commits)
    assert pushed(tmp_path / "pulled")["unchanged"] and len(hub.repo(NAME, "dataset").commits) == commits


def test_a_world_model_brings_its_success_model(hub: FakeHub, tmp_path: Path, pushed: Verb, pulled: Verb):
    world = World(model())
    world.model.fit_statistics(windows(dots(2)))
    save_world(tmp_path / "world_model", world, ["a"], ["auroc"])
    pushed(tmp_path / "world_model")
    pulled()
    came, content = load_world(tmp_path / "pulled"), read_content(tmp_path / "pulled")
    assert content["learnt"] == ["a"] and content["failed_checks"] == ["auroc"]
    assert (came.model.spec, came.model.config) == (world.model.spec, world.model.config)
    assert all(torch.equal(value, came.state_dict()[name]) for name, value in world.state_dict().items())


def test_the_hub_in_memory_is_called_as_the_client_is():
    for owner, names in ((huggingface_hub.HfApi, CALLS), (huggingface_hub, DOWNLOADS)):
        for name in names:
            ours, theirs = (inspect.signature(getattr(each, name)) for each in (FakeHub, owner))
            assert ours.parameters.keys() - {"self"} <= theirs.parameters.keys(), name
