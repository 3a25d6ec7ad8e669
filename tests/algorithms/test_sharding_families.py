# SPDX-License-Identifier: Apache-2.0
"""Every LeRobot policy type that has a likelihood, in parts: two ranks with zero3 learn what one learns.

Small, offline, on LeRobot's own classes, see `tests.policies.cases`. One group of two processes for all, as
each imports LeRobot.
"""

import logging
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch

from accerl_lerobot.algorithms import GIPOConfig
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.algorithms.ratio_update import RatioUpdate
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.tensors import whole
from accerl_lerobot.policies.config import TuningConfig
from accerl_lerobot.testing import perturb
from tests.algorithms.sharded import join, leave
from tests.policies.cases import CASES as POLICIES
from tests.policies.tiny import adapter_at, as_segment
from tests.rounding import assert_close

DECISIONS = 5
LEARNING = TrainerConfig(
    updates=10, lr=1e-3, warmup_updates=0, value_warmup_updates=0, micro_batch=2, probe_every=0
)
SHARDED = {"ranks": 2, "sharding": "zero3"}


class Case(NamedTuple):
    kind: str
    config: dict[str, Any] = SHARDED
    options: dict[str, Any] = {}


CASES = {kind: Case(kind) for kind in POLICIES} | {
    "smolvla, zero2": Case("smolvla", {"ranks": 2, "sharding": "zero2"}),
    "smolvla, recomputed": Case("smolvla", SHARDED | {"activation_checkpointing": True}),
    "smolvla, lora": Case("smolvla", options={"tuning": TuningConfig(mode="lora", rank=2)}),
    "smolvla_bins": Case("smolvla_bins", options={"discover_packages_path": "lerobot_policy_smolvla_bins"}),
}


def learn(case: Case, folder: Path, config: TrainerConfig) -> dict[str, Any]:
    """Makes two updates on the segments there; all that is published and saved afterwards."""
    batch = snapshot.load(folder / case.kind / "segments")
    with POLICIES[case.kind].context():
        torch.manual_seed(0)
        adapter = adapter_at(folder / case.kind / "pretrained_model", **case.options)
        perturb(adapter, 0.02)
        assert adapter.blocks()
        update = RatioUpdate(adapter, GIPOConfig(level="chunk"), config)
        metrics = [update.step(batch)]
        gradients = {
            name: torch.zeros(p.shape) if p.grad is None else whole(p.grad).clone()
            for name, p in adapter.trainable().items()
        }
        metrics.append(update.step(batch))
        saved = adapter.copy_weights()["policy"] if case.kind == "smolvla" else {}
        return {
            "metrics": metrics,
            "gradients": gradients,
            "weights": adapter.export_trainable(),
            "saved": {f"policy.{name}": tensor.numpy() for name, tensor in saved.items()},
        }


def work(rank: int, size: int, place: Any, folder: Path) -> None:
    torch.set_num_threads(1)
    logging.disable()
    join(rank, size, place)
    for name, case in CASES.items():
        config = TrainerConfig(**LEARNING.__dict__ | case.config)
        snapshot.save(folder / f"{name}-{rank}", learn(case, folder, config))
    leave()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("families")
    for name, kind in POLICIES.items():
        with kind.context():
            (directory / name).mkdir()
            adapter = adapter_at(kind.write(directory / name / "pretrained_model"))
            made = as_segment(kind.requests(DECISIONS + 1), adapter, DECISIONS)
            made.reward = np.linspace(-1, 1, DECISIONS, dtype=np.float32)
            snapshot.save(directory / name / "segments", [made])
    place = torch.multiprocessing.get_context("spawn").SimpleQueue()
    torch.multiprocessing.spawn(work, (2, place, directory), nprocs=2)
    return directory


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_two_ranks_learn_what_one_learns(folder: Path, name: str):
    case = CASES[name]
    expected = learn(case, folder, LEARNING)
    gradients = expected["gradients"]
    largest = max(float(gradient.abs().max()) for gradient in gradients.values())
    found = [snapshot.load(folder / f"{name}-{rank}") for rank in range(2)]
    for key in ("loss", "value_loss", "grad_norm", "kl", "approx_kl"):
        for rank in range(2):
            for mine, theirs in zip(found[rank]["metrics"], expected["metrics"], strict=True):
                assert mine[key] == pytest.approx(theirs[key], rel=1e-3, abs=1e-5), key
    # The first rank has the whole tensors.
    for key, gradient in gradients.items():
        assert_close(found[0]["gradients"][key], gradient, largest=largest)
    for part in ("weights", "saved"):
        assert found[0][part].keys() == expected[part].keys()
        for key, tensor in expected[part].items():
            # AdamW makes a whole step of a gradient that is rounding, such as a key's bias has.
            # Above a hundredth of the largest one, rounding is at most a hundredth of the step.
            clear = np.abs(gradients[key].numpy()) > 1e-2 * largest if key in gradients else slice(None)
            off = np.abs(found[0][part][key][clear] - tensor[clear]).max(initial=0)
            assert off <= 0.02 * len(expected["metrics"]) * LEARNING.lr, f"{key} is off by {off:.2e}"
