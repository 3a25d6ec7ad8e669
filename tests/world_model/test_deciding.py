# SPDX-License-Identifier: Apache-2.0
"""Policies that decide twice: on what was seen, and on what is dreamt."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from accerl_lerobot import cli
from accerl_lerobot.cli.configs import WorldModelEvalRun
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Decision, Request
from accerl_lerobot.world_model.baselines import CopyModel
from accerl_lerobot.world_model.deciding import (
    Decided,
    alike,
    as_world,
    check_policies,
    decide_twice,
    load_policy,
    replayed_whole,
)
from accerl_lerobot.world_model.episodes import Episode
from tests.policies.checkpoints import write_policy
from tests.world_model.lived import SPEC, K, decided
from tests.world_model.test_evaluate import folders, told

__all__ = ["folders"]


def episode(length: int, bright: int, success_at: int = -1) -> Episode:
    """A frame every K steps, each brighter than the one before; the state counts them."""
    count = -(-length // K) + 1
    times = np.minimum(np.arange(count) * K, length)
    return Episode(
        frames=np.stack([np.full((1, 16, 16, 3), bright + 10 * i, np.uint8) for i in range(count)]),
        times=times,
        state=np.repeat(np.arange(count, dtype=np.float32)[:, None], 4, 1),
        actions=np.zeros((length, 2), np.float32),
        success_at=success_at,
        task="Match the target",
        source="online",
    )


class Looking:
    """Its first action is how bright it is, its second what the state says; noise on both."""

    def __init__(self, noise: float = 0.0) -> None:
        self.noise, self.asked, self.side = noise, 0, 16

    def decide(self, requests: Sequence[Request], version: int) -> list[Decision]:
        made = []
        for request in requests:
            self.asked += 1
            o = request.observation
            assert not request.explore and o["task"] == "Match the target"
            image, state = o["observation.images.front"], o["observation.state"]
            assert np.shape(image) == (self.side, self.side, 3)
            said = np.asarray([np.mean(image), state[0]])
            said = said + self.noise * np.random.default_rng(request.noise_seed).standard_normal(2)
            made.append(decided(np.tile(said, (K + 2, 1))))
        return made


def settings(side: int = 16) -> Any:
    return SimpleNamespace(
        image_features={"observation.images.front": SimpleNamespace(shape=(3, side, side))}
    )


def twice(policy: Any, episodes: list[Episode], side: int = 16) -> Decided:
    return decide_twice(
        policy, SPEC, as_world(SPEC, settings(side)), replayed_whole(CopyModel(SPEC), episodes)
    )


def test_it_decides_wherever_a_chunk_was_followed_by_another():
    episodes = [episode(3 * K, 0), episode(3 * K, 100, success_at=2 * K - 1), episode(2 * K - 1, 50)]
    policy = Looking()
    found = twice(policy, episodes)
    # Of the first after two chunks, of the others after one: the second succeeds, the third ends.
    assert list(zip(found.episode.tolist(), found.depth.tolist(), strict=True)) == [
        (0, 1), (0, 2), (1, 1), (2, 1),
    ]  # fmt: skip
    assert policy.asked == 8 and found.real.shape == found.dreamt.shape == (4, K, 2)
    assert found.real[:, 0].tolist() == [[10, 1], [20, 2], [110, 1], [60, 1]]
    assert found.dreamt[:, 0].tolist() == [[0, 0], [0, 0], [100, 0], [50, 0]], "nothing has moved"
    policy.side = 32  # what it has learnt from, and would be shown in a run
    assert np.array_equal(twice(policy, episodes, 32).real, found.real)


def test_noise_is_no_spread():
    """However noisily it decides: what it is shown is what makes its decisions differ."""
    episodes = [episode(3 * K, b) for b in (0, 100)]
    quiet, noisy = twice(Looking(), episodes), twice(Looking(noise=50.0), episodes)
    assert not np.allclose(quiet.real, noisy.real)
    assert alike([noisy])["whole"]["value"] == pytest.approx(alike([quiet])["whole"]["value"], abs=1e-6)


def by_hand(real: Sequence[float], dreamt: Sequence[float], depth: Sequence[int]) -> Decided:
    def chunks(values: Sequence[float]) -> np.ndarray:
        # The second action never varies, and says nothing.
        return np.stack([np.asarray([[v, 7.0]], np.float32) for v in values])

    return Decided(chunks(real), chunks(dreamt), np.arange(len(real)), np.asarray(depth))


def test_alike_by_hand():
    """Real actions −1, 1, −1, 1: spread 1; a dream off by ½ costs ¼ of what the mean would."""
    found = alike([by_hand([-1, 1, -1, 1], [-0.5, 1.5, -1, 0], [1, 1, 2, 2])])
    assert found["first"]["value"] == pytest.approx(0.75)
    assert found["whole"]["value"] == pytest.approx(1 - 1.5 / 4)
    assert found["whole"]["low"] <= found["whole"]["value"] <= found["whole"]["high"]
    assert (found["policies"], found["decisions"]) == (1, 4)
    # Each policy in units of its own spread.
    ones = [1, 1]
    both = alike([by_hand([-1, 1], [-0.5, 1.5], ones), by_hand([-100, 100], [-100, 100], ones)])
    assert both["whole"]["value"] == pytest.approx(1 - 0.5 / 4) and both["decisions"] == 4


def test_the_average_frame_of_a_depth_is_worth_nothing():
    """Early and late actions differ by far more than those of one depth do among each other."""
    found = alike([by_hand([9, 11, -11, -9], [10, 10, -10, -10], [1, 1, 2, 2])])
    assert found["first"]["value"] == pytest.approx(0.0) and found["whole"]["value"] == pytest.approx(0.0)


def test_where_nothing_is_decided_nothing_is_said():
    found = alike([by_hand([2, 2], [2, 2], [1, 1])])
    assert math.isnan(found["whole"]["value"])
    short = [episode(K, 0), episode(2, 9)]
    none = twice(Looking(), short)
    assert none.real.shape == (0, K, 2)
    empty = alike([none])
    assert empty["decisions"] == 0 and math.isnan(empty["whole"]["value"])


def test_as_a_user(folders: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    torch.manual_seed(0)
    fields = {"chunk_size": 5, "n_action_steps": 5, "dim_model": 16, "n_heads": 2, "use_vae": False}
    fields |= {"dim_feedforward": 16, "n_encoder_layers": 1, "pretrained_backbone_weights": None}
    paths = [str(write_policy(tmp_path / f"act{i}", "act", seed=i, **fields)) for i in range(2)]
    named = f"--policies={json.dumps(paths)}"
    cli.main(told(folders, tmp_path / "one", named))
    stdout, stderr = capsys.readouterr()
    found = json.loads(stdout)
    assert found["alike"]["policies"] == 2 and found["alike"]["decisions"] > 20
    assert found["alike"]["whole"]["value"] < 1.0, "a world model that has learnt nothing is noticed"
    assert found == json.loads((tmp_path / "one" / "trial.json").read_text())
    assert "policies decide alike, whole dreams" in stderr
    assert cli.main(["report", str(tmp_path / "one")]) == 0
    assert "policies decide alike, first chunk" in (tmp_path / "one" / "report.html").read_text()

    capsys.readouterr()
    more = ["--online.repo_id=a/b", f"--online.root={folders[2]}"]
    cli.main(told(folders, tmp_path / "two", named, *more))
    found = json.loads(capsys.readouterr().out)
    other = found["sources"]["online"]["alike"]
    assert other["policies"] == 2 and other["decisions"] > found["alike"]["decisions"]


def test_policies_that_cannot_act_in_dreams_are_refused(tmp_path: Path):
    small = {"chunk_size": 5, "dim_model": 16, "n_heads": 2, "pretrained_backbone_weights": None}
    fits = write_policy(tmp_path / "fits", "act", n_action_steps=K, **small)
    (world,) = check_policies([str(fits)], SPEC)
    assert world.images == {"observation.images.front": (16, 16, 3)}
    large = write_policy(tmp_path / "large", "act", n_action_steps=K, image=32, **small)
    assert check_policies([str(large)], SPEC)[0].images == {"observation.images.front": (32, 32, 3)}
    longer = write_policy(tmp_path / "longer", "act", n_action_steps=5, **small)
    with pytest.raises(InputError, match=r"policies=.*longer.*executes 5 actions"):
        check_policies([str(longer)], SPEC)
    other = write_policy(
        tmp_path / "other", "act", n_action_steps=K, camera="observation.images.top", **small
    )
    with pytest.raises(InputError, match=r"policies=.*other.*observation.images.top"):
        check_policies([str(other)], SPEC)
    with pytest.raises(InputError, match=r"policies=.*nowhere"):
        check_policies([str(tmp_path / "nowhere")], SPEC)
    with pytest.raises(InputError, match="policies=.*twice"):
        WorldModelEvalRun(path="x", policies=("a", "a"))
    (fits / "model.safetensors").write_bytes(b"none")
    with pytest.raises(InputError, match="policies=.*fits"):
        load_policy(str(fits))
