# SPDX-License-Identifier: Apache-2.0
"""Untrusted checkpoints: hostile files, and code and pickles that come with a model."""

import json
import pickle
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from huggingface_hub import constants
from lerobot.processor import ProcessorStep, ProcessorStepRegistry
from torch import nn
from transformers import AutoConfig, dynamic_module_utils

from accerl_lerobot.checkpoint.layout import BACKBONE
from accerl_lerobot.checkpoint.safety import FileSource
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import ChunkNoiseConfig
from accerl_lerobot.policies.untrusted import Unfilled, check_checkpoint, guarded
from tests.hub_cache import cached_repo
from tests.policies.checkpoints import edit_config, write_smolvla
from tests.policies.tiny import refused

PRE = "policy_preprocessor.json"


@pytest.fixture
def copied(written: Callable[[str], Path], tmp_path: Path) -> Path:
    return Path(shutil.copytree(written("act"), tmp_path / "policy"))


def test_a_file_that_lerobot_has_not_saved_is_one_line(copied: Path):
    (copied / PRE).write_text('{"steps": [7]}')
    refused(copied, "^policy.path='.*': .*not a checkpoint that LeRobot has saved")


def edit_steps(path: Path, edit: Callable[[list[dict[str, Any]]], object]) -> None:
    content = json.loads((path / PRE).read_text())
    edit(content["steps"])
    (path / PRE).write_text(json.dumps(content))


@pytest.mark.parametrize("beside", [{}, {"registry_name": "device_processor"}])
def test_a_step_is_named_and_not_imported(copied: Path, tmp_path: Path, beside: dict[str, Any]):
    """LeRobot 0.6.1 imports the class of a processor step, and calls it."""
    marker = tmp_path / "was-run"
    step = {"class": "subprocess.Popen", "config": {"args": ["touch", str(marker)]}}
    edit_steps(copied, lambda steps: steps.insert(0, step | beside))
    refused(copied, "^policy.path=.*only steps with a registry_name are loaded")
    assert not marker.exists()


def test_a_state_file_lies_in_the_folder(copied: Path, tmp_path: Path):
    steps = json.loads((copied / PRE).read_text())["steps"]
    (index,) = (i for i, step in enumerate(steps) if "state_file" in step)
    shutil.copy(copied / steps[index]["state_file"], tmp_path / "outside.safetensors")
    for name in ("../outside.safetensors", str(tmp_path / "outside.safetensors")):
        edit_steps(copied, lambda steps, name=name: steps[index].update(state_file=name))
        refused(copied, "^policy.path=.*only files inside the folder are read")


@pytest.mark.parametrize("name", ["config.json", "model.safetensors", "*_normalizer_processor.safetensors"])
def test_links_out_of_the_folder(copied: Path, tmp_path: Path, name: str):
    (file,) = copied.glob(name)
    file.rename(tmp_path / "outside")
    file.symlink_to(tmp_path / "outside")
    refused(copied, f"^policy.path=.*{file.name}: a link that leads out")


def test_a_checkpoint_from_the_hub_names_no_folder_of_this_machine(copied: Path):
    origin = FileSource("policy.path", "theirs")
    edit_config(copied, vlm_model_name="google/paligemma")
    check_checkpoint(copied, origin, fetched=True)
    for name in ("../../secret", "/somewhere/secret"):
        edit_config(copied, vlm_model_name=name)
        check_checkpoint(copied, origin)
        with pytest.raises(InputError, match="^policy.path='theirs': config.json: vlm_model_name: "):
            check_checkpoint(copied, origin, fetched=True)


def test_pickled_weights_are_not_read(copied: Path):
    (copied / "model.safetensors").rename(copied / "pytorch_model.bin")
    refused(copied, "^policy.path=.*model.safetensors: is missing; give a folder with the weights")


def test_attention_is_not_fetched_as_compiled_code(copied: Path):
    (copied / BACKBONE).mkdir()
    content = '{"model_type": "smolvlm", "text_config": {"_attn_implementation": "them/kernels"}}'
    (copied / BACKBONE / "config.json").write_text(content)
    refused(copied, "^policy.path=.*_attn_implementation names code on the Hub")


