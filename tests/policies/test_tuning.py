# SPDX-License-Identifier: Apache-2.0
"""Trained parameters: LeRobot's choice, everything, the expert, low-rank adapters, and LeRobot's adapters."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import PushtEnv
from lerobot.policies.factory import get_policy_class, make_policy
from safetensors.torch import load_file, save_file

from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.demos.sft import SFTConfig, sft_command
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import stack_observations
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.config import PolicyConfig, TuningConfig
from accerl_lerobot.policies.loading import policy_sizes
from accerl_lerobot.run.preflight import sft_policy
from accerl_lerobot.testing import check_ratio_one, log_ratio, perturb, stored
from tests.policies.cases import CASES
from tests.policies.checkpoints import edit_config, write_smolvla
from tests.policies.tiny import adapter_at, refused, requests
from tests.rounding import assert_close

BACKBONES = {
    "smolvla": "model.vlm_with_expert.vlm.",
    "pi0": "model.paligemma_with_expert.paligemma.",
    "pi05": "model.paligemma_with_expert.paligemma.",
    "smolvla_bins": "model.vlm.",
}
"""Types with an expert apart from a backbone, and the prefix of the latter's parameters."""
TARGETS = dict.fromkeys(BACKBONES) | {
    "pi0_fast": r".*language_model.*\.(q|v)_proj",
    "act": r"model\.(encoder|decoder|vae_encoder)\..*linear\d",
    "diffusion": r"diffusion\.unet\..*cond_encoder\.1",
}
"""Type → regular expression of layers for low-rank adapters; None: LeRobot's own choice."""


def tuned(path: Path, **options: object) -> LeRobotAdapter:
    torch.manual_seed(0)  # of the adapters
    return adapter_at(path, tuning=TuningConfig(**options))


def policy_names(adapter: LeRobotAdapter) -> set[str]:
    return {k.removeprefix("policy.") for k in adapter.trainable() if k.startswith("policy.")}


@pytest.mark.parametrize("name", TARGETS)
def test_low_rank_adapters_start_as_the_policy_and_are_saved_merged(written: Any, name: str, tmp_path: Path):
    path, asked = written(name), CASES[name].requests(8)
    adapter, plain = tuned(path, mode="lora", rank=2, targets=TARGETS[name]), adapter_at(path)
    names = policy_names(adapter)
    assert names and all(".lora_" in k for k in names)
    for one, other in zip(adapter.decide(asked, 0), plain.decide(asked, 0), strict=True):
        assert_close(one.chunk, other.chunk)
    perturb(adapter, 1.0)
    decisions = adapter.decide(asked, 0)
    check_ratio_one(adapter, asked, decisions)
    latent, _ = stored(decisions)
    adapter.evaluate(*stack_observations(asked), latent).log_prob.sum().backward()
    gradients = {k: p.grad for k, p in adapter.policy.named_parameters() if p.grad is not None}
    assert gradients.keys() == names and all(g.abs().max() > 0 for g in gradients.values())
    adapter.save(tmp_path / "saved")
    merged = adapter_at(tmp_path / "saved")
    assert merged.policy.state_dict().keys() == plain.policy.state_dict().keys()
    check_ratio_one(merged, asked, decisions)
    assert log_ratio(plain, asked, decisions).abs().max() > 1e-3, "the adapters must matter"
    after, before = merged.policy.state_dict(), plain.policy.state_dict()
    changed = {after[k].data_ptr() for k, v in before.items() if not torch.equal(after[k], v)}
    assert len(changed) == len(names) / 2


@pytest.mark.parametrize("name", CASES)
def test_full_and_expert(written: Any, name: str):
    path = written(name)
    plain = adapter_at(path)
    acting = {k for k, _ in plain.policy.named_parameters() if not k.startswith(tuple(plain.model.idle))}
    assert policy_names(tuned(path, mode="full")) == acting
    if name not in BACKBONES:
        with pytest.raises(InputError, match=f"^policy.tuning.mode='expert': {name} has no action expert"):
            tuned(path, mode="expert")
        return
    expert = policy_names(tuned(path, mode="expert"))
    assert expert == {k for k in acting if not k.startswith(BACKBONES[name])} != set()


@pytest.mark.parametrize(
    ("name", "targets", "sentence"),
    [
        ("smolvla", "model.nothing", r"='model.nothing': matches none of the policy's \d+ linear layers"),
        ("act", None, "=None: LeRobot names no default for act"),
        # Attention multiplies by its output layer's weight without calling the layer.
        ("act", r".*self_attn\.out_proj", ".*matches none of the policy's .* linear layers"),
    ],
)
def test_targets_that_do_not_suit_the_policy(written: Any, name: str, targets: str | None, sentence: str):
    with pytest.raises(InputError, match=rf"^policy\.tuning\.targets{sentence}"):
        tuned(written(name), mode="lora", targets=targets)


