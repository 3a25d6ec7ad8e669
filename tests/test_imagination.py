# SPDX-License-Identifier: Apache-2.0
"""Runs in which rollout workers step imagined environments too, through either engine."""

import importlib
import itertools
import os
import signal
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch

from accerl_lerobot.algorithms.ratio_update import RatioUpdate
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import TRAINING_STATE, WORLD_MODEL
from accerl_lerobot.console import Console
from accerl_lerobot.engines import Progress
from accerl_lerobot.engines.config import DatasetConfig, RunConfig
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import IMAGINED, REAL, Segment
from accerl_lerobot.run.train import Run
from accerl_lerobot.timeline import read_timeline
from accerl_lerobot.world_model.config import LearnableModelConfig, OnlineLearnConfig, PixelModelConfig
from accerl_lerobot.world_model.contract import WorldModelSpec, load_episodes
from accerl_lerobot.world_model.imagined import check_imagination, load_world, new_world, save_world
from accerl_lerobot.world_model.training import ONLINE, make_trainer
from tests.policies.checkpoints import write_diffusion
from tests.runs import changed, drive, local_engine, polls, tiny_run, trained, updates
from tests.tiny_datasets import one_process, record_dataset

# About half of all episodes succeed when it is acted at random.
ENV = SimulatedConfig(max_steps=16, hold=8, tolerance=0.45)
SPEC = WorldModelSpec(
    cameras=("observation.images.front",), image_size=(32, 32), state_dim=4, action_dim=2, chunk=4, fps=80,
)  # fmt: skip
PIXELS = PixelModelConfig(channels=(8, 8))


def saved_world(folder: Path, config: LearnableModelConfig = PIXELS, **content: Any) -> Path:
    torch.manual_seed(0)
    save_world(folder, new_world(SPEC, config, tasks=["Match the target"], **content))
    return folder


@pytest.fixture(scope="module")
def world_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return saved_world(tmp_path_factory.mktemp("world") / "world_model")


def imagining(checkpoint: Path, path: Path | None, episodes: int = 6, **imagination: Any) -> RunConfig:
    """A run of so many real episodes with the world model at `path`, or without one."""
    given = {"environments": 4, "path": str(path), "learn": OnlineLearnConfig(steps_per_episode=1)}
    rollout = {"segment_length": 4, "episodes": episodes}
    return tiny_run(checkpoint, env=ENV, rollout=rollout, imagination=(given if path else {}) | imagination)


def test_once_the_real_episodes_are_played_all_is_imagined(tiny_checkpoint: Path, world_model: Path):
    with mock.patch.object(RatioUpdate, "step", autospec=True, side_effect=RatioUpdate.step) as step:
        history, _ = trained(imagining(tiny_checkpoint, world_model))
    batches: list[list[Segment]] = [call.args[1] for call in step.mock_calls]
    imaginary = [sum(len(s) for s in batch if s.source == IMAGINED) for batch in batches]
    total = [sum(map(len, batch)) for batch in batches]
    ended = [e for p in history for e in p.episodes]
    real, imagined = ([e for e in ended if e.plan.source == source] for source in (REAL, IMAGINED))
    counters, replay = history[-1].rollout, history[-1].replay
    assert len(real) == 6 == counters["episodes"] and len(imagined) == counters["imagined_episodes"] > 6
    assert counters["decisions"] == sum(e.decisions for e in real)
    assert counters["imagined_decisions"] >= sum(e.decisions for e in imagined)
    assert len(batches) == 12 and imaginary[-1] == total[-1] and imaginary[0] < total[0]
    assert replay["trained_imagined"] == sum(imaginary)
    assert replay["trained_decisions"] == sum(total)
    assert history[-1].world_model["learn_episodes"] == 6 == history[-1].world_model["learn_steps"]
    firsts: dict[str, set[bytes]] = {REAL: set(), IMAGINED: set()}
    for segment in itertools.chain(*batches):
        if segment.origin.decision == 0:
            firsts[segment.source].add(segment.observations["observation.images.front"][0].tobytes())
    assert firsts[IMAGINED] and firsts[IMAGINED] <= firsts[REAL], "they begin where real ones did"


