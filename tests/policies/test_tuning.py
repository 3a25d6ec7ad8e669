# SPDX-License-Identifier: Apache-2.0
"""Trained parameters: LeRobot's choice, everything, the expert, or low-rank adapters that are saved
merged."""

from __future__ import annotations

import pickle
import threading
from pathlib import Path

import numpy as np
import pytest
import torch

from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.base import stack_observations
from accerl_lerobot.policies.config import PolicyConfig, TuningConfig
from accerl_lerobot.policies.loading import load_adapter, save_pretrained
from accerl_lerobot.weights.shared_memory import Received, SharedMemoryPublisher, SharedMemoryReader
from tests.conftest import write_smolvla
from tests.policies.tiny import adapter_at, check_ratio_one, perturb, requests, stored
from tests.rounding import assert_close


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("smolvla") / "pretrained_model"
    return write_smolvla(directory, chunk=5, executed=3, padded_dim=4, action_dim=2, num_steps=3)


def tuned(path: Path, **options: object) -> LeRobotAdapter:
    return adapter_at(path, tuning=TuningConfig(**options))


def policy_names(adapter: LeRobotAdapter) -> set[str]:
    return {k.removeprefix("policy.") for k in adapter.trainable() if k.startswith("policy.")}


def test_full_expert_and_checkpoint(path: Path):
    everything = {k for k, _ in adapter_at(path).policy.named_parameters()}
    frozen_by_lerobot = everything - policy_names(tuned(path))
    assert frozen_by_lerobot, "LeRobot freezes some of SmolVLA even with train_expert_only=false"
    assert policy_names(tuned(path, mode="full")) == everything
    expert = policy_names(tuned(path, mode="expert"))
    assert expert == {k for k in everything if not k.startswith("model.vlm_with_expert.vlm.")}
    assert any("lm_expert" in k for k in expert) and "model.action_out_proj.weight" in expert


def test_low_rank_adapters_start_as_the_policy_itself(path: Path):
    plain, adapter, asked = adapter_at(path), tuned(path, mode="lora", rank=2), requests(5)
    names = policy_names(adapter)
    assert names and all(".lora_" in k for k in names)
    for one, other in zip(adapter.decide(asked, 0), plain.decide(asked, 0), strict=True):
        assert np.array_equal(one.chunk, other.chunk)
    sizes = [sum(a.size for k, a in x.export_trainable().items() if k[0] == "p") for x in (adapter, plain)]
    assert sizes[0] < 0.2 * sizes[1], "only what is trained is published"


def test_they_have_gradients_and_ratio_one(path: Path):
    adapter, asked = tuned(path, mode="lora", rank=2), requests(12)
    perturb(adapter, 0.3)
    decisions = adapter.decide(asked, 0)
    check_ratio_one(adapter, asked, decisions)
    latent, _ = stored(decisions)
    adapter.evaluate(*stack_observations(asked), latent).log_prob.sum().backward()
    silent = [k for k, p in adapter.trainable().items() if k[0] == "p" and not p.grad.abs().max() > 0]
    assert silent == []
    still = [k for k, p in adapter.policy.named_parameters() if ".lora_" not in k and p.grad is not None]
    assert still == []


def test_they_are_saved_merged_and_stock_lerobot_acts_alike(path: Path, tmp_path: Path):
    from lerobot.policies.smolvla.modeling_smolvla import SmolVLAPolicy

    config = PolicyConfig(path=str(path), device="cpu", tuning=TuningConfig(mode="lora", rank=2, alpha=6))
    adapter, asked = load_adapter(config), requests(5, explore=False)
    with torch.no_grad():
        for name, parameter in adapter.trainable().items():
            if ".lora_B" in name:
                parameter.normal_(0, 0.3, generator=torch.Generator().manual_seed(len(name)))
    save_pretrained(adapter, tmp_path / "saved", config)
    stock, plain = SmolVLAPolicy.from_pretrained(tmp_path / "saved"), SmolVLAPolicy.from_pretrained(path)
    assert stock.state_dict().keys() == plain.state_dict().keys()
    changed = {k for k, v in stock.state_dict().items() if not torch.equal(v, plain.state_dict()[k])}
    assert changed == {f"{n}.weight" for n, m in adapter.policy.named_modules() if hasattr(m, "lora_A")}
    again = adapter_at(tmp_path / "saved")
    ours = np.stack([d.chunk for d in adapter.decide(asked, 0)])
    assert_close(np.stack([d.chunk for d in again.decide(asked, 0)]), ours)
    before = np.stack([d.chunk for d in adapter_at(path).decide(asked, 0)])
    assert np.abs(before - ours).max() > 1e-2, "the adapters must matter"


def test_the_merged_weight_by_hand(path: Path, tmp_path: Path):
    from safetensors.torch import load_file

    config = PolicyConfig(
        path=str(path),
        device="cpu",
        tuning=TuningConfig(mode="lora", rank=2, alpha=6, targets=r"model\.action_out_proj"),
    )
    adapter = load_adapter(config)
    layer = adapter.policy.model.action_out_proj
    with torch.no_grad():
        layer.lora_B["default"].weight.normal_()
    save_pretrained(adapter, tmp_path / "saved", config)
    product = layer.lora_B["default"].weight @ layer.lora_A["default"].weight
    expected = layer.base_layer.weight + 6 / 2 * product
    stored_weight = load_file(tmp_path / "saved" / "model.safetensors")["model.action_out_proj.weight"]
    assert_close(stored_weight, expected)


def test_targets_that_match_nothing(path: Path):
    said = r"^policy\.tuning\.targets='model.nothing': matches none of the policy's \d+ linear layers"
    with pytest.raises(InputError, match=said):
        tuned(path, mode="lora", targets="model.nothing")


def test_targets_that_are_no_regular_expression_are_refused_before_anything_is_loaded():
    with pytest.raises(InputError, match=r"^policy\.tuning\.targets='\(': not a regular expression"):
        TuningConfig(targets="(")


@pytest.mark.parametrize(("name", "value"), [("mode", "qlora"), ("rank", 0), ("alpha", 0)])
def test_bad_options_name_their_field(name: str, value: object):
    with pytest.raises(InputError, match=rf"^policy\.tuning\.{name}={value!r}: use"):
        TuningConfig(**{name: value})


def test_only_what_is_trained_travels_and_is_copied_once(path: Path):
    trainer, reader, asked = tuned(path, mode="lora", rank=2), tuned(path, mode="lora", rank=2), requests(4)
    views, parameters = trainer.view_trainable(), trainer.trainable()
    trained = {f"policy.{k}" for k, p in trainer.policy.named_parameters() if p.requires_grad}
    assert {k for k in views if k.startswith("policy.")} == trained and len(trained) < 0.5 * sum(
        1 for _ in trainer.policy.parameters()
    )
    assert all(views[k].ctypes.data == p.data_ptr() for k, p in parameters.items()), "their own memory"
    publisher, arrived = SharedMemoryPublisher(1), threading.Event()

    def apply(received: Received) -> None:
        assert received.tensors.keys() == parameters.keys()
        assert received.nbytes < 64 * len(views) + sum(p.numel() * 4 for p in parameters.values())
        reader.load_trainable(received.tensors)
        arrived.set()
        received.release()

    SharedMemoryReader(publisher.address, apply, lambda error: None)
    perturb(trainer, 0.3)
    publisher.publish(1, trainer.view_trainable())
    publisher.flush(60)
    publisher.close()
    assert arrived.is_set()
    assert pickle.dumps(reader.decide(asked, 0)) == pickle.dumps(trainer.decide(asked, 0))
