# SPDX-License-Identifier: Apache-2.0
"""Untrusted checkpoints: hostile files, and code and pickles that come with a model."""

import json
import pickle
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.processor import ProcessorStep, ProcessorStepRegistry
from torch import nn

from accerl_lerobot.checkpoint.layout import BACKBONE
from accerl_lerobot.checkpoint.safety import FileSource
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import ChunkNoiseConfig, PolicyConfig, SamplerConfig
from accerl_lerobot.policies.loading import load_adapter
from accerl_lerobot.policies.untrusted import Unfilled, check_checkpoint, guarded
from tests.hub_cache import cached_repo
from tests.policies.checkpoints import edit_config, write_act, write_smolvla
from tests.policies.tiny import refused

PRE = "policy_preprocessor.json"
ORIGIN = FileSource("policy.path", "theirs")


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = write_act(tmp_path_factory.mktemp("files") / "made")
    config = PolicyConfig(path=str(made), device="cpu")
    load_adapter(config).save(made.parent / "saved")
    return made.parent / "saved"


@pytest.fixture
def copied(good: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(good, tmp_path / "policy"))


def test_a_file_that_lerobot_has_not_saved_is_one_line(copied: Path):
    (copied / PRE).write_text('{"steps": [7]}')
    refused(copied, "^policy.path='.*': .*not a checkpoint that LeRobot has saved")


def edit_steps(path: Path, edit: Callable[[list[dict[str, Any]]], object]) -> None:
    content = json.loads((path / PRE).read_text())
    edit(content["steps"])
    (path / PRE).write_text(json.dumps(content))


def call(marker: Path) -> dict[str, Any]:
    """LeRobot 0.6.1's way to a processor step: it imports the class and calls it."""
    return {"class": "subprocess.Popen", "config": {"args": ["touch", str(marker)]}}


@pytest.mark.parametrize("beside", [{}, {"registry_name": "device_processor"}])
def test_a_step_is_named_and_not_imported(copied: Path, tmp_path: Path, beside: dict[str, Any]):
    marker = tmp_path / "was-run"
    edit_steps(copied, lambda steps: steps.insert(0, call(marker) | beside))
    refused(copied, "^policy.path=.*only steps with a registry_name are loaded")
    assert not marker.exists()


def test_a_state_file_lies_in_the_folder(copied: Path, tmp_path: Path):
    steps = json.loads((copied / PRE).read_text())["steps"]
    (index,) = (i for i, step in enumerate(steps) if "state_file" in step)
    shutil.copy(copied / steps[index]["state_file"], tmp_path / "outside.safetensors")
    for name in ("../outside.safetensors", str(tmp_path / "outside.safetensors")):
        edit_steps(copied, lambda steps, name=name: steps[index].update(state_file=name))
        refused(copied, "^policy.path=.*only files inside the folder are read")
    (copied / "link.safetensors").symlink_to(tmp_path / "outside.safetensors")
    edit_steps(copied, lambda steps: steps[index].update(state_file="link.safetensors"))
    refused(copied, "^policy.path=.*a link that leads out of the folder")


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
def test_links_out_of_the_folder(copied: Path, tmp_path: Path, name: str):
    (copied / name).rename(tmp_path / "outside")
    (copied / name).symlink_to(tmp_path / "outside")
    refused(copied, f"^policy.path=.*{name}: a link that leads out")


def test_a_checkpoint_from_the_hub_names_no_folder_of_this_machine(copied: Path):
    for name, refusal in (("../../secret", True), ("/somewhere/secret", True), ("google/paligemma", False)):
        edit_config(copied, vlm_model_name=name)
        check_checkpoint(copied, ORIGIN)
        context: Any = nullcontext()
        if refusal:
            context = pytest.raises(InputError, match="^policy.path='theirs': config.json: vlm_model_name: ")
        with context:
            check_checkpoint(copied, ORIGIN, fetched=True)


def test_pickled_weights_are_not_read(copied: Path):
    (copied / "model.safetensors").rename(copied / "pytorch_model.bin")
    refused(copied, "^policy.path=.*model.safetensors: is missing; give a folder with the weights")


def test_attention_is_not_fetched_as_compiled_code(copied: Path):
    key = "_attn_implementation"
    (copied / BACKBONE).mkdir()
    content = {"model_type": "smolvlm", "text_config": {key: "them/kernels"}}
    (copied / BACKBONE / "config.json").write_text(json.dumps(content))
    refused(copied, f"^policy.path=.*{key} names code on the Hub")


