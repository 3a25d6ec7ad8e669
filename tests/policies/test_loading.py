# SPDX-License-Identifier: Apache-2.0
"""Loading refuses what is not the checkpoint; what is saved needs nothing from where it was made."""

import json
import os
import pickle
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from pydoc import locate
from typing import Any

import pytest
import torch
from huggingface_hub import constants
from lerobot.policies.act.modeling_act import ACTPolicy
from safetensors.torch import load_file, save_file
from transformers import dynamic_module_utils

from accerl_lerobot.checkpoint.layout import BACKBONE, PRETRAINED, displaced, save_checkpoint
from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import FlowSamplerConfig, PolicyConfig
from accerl_lerobot.policies.deferred import OURS
from accerl_lerobot.policies.loading import (
    dry_run_config,
    load_lerobot_config,
    pinned,
    precision_on,
    resolve_device,
)
from accerl_lerobot.testing import perturb
from tests.hub_cache import cached_repo
from tests.policies.checkpoints import edit_config, write_smolvla
from tests.policies.tiny import adapter_at, refused, requests
from tests.policies.tiny_pi import ACTIONS, COMMIT, KINDS, PALIGEMMA, hub, write_pi

Tensors = dict[str, torch.Tensor]
PROCESSOR = "policy_preprocessor.json"


@pytest.fixture
def damaged(written: Callable[[str], Path], tmp_path: Path) -> Callable[[str], Path]:
    """A copy of a checkpoint of `cases`, to damage."""
    return lambda name: Path(shutil.copytree(written(name), tmp_path / f"copied-{name}"))


def saved(path: Path, directory: Path, **options: object) -> Path:
    adapter = adapter_at(path, **options)
    perturb(adapter, 0.1)
    adapter.save(directory)
    return directory


def decided(path: Path | str) -> bytes:
    return pickle.dumps(adapter_at(path).decide(requests(3), 0))


def edit_weights(path: Path, edit: Callable[[Tensors], object]) -> None:
    tensors = load_file(path / "model.safetensors")
    changed = edit(tensors)
    save_file(changed if isinstance(changed, dict) else tensors, path / "model.safetensors")


def test_a_path_to_nothing():
    refused("./nowhere", "^policy.path='./nowhere': no config.json there; give the folder named pretrained")
    refused("no/thing", "^policy.path='no/thing': not a directory here and not loadable from the Hub")
    with pytest.raises(InputError, match="^policy.path=None: give a LeRobot checkpoint directory or Hub id"):
        load_lerobot_config(PolicyConfig())


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ('{"type": "act", "no_such_field": 1}', "its config.json is not one of this LeRobot's policies"),
        ("[1, 2]", "config.json: a mapping is wanted, not list"),
        ("not json", "config.json: not good JSON"),
    ],
)
def test_a_config_of_something_else(damaged: Any, text: str, why: str):
    path = damaged("act")
    (path / "config.json").write_text(text)
    refused(path, f"^policy.path=.*{why}")


@pytest.mark.parametrize(
    ("name", "changes", "options", "sentence"),
    [
        ("smolvla", {"rtc_config": {"enabled": True}}, {}, "policy.rtc_config.enabled=True: real-time"),
        ("smolvla", {"adapt_to_pi_aloha": True}, {}, "policy.adapt_to_pi_aloha=True: "),
        ("pi0_fast", {"temperature": 0.7}, {}, "policy.temperature=0.7: LeRobot's sampler has to be greedy"),
        ("pi0_fast", {"n_action_steps": 3}, {}, "policy.n_action_steps=3: LeRobot decodes so many rows from"),
        ("pi0_fast", {}, {"num_steps": 3}, "policy.num_steps=3: LeRobot's config of a pi0_fast policy"),
        ("smolvla", {}, {"n_action_steps": 6}, "policy.n_action_steps=6: smolvla: at most 5 rows of"),
        ("diffusion", {}, {"n_action_steps": 8}, "policy.n_action_steps=8: diffusion: at most 7 rows of"),
        ("diffusion", {}, {"num_steps": 21}, "policy.num_steps=21: use at most 20, as many as it was"),
        ("act", {"temporal_ensemble_coeff": 0.1, "n_action_steps": 1}, {}, "policy.temporal_en.*to null"),
        ("act", {}, {"sampler": FlowSamplerConfig()}, "policy.sampler.type='flow': use gaussian or chunk_n"),
    ],
)  # fmt: skip
def test_options_of_another_density(damaged: Any, name: str, changes: dict, options: dict, sentence: str):
    path = damaged(name)
    edit_config(path, **changes)
    refused(path, f"^{sentence}", **options)


