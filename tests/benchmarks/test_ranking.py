# SPDX-License-Identifier: Apache-2.0

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from accerl_lerobot.envs import make_world
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import Decision, Request
from accerl_lerobot.world_model.config import NetworkConfig, PixelModelConfig, WorldModelConfig
from accerl_lerobot.world_model.contract import Context, Prediction, Reset, State, WorldModel
from accerl_lerobot.world_model.learners import new_success_model
from accerl_lerobot.world_model.pixels import PixelWorldModel
from accerl_lerobot.world_model.pretrain import world_spec
from accerl_lerobot.world_model.registry import ImaginationModels
from accerl_lerobot.world_model.store import save_world_model
from benchmarks import paired_eval
from benchmarks import ranking as bench
from benchmarks.paired_eval import rollout_imagined, rollout_real
from benchmarks.ranking import BenchRankingConfig
from tests.test_imagination import ENV
from tests.world_model.real_segments import SPEC, WORLD, K, decided

STARTS = [("match", seed) for seed in range(23)]


class Aiming:
    """A policy that knows the target, and misses it by a noise of its own."""

    def __init__(self, aside: float) -> None:
        self.aside = aside
        self.most = 0

    def decide(self, requests: Sequence[Request], version: int) -> list[Decision]:
        self.most = max(self.most, len(requests))
        made = []
        for request in requests:
            assert not request.explore
            target = np.asarray(request.observation["observation.state"])[:2]
            miss = self.aside * np.random.default_rng(request.noise_seed).standard_normal(2)
            made.append(decided(np.tile(target + miss, (K, 1))))
        return made


class Knowing(WorldModel):
    """The simulated world where one action on the target is enough: it turns bright then."""

    spec = SPEC

    def begin(self, context: Context, tasks: Sequence[str], resets: Sequence[Reset] | None = None) -> State:
        assert not context.commanded_sum.any() and torch.equal(context.initial_state, context.robot[:, -1])
        return {"robot": context.robot[:, -1], "frames": context.frames[:, -1]}

    def step(self, state: State, actions: Tensor, seeds: Sequence[int]) -> Prediction:
        assert len(set(seeds)) == len(actions)
        met = ((actions[:, 0] - state["robot"][:, :2]).abs() < WORLD.tolerance).all(1)
        frames = torch.zeros_like(state["frames"]) + (200 * met.byte())[:, None, None, None, None]
        unknown = torch.full((len(actions),), torch.nan)
        return Prediction(state=state, frames=frames, robot=state["robot"], uncertainty=unknown)


@pytest.fixture
def models(monkeypatch: pytest.MonkeyPatch) -> ImaginationModels:
    """With a success model that looks at how bright it is."""
    monkeypatch.setattr(paired_eval, "probabilities", lambda _, before, after: after.max((1, 2, 3, 4)) / 200)
    return ImaginationModels(Knowing(), SimpleNamespace(config=SimpleNamespace(threshold=0.5)))  # type: ignore[arg-type]


@pytest.mark.parametrize(("aside", "rate"), [(0.0, (1, 1)), (0.4, (0.2, 0.9)), (9.0, (0, 0))])
def test_a_policy_does_the_same_in_a_true_world_model(
    models: ImaginationModels, aside: float, rate: tuple[float, float]
):
    worlds = [make_world(replace(WORLD, hold=1)) for _ in range(4)]
    told: list[int] = []
    policy: Any = Aiming(aside)
    real = rollout_real(policy, worlds, STARTS, told.append)
    assert told == list(range(1, len(STARTS) + 1)) and policy.most == 4
    promised = rollout_imagined(policy, models, worlds[0], STARTS, batch=9)
    assert np.array_equal(real, promised > 0.5) and policy.most == 9
    assert rate[0] <= real.mean() <= rate[1]


def result() -> dict[str, Any]:
    found = {
        name: {"value": 0.5, "low": 0.1, "high": 0.9}
        for name in ("spearman", "pearson", "mmrv", "bias", "mcc")
    }
    rows = [{"path": f"run{i}", "real": i, "imagined": 2 * i, "n": 10} for i in range(3)]
    even = {"threshold": 0.9, "imagined": [0, 1, 2], "agreement": found}
    return {"policies": rows, "threshold": 0.5, "agreement": found, "even": even}


def test_the_table_and_the_picture(tmp_path: Path):
    shown = bench.table(result())
    assert shown.row_count == 3 and "Spearman 0.50 [0.10, 0.90]" in str(shown.title)
    bench.draw(tmp_path / "ranking.png", result())
    assert (tmp_path / "ranking.png").read_bytes().startswith(b"\x89PNG")


def test_checkpoints_are_ranked(tmp_path: Path, tiny_checkpoint: Path):
    torch.manual_seed(0)
    config = PixelModelConfig(network=NetworkConfig(channels=(8, 8), condition=8, planes=2))
    spec = world_spec(WorldModelConfig(chunk=4, image_size=32, model=config), ENV)
    save_world_model(tmp_path / "world_model", PixelWorldModel(spec, config), new_success_model(4))
    policies = tuple(str(shutil.copytree(tiny_checkpoint, tmp_path / name)) for name in "abc")
    options: dict[str, Any] = {"path": str(tmp_path / "world_model"), "env": ENV, "episodes": 6, "worlds": 4}
    found = bench.bench_ranking(
        BenchRankingConfig(policies=policies, output_dir=str(tmp_path / "out"), **options)
    )
    assert [row["path"] for row in found["policies"]] == list(policies)
    real = found["outcomes"]["real"]
    assert real[0] == real[1] == real[2] and len(real[0]) == 6, "three copies of one policy"
    said = np.array(found["outcomes"]["score"])
    assert [row["imagined"] for row in found["policies"]] == (said > found["threshold"]).sum(1).tolist()
    assert found["even"]["imagined"] == (said > found["even"]["threshold"]).sum(1).tolist()
    assert json.loads((tmp_path / "out" / "ranking.json").read_text())["policies"] == found["policies"]
    assert (tmp_path / "out" / "ranking.png").is_file()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"policies": ("a", "b", "a")}, "policies=.*at least one checkpoint, none of them twice"),
        ({"policies": ()}, "policies=.*at least one checkpoint"),
        ({"path": None}, "path=None: give the folder"),
        ({"episodes": 0}, "episodes=0"),
        ({"output_dir": "."}, "output_dir='.': the folder exists"),
    ],
)
def test_bad_values_name_their_field(change: dict[str, Any], message: str):
    fields: dict[str, Any] = {"path": "x", "policies": ("a", "b", "c")}
    with pytest.raises(InputError, match=message):
        BenchRankingConfig(**(fields | change))
