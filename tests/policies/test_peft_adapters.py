# SPDX-License-Identifier: Apache-2.0
"""Adapters of LeRobot's PEFT training act as in LeRobot, which loads what is saved of them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.demos.sft import SFTConfig, sft_command
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import stack_observations
from accerl_lerobot.policies.config import PolicyConfig, TuningConfig
from accerl_lerobot.policies.loading import load_adapter, policy_sizes
from accerl_lerobot.policies.saving import save_pretrained
from accerl_lerobot.run.preflight import sft_policy
from tests.policies.checkpoints import edit_config, write_smolvla
from tests.policies.tiny import refused, requests


def stock_policy(folder: Path) -> Any:
    """The policy as LeRobot's factory loads it, adapters included."""
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.envs.configs import PushtEnv
    from lerobot.policies.factory import make_policy

    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path, config.device = folder, "cpu"
    return make_policy(config, env_cfg=PushtEnv(), rename_map={"a": "b"}).eval()


@pytest.fixture(scope="module")
def adapted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An adapter's folder as ``lerobot-train --peft.method_type=LORA`` writes it."""
    from lerobot.policies.factory import get_policy_class

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
    assert not (folder / "model.safetensors").exists()
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
    config = PolicyConfig(path=str(adapted), device="cpu")
    assert policy_sizes(config).policy > 0
    adapter = load_adapter(config)
    batch = adapter.processing.prepare(*stack_observations(requests(2)))
    expected = chunk(stock_policy(adapted), batch)
    base = json.loads((adapted / "adapter_config.json").read_text())["base_model_name_or_path"]
    assert not torch.allclose(chunk(stock_policy(Path(base)), batch), expected, atol=1e-3)
    assert torch.allclose(chunk(adapter.policy, batch), expected, atol=1e-5)
    assert any(name.startswith("policy.") for name in adapter.trainable())
    save_pretrained(adapter, tmp_path / "saved", config)
    assert torch.equal(chunk(stock_policy(tmp_path / "saved"), batch), chunk(adapter.policy, batch))
    assert not json.loads((tmp_path / "saved" / "config.json").read_text())["use_peft"]
    tuned = load_adapter(PolicyConfig(path=str(adapted), device="cpu", tuning=TuningConfig(mode="lora")))
    assert torch.allclose(chunk(tuned.policy, batch), expected, atol=1e-5)


def test_an_adapter_without_its_policy_is_refused(copied: Path, tmp_path: Path):
    file = copied / "adapter_config.json"
    stored = json.loads(file.read_text())
    file.write_text(json.dumps(stored | {"base_model_name_or_path": str(tmp_path / "gone")}))
    why = "gone', the policy that the adapter is for: .*no config.json"
    refused(copied, why)
    with pytest.raises(InputError, match=f"^sft.init_path=.*{why}"):
        sft_policy(SFTConfig(init_path=str(copied)))


def test_an_adapter_of_another_policy_is_refused(copied: Path):
    weights = load_file(copied / "adapter_model.safetensors")
    name = sorted(weights)[0]
    save_file({k: v for k, v in weights.items() if k != name}, copied / "adapter_model.safetensors")
    refused(copied, "1 tensors are missing or unexpected")
    save_file(weights | {name: torch.zeros(9, 9)}, copied / "adapter_model.safetensors")
    refused(copied, "its adapter did not load .*size mismatch")
    save_file(weights | {name: weights[name] * torch.inf}, copied / "adapter_model.safetensors")
    refused(copied, "NaN or infinity")
    (copied / "adapter_model.safetensors").unlink()
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
        command = sft_command(
            SFTConfig(init_path=str(folder)), DatasetConfig(repo_id="a/b"), tmp_path, 0, "cpu"
        )
        assert {flag for flag in command if "peft" in flag.partition("=")[0]} == flags