def test_without_imagination_a_run_ends_when_its_episodes_are_used_up(tiny_checkpoint: Path):
    history, _ = trained(imagining(tiny_checkpoint, None))
    assert history[-1].done and 0 < history[-1].version < 12
    assert history[-1].replay["available_decisions"] < 16 and history[-1].world_model == {}


@pytest.mark.slow
@pytest.mark.parametrize(("steps", "left_at"), [(3.0, 0.5), (0.0, 0.7)])
def test_a_run_that_was_left_goes_on_as_if_it_had_not(steps, left_at, tiny_checkpoint, world_model, tmp_path):
    learn = OnlineLearnConfig(steps_per_episode=steps)
    config = imagining(tiny_checkpoint, world_model, 12, learn=learn)

    def reported(history: list[Progress]) -> list[Any]:
        last = history[-1]
        return [updates(history), last.rollout, last.replay, last.world_model]

    whole, expected = trained(config)
    first = local_engine(config)
    first.train()
    before = [first.poll() for _ in range(round(left_at * len(whole)))]
    first.save(tmp_path)
    first.close()
    again = local_engine(config, state=tmp_path / TRAINING_STATE)
    again.train()
    after = drive(again)
    again.close()
    assert len(whole) == len(before) + len(after) and len(after) > 1
    assert reported(before + after) == reported(whole) and whole[-1].rollout["imagined_episodes"] > 8
    for key, tensor in expected._adapter.export_trainable().items():
        np.testing.assert_array_equal(tensor, again._adapter.export_trainable()[key])
    assert (tmp_path / WORLD_MODEL / "model.safetensors").is_file() is (steps > 0)


@pytest.mark.slow
def test_it_runs_asynchronously(tiny_checkpoint: Path, world_model: Path, tmp_path: Path):
    from accerl_lerobot.engines.ray_engine import RayEngine

    n = 80  # so many that some are left when the process is missed, on a busy machine too
    config = imagining(tiny_checkpoint, world_model)
    config = changed(config, trainer={"updates": n}, output_dir=str(tmp_path))
    with closing(RayEngine(config, ("match",))) as engine:
        pids = engine.pids()
        assert "world-model learning" in set(pids)
        engine.train()
        history = []
        for progress in polls(engine):
            history.append(progress)
            if progress.rollout["episodes"] == 6:
                break
        os.kill(pids["rollout 0"], signal.SIGKILL)  # the next one imagines from episodes that it has not seen
        history += drive(engine)
        engine.save(tmp_path / "saved")
    last = history[-1]
    assert last.rollout["restarts"] == 1.0
    assert last.version == n == len(updates(history))
    assert sum(e.plan.source == REAL for p in history for e in p.episodes) == 6
    assert last.world_model["learn_episodes"] > 0 and last.world_model["version"] > 0
    assert 0 < last.replay["trained_imagined"] < last.replay["trained_decisions"]
    explained = (Path(__file__).parents[1] / "docs" / "metrics.md").read_text()
    assert not [name for name in last.world_model if f"`world_model_{name}`" not in explained]
    spent = read_timeline(tmp_path).shares()
    assert {"compute", "wait_in"} <= spent["world-model learning"].keys()
    saved = snapshot.load(tmp_path / "saved" / TRAINING_STATE / ONLINE)
    assert saved["version"] >= last.world_model["learn_steps"]


def test_what_does_not_fit_is_refused_before_the_run_begins(tiny_checkpoint, world_model, tmp_path, caplog):
    config = imagining(tiny_checkpoint, world_model)
    back = str(write_diffusion(tmp_path / "back", image=32, n_obs_steps=2))
    for section, fields, line in (
        ("env", {"reward": "dense"}, "env.reward='dense': use success with"),
        ("env", {"environment_state": True}, "state=True: no policy reads it"),
        ("policy", {"n_action_steps": 2}, "chunk, and this run's is 2"),
        ("policy", {"path": back}, "policy.n_obs_steps=2: the policy looks"),
        ("rollout", {"segment_length": 3}, "length=3: use 4 or more"),
        ("imagination", {"path": "nowhere"}, "imagination.path='nowhere': config.json: is missing"),
        ("rollout", {"workers": 4, "episodes": 2}, r"rollout\.episodes=2: use at least 4: each rollout"),
    ):
        with pytest.raises(InputError, match=line):
            check_imagination(changed(config, **{section: fields}))
    check_imagination(config)
    assert not caplog.messages
    check_imagination(imagining(tiny_checkpoint, saved_world(tmp_path / "w", failed_checks=["auroc"])))
    assert "failed checks (auroc)" in caplog.text


