# SPDX-License-Identifier: Apache-2.0
"""A policy whose statistics are missing, or do not fit what it reads, is refused before it acts."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from accerl_lerobot.errors import InputError
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.loading import dry_run_config, load_adapter
from tests.policies.checkpoints import write_act, write_smolvla

Tensors = dict[str, torch.Tensor]
CAMERA = "observation.images.front"


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("statistics")
    return {"act": write_act(folder / "act"), "smolvla": write_smolvla(folder / "smolvla")}


@pytest.fixture
def edited(written: dict[str, Path], tmp_path: Path) -> Callable[..., PolicyConfig]:
    """A copy of a checkpoint whose statistics of one kind, or both, are changed in place."""

    def edit(kind: str, change: Callable[[Tensors], Any], which: str = "normalizer") -> PolicyConfig:
        copy = Path(shutil.copytree(written[kind], tmp_path / "copy"))
        for file in copy.glob(f"*_{which}_processor.safetensors"):
            state = load_file(file)
            changed = change(state)
            save_file(state if changed is None else changed, file)
        return PolicyConfig(path=str(copy), device="cpu")

    return edit


def under(prefix: str) -> Callable[[Tensors], Tensors]:
    return lambda state: {prefix + name: value for name, value in state.items()}


def put(name: str, value: torch.Tensor) -> Callable[[Tensors], Tensors]:
    return lambda state: state | ({name: value} if name in state else {})


def without(part: str) -> Callable[[Tensors], Tensors]:
    return lambda state: {name: value for name, value in state.items() if part not in name}


@pytest.mark.parametrize(
    ("kind", "change", "which", "why"),
    [
        ("smolvla", under("so100.buffer."), "*normalizer",
         "no mean and std of observation.state, .* it has so100.buffer.action, so100.buffer.observation"),
        ("smolvla", under("so100.buffer."), "unnormalizer", "no mean and std of action, .*has so100.buffer"),
        ("act", without("observation.state.std"), "normalizer", "no mean and std of observation.state"),
        ("act", put("observation.state.std", torch.full((4,), torch.inf)), "normalizer", "NaN or infinity"),
        ("act", put("observation.state.mean", torch.zeros(9)), "normalizer", "it cannot act here"),
    ],
)  # fmt: skip
def test_statistics_that_do_not_fit_are_refused(edited: Any, kind: str, change: Any, which: str, why: str):
    config = edited(kind, change, which)
    for load in (load_adapter, dry_run_config):
        with pytest.raises(InputError, match=f"^policy.path='.*{why}") as caught:
            load(config)
        assert "\n" not in str(caught.value)


def test_a_policy_that_is_to_be_fine_tuned_gets_new_statistics(edited: Any):
    config = edited("smolvla", under("so100.buffer."), "*normalizer")
    assert dry_run_config(config, fine_tuned=True).type == "smolvla"
    with pytest.raises(InputError, match="sft.init_path"):
        dry_run_config(config)


def test_pictures_that_were_never_normalised_are_accepted_with_a_warning(edited: Any, caplog: Any):
    config = edited("act", without("observation.images"), "*normalizer")
    load_adapter(config)
    (warning,) = [record.getMessage() for record in caplog.records]
    assert f"no mean and std of {CAMERA}" in warning and "pictures go in as they are" in warning
