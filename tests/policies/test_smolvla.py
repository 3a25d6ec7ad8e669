# SPDX-License-Identifier: Apache-2.0
"""Flow policies on SmolVLA, beside the contract: what is scored and stored, and steering by the noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from accerl_lerobot.policies.config import (
    FlowSamplerConfig,
)
from accerl_lerobot.testing import stored
from tests.policies.cases import CASES
from tests.policies.tiny import adapter_at, requests


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return CASES["smolvla"].write(tmp_path_factory.mktemp("smolvla") / "pretrained_model")


def test_the_executed_noise_has_the_configured_size(path: Path):
    # Under ``last`` and euler the executed action is the stock one plus N(0, 0.2²) in normalised units;
    # the checkpoint's action std is 0.5.
    adapter = adapter_at(path, FlowSamplerConfig(noise_level=0.2))
    noisy = np.stack([d.chunk for d in adapter.decide(requests(200), 0)])
    stock = np.stack([d.chunk for d in adapter.decide(requests(200, explore=False), 0)])
    added = (noisy - stock) / 0.5
    assert abs(added.mean()) < 0.02 and added.std() == pytest.approx(0.2, rel=0.06)


@pytest.mark.parametrize(("stochastic", "points", "factors"), [("last", 2, 3), ("all", 4, 5)])
def test_the_latent_is_as_small_as_re_scoring_allows(path: Path, stochastic: str, points: int, factors: int):
    adapter = adapter_at(path, FlowSamplerConfig(stochastic=stochastic))
    decision = adapter.decide(requests(1), 0)[0]
    assert decision.latent["path"].shape == (points, 5, 4)
    assert decision.log_prob.shape == (adapter.actions,) == (factors,), "each is one row"
    assert adapter.factors(stored([decision])[0]) is None, "all of them exist"


def test_published_weights_that_do_not_fit_change_nothing(path: Path):
    adapter = adapter_at(path)
    good = adapter.export_trainable()
    moved = {k: v + 1 for k, v in good.items()}
    first, *_, last = moved
    with pytest.raises(ValueError, match=f"published weights differ by name: .*{first}"):
        adapter.load_trainable({k: v for k, v in moved.items() if k != first})
    with pytest.raises(ValueError, match=rf"published {last} has shape \(7,\), not"):
        adapter.load_trainable(moved | {last: np.zeros(7, np.float32)})
    assert all(np.array_equal(a, good[k]) for k, a in adapter.export_trainable().items())
