# SPDX-License-Identifier: Apache-2.0
"""The policy that low-rank adapters were put into, computed back from what they have become.

A checkpoint holds the policy with its adapters added in, W + s·BA, and A and B apart, exactly as they are.
Where W itself is not at hand any more, it is the difference of the two, as exact as the sum was rounded.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import PRETRAINED, TRAINING_STATE, WEIGHTS, relocate
from accerl_lerobot.policies.config import PolicyConfig


def compute_back(config: PolicyConfig, checkpoint: Path, directory: Path) -> None:
    """Writes the policy that a run with low-rank adapters began from.

    Args:
        config: the run's; its ``path`` does not matter.
        checkpoint: one of the run's, with its ``training_state``.
        directory: for a LeRobot ``pretrained_model``; appears when it is whole.

    Raises:
        InputError: the checkpoint is none of such a run.
    """
    import torch

    from accerl_lerobot.policies.loading import load_adapter, save_pretrained
    from accerl_lerobot.policies.tuning import subtract_adapters

    adapter = load_adapter(replace(config, path=str(checkpoint / PRETRAINED), revision=None, device="cpu"))
    adapter.load_trainable(snapshot.load(checkpoint / TRAINING_STATE / WEIGHTS))
    with torch.no_grad():
        subtract_adapters(adapter.policy)
    new = directory.with_name(f".{directory.name}.new")
    shutil.rmtree(new, ignore_errors=True)
    save_pretrained(adapter, new, config)
    relocate(new, directory)
    new.rename(directory)
