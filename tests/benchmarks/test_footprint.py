# SPDX-License-Identifier: Apache-2.0
"""Memory of a policy: counted by hand, with real and with fake tensors."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from accerl_lerobot.policies.adapter import LeRobotAdapter
from accerl_lerobot.policies.config import PolicyConfig, TuningConfig
from accerl_lerobot.policies.loading import load_adapter
from benchmarks import footprint
from benchmarks.footprint import Counter, policy_memory
from tests.policies.tiny_pi import small, write_pi


def test_tensors_are_counted_while_they_live():
    x = torch.ones(100, 10)
    with Counter() as counter:
        y = x @ torch.ones(10, 20)
        assert (counter.now, counter.peak) == (8000, 8800)  # the (10, 20) matrix is gone
        y.view(-1)[3:].add_(1)  # views and what is done in place take nothing
        x.mul_(2)
        assert counter.now == 8000
        z = y.relu()
        assert (counter.now, counter.peak) == (16_000, 16_000)
        del y
        assert (counter.now, counter.peak) == (8000, 16_000)
    del z
    assert counter.now == 0


def test_what_waits_for_the_gradient_is_what_autograd_keeps():
    weight = torch.ones(10, 20, requires_grad=True)
    x = torch.ones(100, 10)
    with Counter() as counter:
        kept = (x @ weight).sigmoid().sum()  # sigmoid keeps its result, 8,000 bytes; the sum has 4
    assert counter.now == 8004
    del kept


def pi0(folder: Path, **tuning: str) -> LeRobotAdapter:
    path = folder if folder.exists() else write_pi(folder, "pi0")
    return load_adapter(PolicyConfig(path=str(path), device="cpu", tuning=TuningConfig(**tuning)))


@pytest.mark.parametrize("imitates", [False, True])
def test_fake_tensors_take_what_real_ones_take(
    tmp_path: Path, imitates: bool, monkeypatch: pytest.MonkeyPatch
):
    with small():
        real = policy_memory(pi0(tmp_path / "pi0"), imitates=imitates)
        monkeypatch.setattr(footprint, "FAKED_FROM", 0)
        fake = policy_memory(pi0(tmp_path / "pi0"), imitates=imitates)
    assert fake[:2] == real[:2]
    assert fake.learning_batch == pytest.approx(real.learning_batch, rel=0.05, abs=1000)
    assert fake.acting == pytest.approx(real.acting, rel=0.05)
    assert fake.learning == pytest.approx(real.learning, rel=0.02)


def test_less_is_kept_by_imitation_by_few_trained_weights_and_by_blocks_that_forget(tmp_path: Path):
    with small():
        full, expert = (pi0(tmp_path / "pi0", mode=mode) for mode in ("full", "expert"))
        whole = policy_memory(full, imitates=False)
        assert policy_memory(full, imitates=True).learning < whole.learning
        found = policy_memory(expert, imitates=False)
        assert found.trained < whole.trained < whole.weights  # some, such as embeddings, no action depends on
        assert found.weights == whole.weights and found.learning < whole.learning
        forgetting = policy_memory(pi0(tmp_path / "pi0", mode="full"), imitates=False, checkpointing=True)
        assert forgetting.learning < whole.learning