def test_it_goes_on_with_what_it_has_learned_from_and_never_with_what_was_held_out(tiny_checkpoint, tmp_path):
    dataset = record_dataset(tmp_path / "demos", ENV, episodes=6, failure_share=0.5)
    keys = [episode.key for episode in load_episodes(dataset, SPEC)]

    def with_dataset(learnt: list[str], **changes: str) -> RunConfig:
        path = saved_world(tmp_path / learnt[0], learnt=learnt)
        learn = OnlineLearnConfig(dataset=replace(dataset, **changes))
        return imagining(tiny_checkpoint, path, learn=learn)

    trainer = make_trainer(with_dataset(keys[1:4]))
    assert list(dict.fromkeys(start.episode.key for start in trainer._recorded)) == keys[1:4]
    with pytest.raises(InputError, match=r"^imagination\.learn\.dataset\.repo_id='a/b': the world"):
        make_trainer(with_dataset(["elsewhere"]))
    with pytest.raises(InputError, match=r"^imagination\.learn\.dataset\.root='nowhere': no meta/info.json"):
        check_imagination(with_dataset(keys[:1], root="nowhere"))


def test_a_world_model_of_another_package_imagines_and_goes_on_learning(tiny_checkpoint, tmp_path: Path):
    package = "tests.world_model.linear_world"
    linear = importlib.import_module(package).LinearModelConfig
    path = saved_world(tmp_path / "w", linear(gain=3.0))
    LearnableModelConfig.get_known_choices().pop("linear")
    sys.modules.pop(package)
    running = local_engine(imagining(tiny_checkpoint, path, 24, discover_packages_path=package))
    running.train()
    last = drive(running)[-1]
    running.save(tmp_path / "saved")
    running.close()
    assert last.world_model["learn_steps"] > 0 < last.replay["trained_imagined"]
    before, after = load_world(path, package), load_world(tmp_path / "saved" / WORLD_MODEL)
    moved = after.get_parameter("model.motion.weight") - before.get_parameter("model.motion.weight")
    assert float(moved.abs().max()) > 0


@pytest.mark.slow
def test_one_command_records_play_trains_a_world_model_on_it_and_practises(tiny_checkpoint, tmp_path, capsys):
    """Stopped after a part, it goes on with the next one."""
    config = imagining(
        tiny_checkpoint, None, environments=4, policy_episodes=8, expert_episodes=8, steps=30,
        learn=OnlineLearnConfig(steps_per_episode=1),
    )  # fmt: skip
    config = changed(config, launch={"engine": "local"})
    stopped = mock.patch("accerl_lerobot.run.play.pretrain", side_effect=KeyboardInterrupt)
    with one_process(), stopped, pytest.raises(KeyboardInterrupt):
        Run(config, tmp_path, Console()).execute()
    recorded = load_episodes(DatasetConfig(repo_id="a/b", root=str(tmp_path / "play")), SPEC)
    assert len(recorded) == 16 and {episode.success for episode in recorded} == {True, False}
    assert not (tmp_path / "pretraining").exists()
    capsys.readouterr()
    summary = Run(config, tmp_path, Console(), "last").execute()
    assert "episodes of play" not in capsys.readouterr().err, "they are there"
    assert summary["updates"] == 12 and summary["episodes_explored"] == 6
    assert summary["imagined_episodes"] > 0 < summary["imagined_decisions"]
    learnt = load_world(tmp_path / "pretraining" / WORLD_MODEL).learnt
    assert {episode.key for episode in recorded} > set(learnt)
    saved = load_world(tmp_path / "checkpoints" / "last" / WORLD_MODEL).learnt
    assert len(saved) == len(learnt) + 6, "and the real episodes of the run"