def test_a_critic_of_another_size(copied: Path):
    shutil.copy(copied / "model.safetensors", copied / "value_head.safetensors")
    refused(copied, "^policy.path=.*value_head.safetensors: not of this policy; remove it to start anew")


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
        self.cache, self.marker, self.name = cache, cache / "was-run", "them/model"
        for commit in (COMMIT, NEWER):
            snapshot = cached_repo(cache, self.name, commit)
            code = CODE.format(marker=str(self.marker), commit=commit)
            (snapshot / "their_code.py").write_text(code)
            auto = {"AutoConfig": "their_code.TheirConfig", "AutoModel": "their_code.TheirModel"}
            (snapshot / "config.json").write_text(json.dumps({"model_type": "theirs", "auto_map": auto}))


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


def test_code_in_a_folder_is_refused_even_where_a_commit_is_named(theirs: Repository, tmp_path: Path):
    folder = tmp_path / "downloaded"
    cached_repo(theirs.cache, theirs.name, COMMIT).rename(folder)
    for revision in (None, COMMIT):
        with guarded("policy", revision), pytest.raises(InputError, match="^policy.trust_remote_code="):
            load(str(folder), trust_remote_code=True)
    assert not theirs.marker.exists()


def test_code_on_the_hub_is_run_of_the_commit_that_is_named_and_of_no_other(theirs: Repository):
    with guarded("policy"), pytest.raises(InputError, match="^policy.trust_remote_code=.*their_code.py") as e:
        load(theirs.name, trust_remote_code=True)
    assert "name its commit in policy.trust_remote_code" in e.value.hint
    with guarded("policy", "f" * 40), pytest.raises((OSError, InputError)):
        load(theirs.name, trust_remote_code=True)
    assert not theirs.marker.exists()
    with guarded("policy", COMMIT):
        assert load(theirs.name, trust_remote_code=True).commit == COMMIT
    assert theirs.marker.exists()


def test_a_checkpoint_cannot_have_its_backbone_s_code_run(
    theirs: Repository, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("builtins.input", lambda *_: "y")
    path = write_smolvla(tmp_path / "policy")
    edit_config(path, vlm_model_name=theirs.name)
    with pytest.raises(InputError):
        load_adapter(PolicyConfig(path=str(path), device="cpu"))
    assert not theirs.marker.exists()


@dataclass
class Late(ProcessorStep):
    """A step that loads a model when it is called, as GR00T's loads its tokeniser."""

    name: str = ""

    def __call__(self, transition: Any) -> Any:
        load(self.name, trust_remote_code=True)
        return transition

    def transform_features(self, features: Any) -> Any:
        return features


@pytest.mark.parametrize("sampler", [None, ChunkNoiseConfig()])
def test_code_of_a_model_that_a_step_loads_when_it_is_called_is_refused(
    theirs: Repository, copied: Path, sampler: SamplerConfig | None, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(ProcessorStepRegistry._registry, "late", Late)
    edit_steps(copied, lambda steps: steps.append({"registry_name": "late", "config": {"name": theirs.name}}))
    with pytest.raises(InputError, match="^policy.trust_remote_code="):
        load_adapter(PolicyConfig(path=str(copied), device="cpu", sampler=sampler))
    assert not theirs.marker.exists()


class Mark:
    """Leaves a mark where it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return Path.touch, (self.path,)


def test_nothing_is_unpickled_and_weights_from_pytorch_itself_are_read_as_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    marker, hub = tmp_path / "was-run", tmp_path / "hub"
    hub.mkdir()
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(hub))
    for folder in (tmp_path, hub):
        (folder / "other.bin").write_bytes(pickle.dumps(Mark(marker)))
        torch.save({"a": torch.ones(2)}, folder / "good.pt")
    with guarded("policy"):
        with pytest.raises(InputError, match="a pickle, which may run code"):
            torch.load(tmp_path / "other.bin", weights_only=False)
        with pytest.raises(pickle.UnpicklingError):
            torch.load(hub / "other.bin", weights_only=False)
        assert torch.load(hub / "good.pt", weights_only=False)["a"].sum() == 2
    assert not marker.exists()
    assert torch.load(tmp_path / "good.pt", weights_only=True)["a"].sum() == 2, "the patch is undone"


def test_large_parameters_are_not_filled_and_all_else_is():
    with Unfilled():
        large, small = nn.Linear(1000, 1000), nn.Linear(10, 10)
        mask = torch.empty(1000, 1000).fill_(-1).triu_(1)
    assert not large.weight.any() and small.weight.any() and large.bias.any()
    assert mask[0, 1] == -1 and mask.sum() == -1000 * 999 / 2
