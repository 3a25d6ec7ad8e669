# SPDX-License-Identifier: Apache-2.0
"""The success model: what it learns, and its interface as a LeRobot reward model."""

from __future__ import annotations

from collections.abc import Iterable

import pytest
import torch
from lerobot.rewards.factory import get_reward_model_class
from torch import Tensor

from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import task_codes
from accerl_lerobot.world_model.rollout_eval import auroc
from accerl_lerobot.world_model.success_model import SuccessPairsConfig, SuccessPairsRewardModel
from tests.rounding import assert_close

SMALL = {"channels": (8, 16), "device": "cpu"}


def a_model(**options: object) -> SuccessPairsRewardModel:
    torch.manual_seed(0)
    return SuccessPairsRewardModel(SuccessPairsConfig(**(SMALL | options)))  # type: ignore[arg-type]


def pairs(count: int, *, cameras: int = 1, share: float = 0.3, seed: int = 0) -> tuple[Tensor, ...]:
    """A lamp that is lit in the second frame, or not, somewhere right; a light that changes at the left."""
    g = torch.Generator().manual_seed(seed)
    frames = 0.4 + 0.05 * torch.randn(count, 2, cameras, 3, 16, 16, generator=g)
    frames[..., :5] += torch.rand(count, 2, 1, 1, 1, 1, generator=g) - 0.5
    success = (torch.rand(count, generator=g) < share).float()
    for i in range(count):
        y = int(torch.randint(2, 11, (), generator=g))
        frames[i, 1, :, :, y : y + 3, 10:13] += 0.5 * success[i]
    return *frames.clamp(0, 1).unbind(1), torch.from_numpy(task_codes(["push it"] * count)), success


def train(model: SuccessPairsRewardModel, batches: Iterable[tuple[torch.Tensor, ...]]) -> None:
    torch.manual_seed(1)
    optimizer = torch.optim.AdamW(model.parameters(), lr=3e-3)
    for batch in batches:
        optimizer.zero_grad()
        model.loss(*batch)[0].backward()
        optimizer.step()
    model.eval()


def test_it_learns_which_pairs_are_successes():
    model = a_model().train()
    train(model, (pairs(32, share=0.15, seed=step) for step in range(200)))
    before, after, _, success = pairs(400, seed=999)
    seen = {"observation.images.top": torch.stack([before, after], 2)[:, 0], "task": ["push it"] * 400}
    scores = model.compute_reward(seen)
    assert auroc(scores.numpy(), success.numpy() > 0.5) > 0.98
    # Successes are rare in training and weigh as much as failures: 0.5 is no threshold of the rare.
    assert float((scores[success > 0.5] > 0.5).float().mean()) > 0.85


def test_the_same_frames_are_a_success_of_one_task_and_a_failure_of_another():
    model = a_model().train()
    before, after, _, there = (x.repeat_interleave(2, 0) for x in pairs(64, share=0.5))
    task = torch.from_numpy(task_codes(["push it", "pull it"] * 64))
    there[1::2] = 1 - there[1::2]
    train(model, ((before, after, task, there) for _ in range(80)))
    assert float(((model.logits(before, after, task)[0] > 0) == (there > 0.5)).float().mean()) > 0.9


def test_successes_and_failures_weigh_the_same():
    model = a_model().eval()
    before, after, task, success = pairs(40, share=0.1)
    said, _ = model.logits(before, after, task)
    probability = torch.sigmoid(said).double()
    good, bad = success > 0.5, success <= 0.5
    by_hand = -(probability[good].log().mean() + (1 - probability[bad]).log().mean()) / 2
    assert 0 < int(good.sum()) < 10
    assert float(model.loss(before, after, task, success)[0]) == pytest.approx(float(by_hand), rel=1e-4)
    alone = float(model.loss(before[bad], after[bad], task[bad], success[bad])[0])
    assert alone == pytest.approx(float(-(1 - probability[bad]).log().mean()), rel=1e-4)


def test_progress_is_learned_where_it_is_known():
    model = a_model().eval()
    before, after, task, success = pairs(6)
    _, along = model.logits(before, after, task)
    progress = torch.tensor([0.5, torch.nan, 1.0, torch.nan, 0.0, 0.25])
    loss, metrics = model.loss(before, after, task, success, progress)
    known = ~progress.isnan()
    error = (torch.sigmoid(along)[known] - progress[known]).square().mean()
    assert metrics["progress"] == pytest.approx(float(error), rel=1e-4)
    alone = float(model.loss(before, after, task, success)[0])
    assert float(loss) == pytest.approx(alone + float(error), rel=1e-4)
    unknown = torch.full((6,), torch.nan)
    assert "progress" not in model.loss(before, after, task, success, unknown)[1]


def test_cameras_are_averaged_and_single_frames_are_pairs():
    model = a_model().eval()
    before, after, task, _ = pairs(3, cameras=2)
    both = torch.stack([before, after], 1)
    batch = {f"observation.images.{name}": both[:, :, v] for v, name in enumerate("ab")}
    batch["task"] = ["push it"] * 3
    assert get_reward_model_class("success_pairs") is type(model)
    got = model.compute_reward(batch)
    assert_close(got, torch.sigmoid(model.logits(before, after, task)[0]))
    images = {k: v for k, v in batch.items() if k != "task"}
    as_bytes = {k: (255 * v).round().to(torch.uint8) for k, v in images.items()}
    assert torch.allclose(model.compute_reward(batch | as_bytes), got, atol=0.02)
    still = model.compute_reward(batch | {k: v[:, 0] for k, v in images.items()})
    assert_close(still, torch.sigmoid(model.logits(before, before, task)[0]))


def test_only_training_shakes_the_frames():
    model = a_model().train()
    before, after, task, success = pairs(8)
    losses = {float(model.loss(before, after, task, success)[0]) for _ in range(5)}
    assert len(losses) == 5
    model.eval()
    assert len({float(model.loss(before, after, task, success)[0]) for _ in range(5)}) == 1
    shaken = model._augmented(before, after)
    assert shaken[0].shape == before.shape and all(0 <= float(x.min()) <= float(x.max()) <= 1 for x in shaken)


@pytest.mark.parametrize(("name", "value"), [("chunk", 0), ("threshold", 1.5), ("channels", ())])
def test_bad_values_name_their_field(name: str, value: object):
    with pytest.raises(InputError, match=f"^reward_model.{name}="):
        a_model(**{name: value})
