# SPDX-License-Identifier: Apache-2.0
"""The package ``lerobot_policy_smolvla_bins``: network, loss, and the way through LeRobot's own commands."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import lerobot_policy_smolvla_bins  # noqa: F401
import numpy as np
import pytest
import torch
from lerobot.policies.factory import get_policy_class, make_pre_post_processors

from accerl_lerobot.checkpoint.layout import PRETRAINED
from accerl_lerobot.config.ranges import DatasetConfig
from accerl_lerobot.demos.backbone import BackboneConfig
from accerl_lerobot.demos.sft import SFTConfig, run_sft, sft_command
from accerl_lerobot.policies.config import PLUGINS
from tests.policies.checkpoints import write_bins
from tests.policies.tiny import adapter_at, requests
from tests.rounding import assert_close

DATASET = Path(__file__).parents[2] / "datasets" / "metaworld_tiny"
CHUNK, DIMS, BINS = 3, 2, 8
SFT = SFTConfig(
    steps=60, batch_size=16, lr=5e-3, num_threads=1, extra_args=["--log_freq=10"],
    policy={
        "type": "smolvla_bins", "num_vlm_layers": 2, "chunk_size": 4, "n_action_steps": 3, "num_bins": 32,
        "resize_imgs_with_padding": [32, 32], "freeze_vision_encoder": False,
    },
    backbone=BackboneConfig(hidden=32, patch=8),
)  # fmt: skip


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("plugin") / PRETRAINED
    return write_bins(directory, chunk=CHUNK, executed=2, num_bins=BINS, action_range=(-1.0, 3.0))


@pytest.fixture
def policy(path: Path) -> Any:
    """By LeRobot alone."""
    return get_policy_class("smolvla_bins").from_pretrained(path)


def test_bins_by_hand(policy: Any):
    actions = torch.tensor([-1.0, -0.751, -0.749, 0.0, 0.999, 1.0, 7.0, -7.0])
    tokens = policy.encode_actions(actions)
    assert tokens.tolist() == [0, 0, 1, 4, 7, 7, 7, 0]
    assert policy.decode_tokens(tokens[1:6]).tolist() == [-0.875, -0.625, 0.125, 0.875, 0.875]
    every = torch.arange(BINS)
    assert torch.equal(policy.encode_actions(policy.decode_tokens(every)), every)


def test_the_chunk_is_the_tokens_bin_centres_in_the_environment_s_units(path: Path):
    adapter = adapter_at(path)
    decisions = adapter.decide(requests(8), 0)
    tokens = np.stack([d.latent["tokens"] for d in decisions]).reshape(8, 2, DIMS)
    assert_close(np.stack([d.chunk for d in decisions]), -1 + 4 * (tokens + 0.5) / BINS)
    short = adapter_at(path, n_action_steps=1).decide(requests(1), 0)[0]
    assert short.chunk.shape == (1, DIMS) and short.latent["tokens"].shape == (DIMS,)


def test_the_loss_by_hand(policy: Any, path: Path):
    draw = torch.Generator().manual_seed(0)
    raw = {  # a batch as LeRobot's loader makes it; the instructions have unequal lengths
        "observation.images.front": torch.rand(3, 3, 32, 32, generator=draw),
        "observation.state": torch.randn(3, 4, generator=draw),
        "task": ["Go", "Match the target", "Mirror the target slowly"],
        "action": 4 * torch.rand(3, CHUNK, DIMS, generator=draw) - 1,
        "action_is_pad": torch.tensor([[False] * CHUNK, [False, True, True], [False, False, True]]),
    }
    batch = make_pre_post_processors(policy.config, pretrained_path=str(path))[0](raw)
    assert_close(batch["action"], (raw["action"] + 1) / 2 - 1)  # [-1, 3] became [-1, 1]
    with torch.no_grad():
        logits = policy.model.logits(policy.hidden(batch)).view(3, CHUNK, DIMS, BINS).double().numpy()
    sums = np.zeros(3)
    for b, k, a in np.ndindex(3, CHUNK, DIMS):
        if not raw["action_is_pad"][b, k]:
            wanted = min(int((float(raw["action"][b, k, a]) + 1) / 4 * BINS), BINS - 1)
            row = logits[b, k, a]
            sums[b] += np.log(np.exp(row).sum()) - row[wanted]
    counts = DIMS * np.array([3, 1, 2])
    loss, info = policy.forward(batch)
    assert loss.item() == pytest.approx(sums.sum() / counts.sum(), rel=1e-4)
    assert info == {"loss": pytest.approx(loss.item())}
    each, _ = policy.forward(batch, reduction="none")
    assert_close(each, sums / counts)
    del batch["action_is_pad"]
    assert policy.forward(batch)[0].item() != pytest.approx(loss.item(), rel=1e-3)


def test_lerobot_is_told_where_the_type_is(path: Path, tmp_path: Path):
    flag = f"--policy.discover_packages_path={PLUGINS['smolvla_bins']}"
    for sft, there in ((SFT, True), (SFTConfig(init_path=str(path)), True), (SFTConfig(), False)):
        command = sft_command(sft, DatasetConfig(repo_id="a/b"), tmp_path / "sft", 0, "cpu")
        assert (flag in command) == there


@pytest.mark.slow
def test_lerobot_s_trainer_lowers_the_loss_and_lerobot_eval_runs_the_checkpoint(tmp_path: Path):
    losses: list[float] = []
    dataset = DatasetConfig(repo_id="accerl/metaworld_tiny", root=str(DATASET))
    path = run_sft(
        SFT, dataset, tmp_path / "sft", seed=0, texts=["Open a drawer"],
        on_step=lambda step, loss: losses.append(loss),
    )  # fmt: skip
    assert losses[-1] < losses[0] - 0.3 and losses[-1] < np.log(32) - 0.5  # log 32: knows nothing
    adapter = adapter_at(path)
    assert adapter.family.model.length == 12
    stats = json.loads((DATASET / "meta" / "stats.json").read_text())["action"]
    ends = torch.tensor([-1.0, 1.0])[:, None, None].expand(2, 1, 4)
    assert_close(adapter.processing.unnormalise(ends)[:, 0], [stats["min"], stats["max"]])
    command = [
        sys.executable, "-m", "lerobot.scripts.lerobot_eval", f"--policy.path={path}",
        f"--policy.discover_packages_path={PLUGINS['smolvla_bins']}", "--policy.device=cpu",
        "--env.discover_packages_path=accerl_lerobot.envs.lerobot_plugin", "--env.type=accerl",
        "--env.environment={type: metaworld, task: drawer-open-v3, image_size: 64, max_steps: 8}",
        "--eval.n_episodes=2", "--eval.batch_size=1", f"--output_dir={tmp_path / 'eval'}",
    ]  # fmt: skip
    done = subprocess.run(command, env=dict(os.environ), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    results = json.loads((tmp_path / "eval" / "eval_info.json").read_text())
    assert results["overall"]["n_episodes"] == 2