def test_a_critic_of_another_size(copied: Path):
    shutil.copy(copied / "model.safetensors", copied / "value_head.safetensors")
    refused(copied, "^policy.path=.*value_head.safetensors: not of this policy; remove it to start anew")


REPOSITORY, COMMIT, NEWER = "them/model", "0" * 39 + "1", "0" * 39 + "2"
CODE = """
from pathlib import Path
from transformers import PretrainedConfig
Path({marker!r}).touch()
class TheirConfig(PretrainedConfig):
    model_type = "theirs"
    commit = {commit!r}
"""


@pytest.fixture
def marker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """There is a model in the Hub's cache whose code makes this file when it is run."""
    for commit in (COMMIT, NEWER):
        snapshot = cached_repo(tmp_path, REPOSITORY, commit)
        code = CODE.format(marker=str(tmp_path / "was-run"), commit=commit)
        (snapshot / "their_code.py").write_text(code)
        auto = {"AutoConfig": "their_code.TheirConfig", "AutoModel": "their_code.TheirModel"}
        (snapshot / "config.json").write_text(json.dumps({"model_type": "theirs", "auto_map": auto}))
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
    monkeypatch.setattr(dynamic_module_utils, "HF_MODULES_CACHE", str(tmp_path / "modules"))
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield tmp_path / "was-run"
    for name in [name for name in sys.modules if name.startswith("transformers_modules")]:
        del sys.modules[name]


def load(name: str, commit: str | None = None) -> Any:
    with guarded("policy", commit):
        return AutoConfig.from_pretrained(name, trust_remote_code=True)


def test_code_in_a_folder_is_refused_even_where_a_commit_is_named(marker: Path, tmp_path: Path):
    folder = cached_repo(tmp_path, REPOSITORY, COMMIT).rename(tmp_path / "downloaded")
    for commit in (None, COMMIT):
        with pytest.raises(InputError, match="^policy.trust_remote_code="):
            load(str(folder), commit)
    assert not marker.exists()


def test_code_on_the_hub_is_run_of_the_commit_that_is_named_and_of_no_other(marker: Path):
    with pytest.raises(InputError, match="^policy.trust_remote_code=.*their_code.py.*name its commit in"):
        load(REPOSITORY)
    with pytest.raises((OSError, InputError)):
        load(REPOSITORY, "f" * 40)
    assert not marker.exists()
    assert load(REPOSITORY, COMMIT).commit == COMMIT
    assert marker.exists()


def test_a_checkpoint_cannot_have_its_backbone_s_code_run(marker: Path, tmp_path: Path, monkeypatch: Any):
    monkeypatch.setattr("builtins.input", lambda *_: "y")
    path = write_smolvla(tmp_path / "policy")
    edit_config(path, vlm_model_name=REPOSITORY)
    refused(path, "^policy\\.")
    assert not marker.exists()


@dataclass
class Late(ProcessorStep):
    """A step that loads a model when it is called, as GR00T's loads its tokeniser."""

    name: str = ""

    def __call__(self, transition: Any) -> Any:
        AutoConfig.from_pretrained(self.name, trust_remote_code=True)
        return transition

    def transform_features(self, features: Any) -> Any:
        return features


@pytest.mark.parametrize("sampler", [None, ChunkNoiseConfig()])
def test_code_of_a_model_that_a_step_loads_is_refused(
    marker: Path, copied: Path, sampler: ChunkNoiseConfig | None, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(ProcessorStepRegistry._registry, "late", Late)
    edit_steps(copied, lambda steps: steps.append({"registry_name": "late", "config": {"name": REPOSITORY}}))
    refused(copied, "^policy.trust_remote_code=", sampler=sampler)
    assert not marker.exists()


def test_nothing_is_unpickled_and_weights_of_pytorch_s_are_read_as_data(tmp_path: Path, monkeypatch: Any):
    marker, hub = tmp_path / "was-run", tmp_path / "hub"
    hub.mkdir()
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(hub))
    command = f"cos\nsystem\n(Vtouch {marker}\ntR."  # a pickle that runs it
    for folder in (tmp_path, hub):
        (folder / "other.bin").write_text(command)
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
