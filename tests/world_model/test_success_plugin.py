# SPDX-License-Identifier: Apache-2.0
"""The success model: what it learns, and that stock LeRobot trains, saves and loads it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.metrics import auroc
from accerl_lerobot.world_model.success_plugin import SuccessPairsConfig
from accerl_lerobot.world_model.success_plugin.modeling_success_pairs import SuccessPairsRewardModel
from tests.rounding import assert_close

ROOT = Path(__file__).parents[2]
SMALL = {"channels": (8, 16), "device": "cpu"}


def a_model(**options: object) -> SuccessPairsRewardModel:
    torch.manual_seed(0)
    return SuccessPairsRewardModel(SuccessPairsConfig(**(SMALL | options)))  # type: ignore[arg-type]


def pairs(
    count: int, *, cameras: int = 1, share: float = 0.3, seed: int = 0
) -> tuple[Tensor, Tensor, Tensor]:
    """A lamp that is lit in the second frame, or not, somewhere right; a light that changes at the left."""
    g = torch.Generator().manual_seed(seed)
    frames = 0.4 + 0.05 * torch.randn(count, 2, cameras, 3, 16, 16, generator=g)
    frames[..., :5] += torch.rand(count, 2, 1, 1, 1, 1, generator=g) - 0.5
    success = (torch.rand(count, generator=g) < share).float()
    for i in range(count):
        y = int(torch.randint(2, 11, (), generator=g))
        frames[i, 1, :, :, y : y + 3, 10:13] += 0.5 * success[i]
    return *frames.clamp(0, 1).unbind(1), success


def test_it_learns_which_pairs_are_successes():
    model = a_model().train()
    optimizer = torch.optim.AdamW(model.parameters(), lr=3e-3)
    torch.manual_seed(1)
    for step in range(120):
        loss, _ = model.loss(*pairs(32, share=0.15, seed=step))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    model.eval()
    before, after, success = pairs(400, seed=999)
    scores = model.compute_reward({"observation.images.top": torch.stack([before, after], 2)[:, 0]})
    assert auroc(scores.numpy(), success.numpy() > 0.5) > 0.98
    # Successes are rare in training and weigh as much as failures: 0.5 is no threshold of the rare.
    assert float((scores[success > 0.5] > 0.5).float().mean()) > 0.85


def test_successes_and_failures_weigh_the_same():
    model = a_model().eval()
    before, after, success = pairs(40, share=0.1)
    said, _ = model.logits(before, after)
    probability = torch.sigmoid(said).double()
    good, bad = success > 0.5, success <= 0.5
    by_hand = -(probability[good].log().mean() + (1 - probability[bad]).log().mean()) / 2
    assert 0 < int(good.sum()) < 10
    assert float(model.loss(before, after, success)[0]) == pytest.approx(float(by_hand), rel=1e-4)
    alone = float(model.loss(before[bad], after[bad], success[bad])[0])
    assert alone == pytest.approx(float(-(1 - probability[bad]).log().mean()), rel=1e-4)


def test_progress_is_learned_where_it_is_known():
    model = a_model().eval()
    before, after, success = pairs(6)
    _, along = model.logits(before, after)
    progress = torch.tensor([0.5, torch.nan, 1.0, torch.nan, 0.0, 0.25])
    loss, metrics = model.loss(before, after, success, progress)
    known = ~progress.isnan()
    error = (torch.sigmoid(along)[known] - progress[known]).square().mean()
    assert metrics["progress"] == pytest.approx(float(error), rel=1e-4)
    assert float(loss) == pytest.approx(float(model.loss(before, after, success)[0]) + float(error), rel=1e-4)
    unknown = torch.full((6,), torch.nan)
    assert "progress" not in model.loss(before, after, success, unknown)[1]


def test_cameras_are_averaged_and_single_frames_are_pairs():
    model = a_model().eval()
    before, after, _ = pairs(3, cameras=2)
    both = torch.stack([before, after], 1)
    batch = {f"observation.images.{name}": both[:, :, v] for v, name in enumerate("ab")}
    got = model.compute_reward(batch)
    assert_close(got, torch.sigmoid(model.logits(before, after)[0]))
    as_bytes = {k: (255 * v).round().to(torch.uint8) for k, v in batch.items()}
    assert torch.allclose(model.compute_reward(as_bytes), got, atol=0.02)
    still = model.compute_reward({k: v[:, 0] for k, v in batch.items()})
    assert_close(still, torch.sigmoid(model.logits(before, before)[0]))


def test_only_training_shakes_the_frames():
    model = a_model().train()
    before, after, success = pairs(8)
    losses = {float(model.loss(before, after, success)[0]) for _ in range(5)}
    assert len(losses) == 5
    model.eval()
    assert len({float(model.loss(before, after, success)[0]) for _ in range(5)}) == 1
    shaken = model._augmented(before, after)
    assert shaken[0].shape == before.shape and all(0 <= float(x.min()) <= float(x.max()) <= 1 for x in shaken)


def test_rewards_beyond_the_end_of_an_episode_are_no_success():
    model = a_model().eval()
    before, after, _ = pairs(2)
    batch = {
        "observation.images.top": torch.stack([before[:, 0], after[:, 0]], 1),
        "next.reward": torch.tensor([[0.0, 0, 1], [0, 0, 1]]),
        "next.reward_is_pad": torch.tensor([[False] * 3, [False, False, True]]),
    }
    loss, _ = model.forward(batch)
    expected, _ = model.loss(before, after, torch.tensor([1.0, 0.0]))
    assert float(loss) == pytest.approx(float(expected), rel=1e-4)


def test_stock_lerobot_trains_it(tmp_path: Path):
    out = tmp_path / "out"
    command = [
        sys.executable, "-m", "lerobot.scripts.lerobot_train",
        "--reward_model.discover_packages_path=accerl_lerobot.world_model.success_plugin",
        "--reward_model.type=success_pairs", "--reward_model.push_to_hub=false", "--reward_model.device=cpu",
        "--reward_model.channels=[8, 16]", "--reward_model.chunk=5",
        "--dataset.repo_id=accerl/metaworld_tiny", f"--dataset.root={ROOT / 'datasets' / 'metaworld_tiny'}",
        "--steps=3", "--batch_size=4", "--num_workers=0", "--log_freq=1", f"--output_dir={out}",
        "--save_freq=3",
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "loss" in done.stderr + done.stdout
    saved = out / "checkpoints" / "last" / "pretrained_model"
    trained = SuccessPairsRewardModel.from_pretrained(saved, strict=True)
    assert (trained.config.channels, trained.config.chunk) == ((8, 16), 5)
    frames = torch.from_numpy(np.zeros((1, 2, 3, 64, 64), np.float32))
    assert trained.compute_reward({"observation.images.corner2": frames}).shape == (1,)


@pytest.mark.parametrize(("name", "value"), [("chunk", 0), ("threshold", 1.5), ("channels", ())])
def test_bad_values_name_their_field(name: str, value: object):
    with pytest.raises(InputError, match=f"^reward_model.{name}="):
        a_model(**{name: value})
