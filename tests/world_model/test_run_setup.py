# SPDX-License-Identifier: Apache-2.0
"""Data that a run's world model goes on learning from."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from accerl_lerobot.demos.record import DemosConfig, record_demos
from accerl_lerobot.demos.sft import SFTConfig
from accerl_lerobot.engines.config import DatasetConfig, RunConfig
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.run.preflight import check_start
from accerl_lerobot.world_model.config import (
    ImaginationConfig,
    OnlineLearnConfig,
    PixelModelConfig,
    WorldModelConfig,
)
from accerl_lerobot.world_model.imagined import check_imagination
from accerl_lerobot.world_model.learners import new_success_model
from accerl_lerobot.world_model.online import make_learner
from accerl_lerobot.world_model.pixels import PixelWorldModel
from accerl_lerobot.world_model.pretrain import world_spec
from accerl_lerobot.world_model.store import HELD_OUT, LEARNT, note_failed, save_world_model
from tests.runs import tiny_run

ENV = SimulatedConfig(max_steps=16, hold=8)


def recorded(root: Path, episodes: int, seed: int) -> DatasetConfig:
    of = DemosConfig(episodes=episodes, failure_share=0.5)
    return DatasetConfig(repo_id="a/b", root=str(record_demos(ENV, of, str(root), seed)))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> DatasetConfig:
    """The data of a pre-training."""
    return recorded(tmp_path_factory.mktemp("dataset") / "demos", 9, 0)


def run(checkpoint: Path, folder: Path, learn: OnlineLearnConfig, roles: dict[str, str]) -> RunConfig:
    """One that imagines with a model of these episodes."""
    torch.manual_seed(0)
    config = PixelModelConfig(channels=(8, 8))
    spec = world_spec(WorldModelConfig(chunk=4, image_size=32, model=config), ENV)
    save_world_model(folder, PixelWorldModel(spec, config), new_success_model(4), roles)
    imagination = ImaginationConfig(environments=4, path=str(folder), learn=learn)
    return tiny_run(checkpoint, env=ENV, imagination=imagination)


def test_it_goes_on_with_what_it_has_learned_from_and_never_with_what_was_held_out(
    tiny_checkpoint: Path, dataset: DatasetConfig, tmp_path: Path
):
    learn = OnlineLearnConfig(dataset=dataset)
    config = run(tiny_checkpoint, tmp_path / "none", learn, {})
    learner = make_learner(config)
    assert len(learner._offline) == 9, "of unknown ones it takes all"
    assert not any(e.own for e in learner._offline), "a validation is about this run's own failures"

    keys = [episode.key for episode in learner._offline]
    roles = dict.fromkeys(keys[:2], LEARNT) | dict.fromkeys(keys[2:5], HELD_OUT) | {keys[5]: HELD_OUT}
    learner = make_learner(run(tiny_checkpoint, tmp_path / "some", learn, roles | {"elsewhere": LEARNT}))
    assert [e.key for e in learner._offline] == keys[:2] + keys[6:]


def test_what_would_be_fine_tuned_is_looked_at_before(tiny_checkpoint: Path, tmp_path: Path):
    config = run(tiny_checkpoint, tmp_path / "model", OnlineLearnConfig(), {})
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
    assert check_start(tuned)[1] == 1


@pytest.mark.parametrize(
    ("failed", "steps", "told"),
    [
        (None, 0, "was never validated and is used all the same"),
        (
            ["recall", "online.auroc"],
            0,
            "failed its validation (recall, online.auroc) and is used all the same",
        ),
        ([], 0, None),
    ],
)
def test_a_model_that_failed_its_validation_is_not_used_silently(
    failed: list[str] | None,
    steps: int,
    told: str | None,
    tiny_checkpoint: Path,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
):
    """Only one that passes is used where it learns."""
    config = run(tiny_checkpoint, tmp_path / "model", OnlineLearnConfig(steps_per_episode=steps), {})
    if failed is not None:
        note_failed(tmp_path / "model", failed)
    check_imagination(config)
    logged = [
        record.getMessage() for record in caplog.records if record.name.endswith("world_model.imagined")
    ]
    assert len(logged) == (told is not None) and all(str(told) in line for line in logged)


def test_what_a_model_failed_is_a_list_of_names(tiny_checkpoint: Path, tmp_path: Path):
    config = run(tiny_checkpoint, tmp_path / "model", OnlineLearnConfig(steps_per_episode=0), {})
    note_failed(tmp_path / "model", [])
    path = tmp_path / "model" / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"failed_checks": 7}))
    with pytest.raises(InputError, match=r"^imagination\.path=.*config\.json: failed_checks"):
        check_imagination(config)


def test_a_dataset_that_is_not_there_is_named_by_its_section(tiny_checkpoint: Path, tmp_path: Path):
    learn = OnlineLearnConfig(dataset=DatasetConfig(repo_id="a/b", root="nowhere"))
    config = run(tiny_checkpoint, tmp_path / "model", learn, {})
    for refused in (check_imagination, make_learner):
        with pytest.raises(
            InputError, match=r"^imagination.learn.dataset.root='nowhere': no meta/info.json there"
        ):
            refused(config)