def stock_policy(folder: Path) -> Any:
    """The policy as LeRobot's factory loads it, adapters included."""
    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path, config.device = folder, "cpu"
    return make_policy(config, env_cfg=PushtEnv(), rename_map={"a": "b"}).eval()


@pytest.fixture(scope="module")
def adapted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An adapter's folder as ``lerobot-train --peft.method_type=LORA`` writes it."""
    base = write_smolvla(tmp_path_factory.mktemp("peft") / "base")
    policy = get_policy_class("smolvla").from_pretrained(base)
    policy.config.pretrained_path = base
    policy.config.load_vlm_weights = True  # LeRobot asks for it before it adapts a SmolVLA
    wrapped = policy.wrap_with_peft(peft_cli_overrides={"method_type": "LORA", "r": 4})
    policy.config.load_vlm_weights = False
    torch.manual_seed(0)
    for name, parameter in wrapped.named_parameters():
        if "lora_" in name:
            torch.nn.init.normal_(parameter, std=0.1)
    folder = base.parent / "adapter"
    wrapped.save_pretrained(folder)
    wrapped.config.save_pretrained(folder)
    for file in base.glob("policy_*"):
        shutil.copy(file, folder)
    return folder


@pytest.fixture
def copied(adapted: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(adapted, tmp_path / "adapter"))


@torch.no_grad()
def chunk(policy: Any, batch: dict[str, torch.Tensor]) -> torch.Tensor:
    torch.manual_seed(0)
    policy.reset()
    return policy.predict_action_chunk(dict(batch))


def test_an_adapter_acts_as_in_lerobot_and_what_is_saved_of_it_does_too(adapted: Path, tmp_path: Path):
    assert policy_sizes(PolicyConfig(path=str(adapted), device="cpu")).policy > 0
    adapter = adapter_at(adapted)
    batch = adapter.processing.prepare(*stack_observations(requests(2)))
    expected = chunk(stock_policy(adapted), batch)
    base = json.loads((adapted / "adapter_config.json").read_text())["base_model_name_or_path"]
    assert not torch.allclose(chunk(stock_policy(Path(base)), batch), expected, atol=1e-3)
    assert torch.allclose(chunk(adapter.policy, batch), expected, atol=1e-5)
    assert policy_names(adapter)
    adapter.save(tmp_path / "saved")
    assert torch.equal(chunk(stock_policy(tmp_path / "saved"), batch), chunk(adapter.policy, batch))
    assert torch.allclose(chunk(tuned(adapted, mode="lora").policy, batch), expected, atol=1e-5)


def test_an_adapter_without_its_policy_is_refused(copied: Path):
    file = copied / "adapter_config.json"
    stored = json.loads(file.read_text())
    file.write_text(json.dumps(stored | {"base_model_name_or_path": "./gone"}))
    why = "gone', the policy that the adapter is for: .*no config.json"
    refused(copied, why)
    with pytest.raises(InputError, match=f"^sft.init_path=.*{why}"):
        sft_policy(SFTConfig(init_path=str(copied)))


def test_an_adapter_of_another_policy_is_refused(copied: Path):
    file = copied / "adapter_model.safetensors"
    weights = load_file(file)
    name = min(weights)
    for changed, why in (
        ({k: v for k, v in weights.items() if k != name}, "its tensors are not those of adapter_config.json"),
        (weights | {name: torch.zeros(9, 9)}, "its adapter did not load .*size mismatch"),
        (weights | {name: weights[name] * torch.inf}, "NaN or infinity"),
    ):
        save_file(changed, file)
        refused(copied, why)
    file.unlink()
    refused(copied, "adapter_model.safetensors: is missing")


def test_it_is_fine_tuned_as_an_adapter(adapted: Path, tmp_path: Path):
    """Without ``--peft`` LeRobot loads one and saves it without its ``config.json``."""
    merged = write_smolvla(tmp_path / "merged")
    edit_config(merged, use_peft=True)
    for folder, flags in (
        (adapted, {"--policy.use_peft=true", "--peft.method_type=LORA"}),
        (merged, {"--policy.use_peft=false"}),
        (write_smolvla(tmp_path / "whole"), set()),
    ):
        sft = SFTConfig(init_path=str(folder))
        command = sft_command(sft, DatasetConfig(repo_id="a/b"), tmp_path, 0, "cpu")
        assert {flag for flag in command if "peft" in flag.partition("=")[0]} == flags
