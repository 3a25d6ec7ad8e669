# SPDX-License-Identifier: Apache-2.0
"""Data that a run's world model goes on learning from."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from accerl_lerobot.demos.dataset_files import open_metadata
from accerl_lerobot.demos.record import DemosConfig, record_demos
from accerl_lerobot.demos.sft import SFTConfig
from accerl_lerobot.engine.config import DatasetConfig, RunConfig
from accerl_lerobot.engine.imagination import check_imagination, make_imagination, make_learner
from accerl_lerobot.engine.preflight import check_start
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model.config import (
    ImaginationConfig,
    NetworkConfig,
    OnlineLearnConfig,
    PixelModelConfig,
    WorldModelConfig,
)
from accerl_lerobot.world_model.data import fingerprint
from accerl_lerobot.world_model.learners import new_success_model
from accerl_lerobot.world_model.online import Promotion
from accerl_lerobot.world_model.pixels import PixelWorldModel
from accerl_lerobot.world_model.pretrain import world_spec
from accerl_lerobot.world_model.store import OWN_RUN, Source, load_sources, save_world_model
from accerl_lerobot.world_model.success_plugin.modeling_success_pairs import SuccessPairsRewardModel
from tests.runs import tiny_run

ENV = SimulatedConfig(max_steps=16, hold=8)


def recorded(root: Path, episodes: int, seed: int) -> DatasetConfig:
    of = DemosConfig(episodes=episodes, failure_share=0.5, processes=1)
    return DatasetConfig(repo_id="a/b", root=str(record_demos(ENV, of, str(root), seed)))


@pytest.fixture(scope="module")
def datasets(tmp_path_factory: pytest.TempPathFactory) -> tuple[DatasetConfig, DatasetConfig]:
    """Demonstrations, and what stands for a policy's episodes."""
    root = tmp_path_factory.mktemp("datasets")
    return recorded(root / "demos", 5, 0), recorded(root / "rollouts", 4, 1)


def run(checkpoint: Path, folder: Path, learn: OnlineLearnConfig, sources: list[Source]) -> RunConfig:
    """One that imagines with a model that has learnt from these."""
    torch.manual_seed(0)
    config = PixelModelConfig(network=NetworkConfig(channels=(8, 8), condition=8, planes=2))
    spec = world_spec(WorldModelConfig(chunk=4, image_size=32, model=config), ENV)
    save_world_model(folder, PixelWorldModel(spec, config), new_success_model(4), sources)
    imagination = ImaginationConfig(share=0.5, path=str(folder), learn=learn)
    return tiny_run(checkpoint, env=ENV, imagination=imagination)


def known(dataset: DatasetConfig, learnt: tuple[int, ...], held_out: tuple[int, ...]) -> Source:
    print_ = fingerprint(open_metadata(dataset))
    return Source(repo_id="a/b", fingerprint=print_, learnt=learnt, held_out=held_out)


def test_it_goes_on_with_what_it_has_learned_from_and_never_with_what_was_held_out(
    tiny_checkpoint: Path, datasets: tuple[DatasetConfig, DatasetConfig], tmp_path: Path
):
    demos, rollouts = datasets
    both = OnlineLearnConfig(dataset=demos, online=rollouts)
    sources = [known(demos, (0, 2), (1, 3, 4)), known(rollouts, (1, 2, 3), (0,))]
    learner = make_learner(run(tiny_checkpoint, tmp_path / "both", both, sources))
    assert (len(learner._offline), len(learner._held_offline)) == (5, 4)
    every = learner._offline + learner._held_offline
    assert not any(e.source == "online" for e in every), "a trial is about this run's own failures"
    of = {e.actions.tobytes() for e in learner._offline}
    assert len(of) == 5 and not of & {e.actions.tobytes() for e in learner._held_offline}

    swapped = OnlineLearnConfig(dataset=rollouts, online=demos)
    learner = make_learner(run(tiny_checkpoint, tmp_path / "swapped", swapped, sources))
    assert (len(learner._offline), len(learner._held_offline)) == (5, 4), "whichever section it is named in"
    learner = make_learner(run(tiny_checkpoint, tmp_path / "none", both, []))
    assert (len(learner._offline), len(learner._held_offline)) == (9, 0), (
        "what it does not know it takes whole"
    )


def test_what_is_promoted_says_what_it_has_learned_from(
    tiny_checkpoint: Path, datasets: tuple[DatasetConfig, DatasetConfig], tmp_path: Path
):
    demos, rollouts = datasets
    source = known(demos, (0, 2), (1, 3, 4))
    config = run(
        tiny_checkpoint, tmp_path / "model", OnlineLearnConfig(dataset=demos, online=rollouts), [source]
    )
    imagination = make_imagination(config, lambda segment: None)
    model, success = imagination.models
    assert isinstance(model, PixelWorldModel) and isinstance(success, SuccessPairsRewardModel)
    imagination.swap(Promotion(model, success, 7, {}))
    success.config.device = "cuda:3"  # as where it imagines; a machine that resumes may have none
    imagination.save_promoted(tmp_path / "promoted")
    saved = json.loads((tmp_path / "promoted" / "success_model" / "config.json").read_text())
    assert saved["device"] == "cpu" and success.config.device == "cuda:3"
    assert load_sources(tmp_path / "promoted") == (source, known(rollouts, (0, 1, 2, 3), ()), OWN_RUN)


def test_what_would_be_fine_tuned_is_looked_at_before(tiny_checkpoint: Path, tmp_path: Path):
    config = run(tiny_checkpoint, tmp_path / "model", OnlineLearnConfig(), [])
    path = config.policy.path
    tuned = replace(config, policy=replace(config.policy, path=None), sft=SFTConfig(steps=1, init_path=path))
    check_imagination(tuned)
    new = {"type": "smolvla", "chunk_size": 8, "n_action_steps": 8}
    fresh = replace(tuned, sft=SFTConfig(steps=1, policy=new), policy=replace(tuned.policy, n_action_steps=4))
    check_imagination(fresh)
    two = replace(tuned, policy=replace(tuned.policy, n_action_steps=2))
    with pytest.raises(InputError, match="executes 2 actions per decision"):
        check_imagination(two)
    for start in (check_imagination, check_start):
        with pytest.raises(InputError, match=r"^sft\.init_path='nowhere'"):
            start(replace(tuned, sft=replace(tuned.sft, init_path="nowhere")))
    assert check_start(tuned) == 1


def test_a_dataset_that_is_named_twice_is_refused(
    tiny_checkpoint: Path, datasets: tuple[DatasetConfig, DatasetConfig], tmp_path: Path
):
    twice = OnlineLearnConfig(dataset=datasets[0], online=datasets[0])
    config = run(tiny_checkpoint, tmp_path / "model", twice, [])
    message = "^imagination.learn.online.repo_id='a/b': it is the one in imagination.learn.dataset; name"
    for refused in (check_imagination, make_learner):
        with pytest.raises(InputError, match=message):
            refused(config)


@pytest.mark.parametrize("section", ["dataset", "online"])
def test_a_dataset_that_is_not_there_is_named_by_its_section(
    section: str, tiny_checkpoint: Path, tmp_path: Path
):
    learn = OnlineLearnConfig(**{section: DatasetConfig(repo_id="a/b", root="nowhere")})
    config = run(tiny_checkpoint, tmp_path / "model", learn, [])
    for refused in (check_imagination, make_learner):
        with pytest.raises(
            InputError, match=rf"^imagination.learn.{section}.root='nowhere': no meta/info.json"
        ):
            refused(config)
