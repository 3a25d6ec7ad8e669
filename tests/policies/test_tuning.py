# SPDX-License-Identifier: Apache-2.0
"""Trained parameters: LeRobot's choice, everything, the expert, or low-rank adapters, saved merged."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import stack_observations
from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.config import PolicyConfig, TuningConfig
from accerl_lerobot.policies.saving import save_pretrained
from accerl_lerobot.testing import check_ratio_one, log_ratio, perturb, stored
from tests.policies.cases import CASES
from tests.policies.tiny import adapter_at
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


@pytest.fixture
def path(written) -> Path:
    return written("smolvla")


def tuned(path: Path, **options: object) -> LeRobotAdapter:
    torch.manual_seed(0)  # of the adapters
    return adapter_at(path, tuning=TuningConfig(**options))


def policy_names(adapter: LeRobotAdapter) -> set[str]:
    return {k.removeprefix("policy.") for k in adapter.trainable() if k.startswith("policy.")}


@pytest.mark.parametrize("name", TARGETS)
def test_low_rank_adapters_start_as_the_policy_itself_and_are_saved_merged(
    written, name: str, tmp_path: Path
):
    path, asked = written(name), CASES[name].requests(8)
    tuning = TuningConfig(mode="lora", rank=2, targets=TARGETS[name])
    torch.manual_seed(0)
    adapter, plain = adapter_at(path, tuning=tuning), adapter_at(path)
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
    save_pretrained(adapter, tmp_path / "saved", PolicyConfig(path=str(path), device="cpu", tuning=tuning))
    merged = adapter_at(tmp_path / "saved")
    assert merged.policy.state_dict().keys() == plain.policy.state_dict().keys()
    check_ratio_one(merged, asked, decisions)
    assert log_ratio(plain, asked, decisions).abs().max() > 1e-3, "the adapters must matter"
    after, before = merged.policy.state_dict(), plain.policy.state_dict()
    changed = {after[k].data_ptr() for k, v in before.items() if not torch.equal(after[k], v)}
    assert len(changed) == len(names) / 2


@pytest.mark.parametrize("name", CASES)
def test_full_and_expert(written: Callable[[str], Path], name: str):
    path = written(name)
    everything = {k for k, _ in adapter_at(path).policy.named_parameters()}
    idle = tuple(adapter_at(path).model.idle)
    acting = {k for k in everything if not k.startswith(idle)} if idle else everything
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
def test_targets_that_do_not_suit_the_policy(
    written: Callable[[str], Path], name: str, targets: str | None, sentence: str
):
    with pytest.raises(InputError, match=rf"^policy\.tuning\.targets{sentence}"):
        tuned(written(name), mode="lora", targets=targets)