def test_devices(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    assert resolve_device("auto") == resolve_device("cpu") == torch.device("cpu")
    with pytest.raises(InputError, match="^policy.device='cuda': no CUDA"):
        resolve_device("cuda")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    assert resolve_device("auto") == torch.device("cuda")
    with pytest.raises(InputError, match="^policy.device='cuda:1': there are 1 such devices"):
        resolve_device("cuda:1")


@pytest.mark.parametrize(("here", "precision"), [(False, "fp32"), (True, "bf16")])
def test_auto_is_bf16_where_the_gpu_itself_computes_in_it(here: bool, precision: str, monkeypatch: Any):
    monkeypatch.setattr(
        torch.cuda, "is_bf16_supported", lambda including_emulation=True: here or including_emulation
    )
    assert precision_on(torch.device("cuda"), "auto") == precision


def test_a_smolvla_is_float32_and_its_backbone_s_weights_are_not_read(tmp_path: Path):
    """The published backbone's config asks for bfloat16, in which LeRobot builds the expert."""
    path = write_smolvla(tmp_path / "policy")
    text = tmp_path / "policy-backbone/config.json"
    backbone = json.loads(text.read_text())
    backbone["text_config"]["dtype"] = "bfloat16"
    text.write_text(json.dumps(backbone))
    edit_config(path, load_vlm_weights=True, compile_model=True)
    adapter = adapter_at(path)
    assert {parameter.dtype for parameter in adapter.policy.parameters()} == {torch.float32}
    assert adapter.policy.config.load_vlm_weights and not adapter.policy.config.compile_model


OUT = "model.action_out_proj.weight"


@pytest.mark.parametrize(
    ("name", "damage", "detail"),
    [
        # LeRobot prints it, and returns a random π0.
        ("pi0", lambda t: t.pop(OUT), rf"1 missing \['{OUT}'\]; config.json and"),
        ("pi0", lambda t: t.update(x=torch.zeros(2)), r"1 unexpected \['model.x'\]"),
        ("smolvla", lambda t: t.update({OUT: torch.zeros(3, 3)}), rf"1 of another shape \['{OUT}'\]"),
        ("smolvla", lambda t: t[OUT].view(-1)[0].fill_(torch.nan), f"{OUT} holds NaN or infinity"),
    ],
)
def test_weights_that_did_not_load_are_named(damaged: Any, name: str, damage: Any, detail: str):
    path = damaged(name)
    edit_weights(path, damage)
    refused(path, f"^policy.path=.*: .*{detail}")


@pytest.mark.parametrize("name", KINDS)
def test_pi0_s_output_layers_may_be_left_out_and_openpi_s_names_are_read(damaged: Any, name: str):
    both = "model.paligemma_with_expert."
    head = f"{both}paligemma.lm_head.weight"

    def as_openpi(tensors: Tensors) -> Tensors:
        # Without the leading ``model.``, the input embedding under the name of the output layer.
        tensors[head] = tensors.pop(f"{both}paligemma.model.language_model.embed_tokens.weight")
        return {k.removeprefix("model."): v for k, v in tensors.items()}

    path = damaged(name)
    expected = decided(path)
    edit_weights(path, lambda t: [t.pop(k) for k in (head, f"{both}gemma_expert.lm_head.weight")])
    assert decided(path) == expected
    edit_weights(path, as_openpi)
    assert decided(path) == expected
    edit_weights(path, lambda t: t.pop("action_in_proj.bias"))
    refused(path, r"^policy.path=.*1 missing \['model.action_in_proj.bias'\]")


def test_missing_processors(damaged: Any):
    path = damaged("act")
    (path / PROCESSOR).unlink()
    refused(path, "^policy.path=.*its LeRobot processors did not load; .*migrate_policy_normalization")
    assert locate("lerobot.processor.migrate_policy_normalization") is not None


def test_torchvision_s_weights_are_not_asked_for(damaged: Any, tmp_path: Path, monkeypatch: Any):
    monkeypatch.delattr("torchvision.models._api.load_state_dict_from_url")  # which asks the network
    path = damaged("act")
    edit_config(path, pretrained_backbone_weights="ResNet18_Weights.IMAGENET1K_V1")
    with pytest.raises(NameError):
        ACTPolicy.from_pretrained(path)
    ACTPolicy.from_pretrained(saved(path, tmp_path / "saved"))


def test_a_changed_lerobot_fails_at_load(written: Any, monkeypatch: pytest.MonkeyPatch):
    stock = ACTPolicy.predict_action_chunk
    monkeypatch.setattr(ACTPolicy, "predict_action_chunk", lambda self, batch: stock(self, batch) + 1)
    refused(written("act"), "^policy.type=.*does not fit LeRobot .*: it differs from LeRobot's sampler by")


def test_a_moved_checkpoint_needs_nothing_from_where_it_was_made(tmp_path: Path):
    origin = write_smolvla(tmp_path / "origin" / PRETRAINED)

    def write(directory: Path) -> int:
        saved(origin, directory / PRETRAINED)
        return 12

    final = save_checkpoint(tmp_path / "run", write)
    assert not displaced(final / PRETRAINED)
    expected = decided(final / PRETRAINED)
    shutil.rmtree(f"{origin}-backbone")
    refused(origin, rf"^policy.path=.*{PRETRAINED}-backbone, which is gone; put a copy into {BACKBONE}/")
    shutil.rmtree(tmp_path / "origin")
    moved = Path(shutil.move(final, tmp_path / "elsewhere")) / PRETRAINED
    assert decided(moved) == expected
    second = saved(moved, tmp_path / "second")
    shutil.rmtree(moved)
    assert len(adapter_at(second).decide(requests(1), 0)) == 1, "and so does a checkpoint of the moved one"


def test_a_checkpoint_on_the_hub_is_loaded_whole(written: Any, tmp_path: Path, monkeypatch: Any):
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    path = saved(written("smolvla"), cached_repo(tmp_path / "hub", "me/policy", "abc"))
    edit_config(path, vlm_model_name="/on/another/machine")
    assert decided("me/policy") == decided(path), "critic and backbone must come along"
    assert pinned(PolicyConfig(path="me/policy")).revision == "abc"
    refused("me/policy", "not loadable from the Hub", revision="v9")


def test_overridden_steps_are_used_and_saved(written: Any, tmp_path: Path):
    path = saved(written("pi0"), tmp_path / "saved", num_steps=2, n_action_steps=2)
    shape = adapter_at(path).family.shape
    assert (shape.num_steps, shape.executed, shape.chunk_size) == (2, 2, 5)


@pytest.mark.parametrize("renames", [{}, {"observation.images.front": "observation.images.camera1"}])
def test_inputs_of_the_base_policy_in_the_config_give_way_to_the_statistics(renames: dict, tmp_path: Path):
    """LeRobot keeps the base policy's: states of six numbers, three cameras."""
    camera = next(iter(renames.values()), "observation.images.camera1")
    stats = {next(iter(renames), camera): {"mean": torch.zeros(3, 1, 1), "std": torch.ones(3, 1, 1)}}
    path = write_smolvla(tmp_path / "policy", camera=camera, max_state_dim=8, stats=stats)
    inputs = json.loads((path / "config.json").read_text())["input_features"]
    inputs |= {f"observation.images.camera{i}": inputs[camera] for i in (2, 3)}
    inputs["observation.state"]["shape"] = [6]
    edit_config(path, input_features=inputs)
    steps = json.loads((path / PROCESSOR).read_text())
    steps["steps"][0]["config"]["rename_map"] = renames
    (path / PROCESSOR).write_text(json.dumps(steps))

    for folder in (path, saved(path, tmp_path / "saved")):
        features = load_lerobot_config(PolicyConfig(path=str(folder), device="cpu")).input_features
        assert {k: f.shape for k, f in features.items()} == {camera: (3, 32, 32), "observation.state": (4,)}
    stored = json.loads((tmp_path / "saved" / "config.json").read_text())["input_features"]
    assert stored.keys() == features.keys() and stored["observation.state"]["shape"] == [4]


REMOTE_CODE = """
import json
from pathlib import Path
from transformers import PreTrainedTokenizerFast
Path({marker!r}).touch()
class UniversalActionProcessor:
    @classmethod
    def register_for_auto_class(cls): pass
    @classmethod
    def from_pretrained(cls, name, **options):
        from huggingface_hub import snapshot_download
        folder = Path(name) if Path(name).is_dir() else Path(snapshot_download(name))
        made = cls()
        made.__dict__.update(json.loads((folder / "processor_config.json").read_text()))
        made.bpe_tokenizer = PreTrainedTokenizerFast.from_pretrained(folder)
        return made
"""
"""Code in a tokeniser's repository, such as the class that LeRobot means to run."""


def remote(cache: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Puts code into the Hub repository of FAST's tokeniser; it leaves a mark when it is run."""
    snapshot = cached_repo(cache, ACTIONS, COMMIT)
    marker = cache / "was-run"
    (snapshot / "processing_action_tokenizer.py").write_text(REMOTE_CODE.format(marker=str(marker)))
    monkeypatch.setattr(dynamic_module_utils, "HF_MODULES_CACHE", str(cache / "modules"))
    return marker


@pytest.mark.parametrize("name", ["pi0", "pi0_fast"])
def test_lerobot_s_checkpoint_needs_the_hub_and_ours_does_not(name: str, tmp_path: Path, monkeypatch: Any):
    original = write_pi(tmp_path / "original", name, num_steps=8, whole=False)
    refused(original, "^policy.path=.*its LeRobot processors did not load")
    with hub(tmp_path / "original-hub"):
        marker = remote(tmp_path / "original-hub", monkeypatch)
        adapter = adapter_at(original)
        perturb(adapter, 0.1)
        assert not marker.exists(), "code from the Hub was run"
    adapter.save(tmp_path / "ours")
    for folder in (original, tmp_path / "original-hub"):
        shutil.rmtree(folder)
    adapter_at(tmp_path / "ours").save(tmp_path / "second")
    shutil.rmtree(tmp_path / "ours")
    assert decided(tmp_path / "second") == pickle.dumps(adapter.decide(requests(3), 0))
    content = "".join((tmp_path / "second" / file).read_text() for file in ("config.json", PROCESSOR))
    assert str(tmp_path) not in content, "others find the tokenisers where the original's were"
    assert PALIGEMMA in content and (ACTIONS in content) == (name == "pi0_fast")
    assert not displaced(tmp_path / "second")


def rename_statistics(path: Path, which: str = "*normalizer", old: str = "") -> None:
    """Puts ``so100.`` in the place of the `old` beginning of the statistics' names, of one kind or both."""
    for file in path.glob(f"*_{which}_processor.safetensors"):
        state = load_file(file)
        save_file({re.sub(f"^{old}", "so100.", name): value for name, value in state.items()}, file)


@pytest.mark.parametrize(
    ("which", "why"),
    [
        ("*normalizer", "observation.state: no mean and std of it, .* has so100.action, so100.observation"),
        ("unnormalizer", "action: no mean and std of it, .*it has so100"),
    ],
)
def test_statistics_of_other_names_are_refused_unless_it_is_fine_tuned(damaged: Any, which: str, why: str):
    path = damaged("smolvla")
    rename_statistics(path, which)
    config = PolicyConfig(path=str(path), device="cpu")
    assert dry_run_config(config, fine_tuned=True).type == "smolvla"
    refused(path, f"^policy.path='.*{why}.*sft.init_path")
    with pytest.raises(InputError, match=why):
        dry_run_config(config)


@pytest.mark.parametrize(
    ("name", "value", "why"),
    [
        ("observation.state.std", torch.full((4,), torch.inf), "NaN or infinity"),
        ("observation.state.mean", torch.zeros(9), "it cannot act here"),
    ],
)
def test_statistics_that_do_not_fit_are_refused(damaged: Any, name: str, value: torch.Tensor, why: str):
    path = damaged("act")
    (file,) = path.glob("*_normalizer_processor.safetensors")
    save_file(load_file(file) | {name: value}, file)
    why = f"^policy.path='.*{why}"
    refused(path, why)
    with pytest.raises(InputError, match=why):
        dry_run_config(PolicyConfig(path=str(path), device="cpu"))


def test_pictures_that_were_never_normalised_are_accepted_with_a_warning(damaged: Any, caplog: Any):
    path = damaged("act")
    rename_statistics(path, old="observation.images")
    adapter_at(path)
    (warning,) = [record.getMessage() for record in caplog.records]
    assert "observation.images.front: no mean and std of it" in warning


CODE = """
import sys
from accerl_lerobot.policies.config import PolicyConfig, register_policies
from accerl_lerobot.policies.loading import load_adapter

load_adapter(PolicyConfig(path=sys.argv[1], device="cpu"))  # as trainer and inference begin
assert "lerobot.policies.groot.processor_groot" not in sys.modules
from lerobot.configs.policies import PreTrainedConfig
assert {"smolvla", "act", "groot"} <= set(PreTrainedConfig.get_known_choices())
register_policies("of another package")
assert "lerobot.policies.groot.processor_groot" in sys.modules
"""


@pytest.mark.slow
def test_one_policy_is_imported_without_the_others(tiny_checkpoint: Path):
    command = [sys.executable, "-c", CODE, str(tiny_checkpoint)]
    subprocess.run(command, check=True, timeout=300, env=os.environ | {OURS: "1"})
