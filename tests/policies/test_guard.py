# SPDX-License-Identifier: Apache-2.0
"""Code and pickles that come with a model, and networks that are built to be filled."""

from __future__ import annotations

import json
import pickle
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.guard import Unfilled, guarded, input_error
from accerl_lerobot.policies.loading import load_adapter
from tests.policies.checkpoints import edit_config, write_gaussian_actor

COMMIT, NEWER = "0" * 39 + "1", "0" * 39 + "2"
CODE = """
from pathlib import Path
from transformers import PretrainedConfig
Path({marker!r}).touch()
class TheirConfig(PretrainedConfig):
    model_type = "theirs"
    commit = {commit!r}
"""


class Repository:
    """A model in the Hub's cache whose code leaves a mark when it is run; the newest version is `NEWER`."""

    def __init__(self, cache: Path) -> None:
        self.marker, self.name = cache / "was-run", "them/model"
        self.folder = cache / "models--them--model"
        for commit in (COMMIT, NEWER):
            snapshot = self.folder / "snapshots" / commit
            snapshot.mkdir(parents=True)
            code = CODE.format(marker=str(self.marker), commit=commit)
            (snapshot / "their_code.py").write_text(code)
            auto = {"AutoConfig": "their_code.TheirConfig", "AutoModel": "their_code.TheirModel"}
            (snapshot / "config.json").write_text(json.dumps({"model_type": "theirs", "auto_map": auto}))
        (self.folder / "refs").mkdir()
        (self.folder / "refs" / "main").write_text(NEWER)


@pytest.fixture
def theirs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Repository]:
    from huggingface_hub import constants
    from transformers import dynamic_module_utils

    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
    monkeypatch.setattr(dynamic_module_utils, "HF_MODULES_CACHE", str(tmp_path / "modules"))
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield Repository(tmp_path)
    for name in [name for name in sys.modules if name.startswith("transformers_modules")]:
        del sys.modules[name]


def load(name: str, **options: Any) -> Any:
    from transformers import AutoConfig

    return AutoConfig.from_pretrained(name, **options)


def test_code_is_run_without_a_guard(theirs: Repository):
    assert load(theirs.name, trust_remote_code=True).commit == NEWER
    assert theirs.marker.exists(), "or the tests below show nothing"


def test_code_on_the_hub_is_refused(theirs: Repository):
    with guarded("policy"), pytest.raises(InputError) as caught:
        load(theirs.name, trust_remote_code=True)
    assert str(caught.value).startswith("policy.trust_remote_code=") and "their_code.py" in str(caught.value)
    assert "policy.trust_remote_code=true and policy.code_revision" in caught.value.remedy
    assert not theirs.marker.exists()


def test_nobody_is_asked_at_the_terminal(theirs: Repository, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("builtins.input", lambda *_: "y")
    with guarded("policy"), pytest.raises(ValueError, match="trust_remote_code"):
        load(theirs.name)
    assert not theirs.marker.exists()


def test_code_in_a_folder_is_refused_even_where_a_commit_is_named(theirs: Repository, tmp_path: Path):
    folder = tmp_path / "downloaded"
    (theirs.folder / "snapshots" / COMMIT).rename(folder)
    for revision in (None, COMMIT):
        with guarded("policy", revision), pytest.raises(InputError, match="^policy.trust_remote_code="):
            load(str(folder), trust_remote_code=True)
    assert not theirs.marker.exists()


def test_the_commit_that_is_named_is_run_and_no_other(theirs: Repository):
    with guarded("policy", "f" * 40), pytest.raises((OSError, InputError)):
        load(theirs.name, trust_remote_code=True)
    assert not theirs.marker.exists()
    with guarded("policy", COMMIT):
        assert load(theirs.name, trust_remote_code=True).commit == COMMIT
    assert theirs.marker.exists()


def test_a_checkpoint_cannot_have_its_encoder_s_code_run(
    theirs: Repository, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    path = write_gaussian_actor(tmp_path / "policy", image=64)
    edit_config(path, vision_encoder_name=theirs.name)
    with pytest.raises(InputError) as caught:
        load_adapter(PolicyConfig(path=str(path), device="cpu"))
    assert str(caught.value).startswith("policy.trust_remote_code=") and not theirs.marker.exists()
    trusting = PolicyConfig(path=str(path), device="cpu", trust_remote_code=True, code_revision=COMMIT)
    with pytest.raises(InputError, match="its network cannot be built"):  # it is a config and no encoder
        load_adapter(trusting)
    assert theirs.marker.exists()


class Mark:
    """Leaves a mark where it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return Path.touch, (self.path,)


def test_nothing_is_unpickled(tmp_path: Path):
    marker = tmp_path / "was-run"
    (tmp_path / "pytorch_model.bin").write_bytes(pickle.dumps(Mark(marker)))
    with guarded("policy"), pytest.raises(InputError, match="a pickle, which may run code"):
        torch.load(tmp_path / "pytorch_model.bin", weights_only=False)
    assert not marker.exists()
    torch.save({"a": torch.zeros(2)}, tmp_path / "a.pt")
    assert torch.load(tmp_path / "a.pt", weights_only=True)["a"].shape == (2,), (
        "the guard is gone with its block"
    )


def test_weights_from_pytorch_itself_are_read_as_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    torch.save({"a": torch.ones(2)}, tmp_path / "resnet.pth")
    marker = tmp_path / "was-run"
    (tmp_path / "other.pth").write_bytes(pickle.dumps(Mark(marker)))
    with guarded("policy"):
        assert torch.load(tmp_path / "resnet.pth", weights_only=False)["a"].sum() == 2
        with pytest.raises(pickle.UnpicklingError):
            torch.load(tmp_path / "other.pth", weights_only=False)
    assert not marker.exists()


def test_a_model_with_pickled_weights_only_does_not_load(theirs: Repository, tmp_path: Path):
    """As transformers finds them: no safetensors, so it would take the pickle."""
    from transformers import AutoModel, BertConfig

    sizes = {"hidden_size": 8, "num_hidden_layers": 1, "num_attention_heads": 1, "intermediate_size": 8}
    BertConfig(vocab_size=8, **sizes).save_pretrained(tmp_path / "bert")
    marker = tmp_path / "was-run"
    (tmp_path / "bert" / "pytorch_model.bin").write_bytes(pickle.dumps(Mark(marker)))
    with guarded("policy"), pytest.raises(InputError, match="a pickle, which may run code"):
        AutoModel.from_pretrained(tmp_path / "bert")
    assert not marker.exists()


def test_large_parameters_are_not_filled_and_all_else_is():
    with Unfilled():
        large, small = nn.Linear(1000, 1000), nn.Linear(10, 10)
        mask = torch.empty(1000, 1000).fill_(-1).triu_(1)
    assert not large.weight.any() and small.weight.any() and large.bias.any()
    assert mask[0, 1] == -1 and mask.sum() == -1000 * 999 / 2


def test_an_error_inside_others_is_found():
    refused = InputError("a", 1, "b")
    for outer in (RuntimeError("x"), ValueError("y")):
        outer.__cause__ = refused
        refused = refused
        assert input_error(outer) is refused
    assert input_error(RuntimeError("x")) is None
