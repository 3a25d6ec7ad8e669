# SPDX-License-Identifier: Apache-2.0
"""Runs in which rollout workers step imagined environments too, through either engine."""

import importlib
import itertools
import os
import signal
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch

from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.algorithms.ratio_update import RatioUpdate
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import TRAINING_STATE, WORLD_MODEL
from accerl_lerobot.console import Console
from accerl_lerobot.engines import Progress
from accerl_lerobot.engines.config import DatasetConfig, RunConfig
from accerl_lerobot.engines.local import LocalEngine
from accerl_lerobot.envs import SimulatedConfig, make_environment
from accerl_lerobot.errors import InputError
from accerl_lerobot.experience import IMAGINED, REAL, Segment
from accerl_lerobot.rollout.runner import EpisodePlans, RolloutConfig
from accerl_lerobot.rollout.worker import RolloutWorker
from accerl_lerobot.run.train import Run
from accerl_lerobot.timeline import read_timeline
from accerl_lerobot.world_model.config import (
    ImaginationConfig,
    LearnableModelConfig,
    OnlineLearnConfig,
    PixelModelConfig,
)
from accerl_lerobot.world_model.contract import WorldModelSpec, load_episodes
from accerl_lerobot.world_model.imagined import check_imagination, load_world, new_world, save_world
from accerl_lerobot.world_model.training import ONLINE, make_trainer
from tests.policies.checkpoints import write_diffusion
from tests.runs import drive, local_engine, polls, tiny_run, trained, updates
from tests.tiny_datasets import one_process, record_dataset

# About half of all episodes succeed when it is acted at random.
ENV = SimulatedConfig(max_steps=16, hold=8, tolerance=0.45)


SPEC = WorldModelSpec(
    cameras=("observation.images.front",), image_size=(32, 32), state_dim=4, action_dim=2, chunk=4, fps=80,
)  # fmt: skip


def saved_world(folder: Path, config: LearnableModelConfig, **content: Any) -> Path:
    """A world that has learnt nothing."""
    torch.manual_seed(0)
    save_world(folder, new_world(SPEC, config, tasks=["Match the target"], **content))
    return folder


@pytest.fixture(scope="module")
def world_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return saved_world(tmp_path_factory.mktemp("world") / "world_model", PixelModelConfig(channels=(8, 8)))


def imagining(
    checkpoint: Path, path: Path | None, *, episodes: int = 6, steps: float = 1.0, environments: int = 4
) -> RunConfig:
    imagination = ImaginationConfig(
        environments=environments if path else 0,
        path=None if path is None else str(path),
        learn=OnlineLearnConfig(steps_per_episode=steps),
    )
    return tiny_run(
        checkpoint,
        env=ENV,
        imagination=imagination,
        rollout=RolloutConfig(environments=4, segment_length=4, episodes=episodes),
        trainer=TrainerConfig(updates=12, batch_decisions=16, warmup_updates=2, value_warmup_updates=2),
    )


Played = tuple[list[Progress], list[list[Segment]], LocalEngine]


def run_locally(config: RunConfig) -> Played:
    """A run in one process: what was reported, the batches that were learnt from, and the engine."""
    batches: list[list[Segment]] = []
    step = RatioUpdate.step

    def noted(update: RatioUpdate, batch: list[Segment]) -> dict[str, float]:
        batches.append(batch)
        return step(update, batch)

    with mock.patch.object(RatioUpdate, "step", noted):
        history, engine = trained(config)
    return history, batches, engine


def decisions(segments: list[Segment], source: str) -> int:
    return sum(len(s) for s in segments if s.source == source)


@pytest.fixture(scope="module")
def played(tiny_checkpoint: Path, world_model: Path) -> Played:
    return run_locally(imagining(tiny_checkpoint, world_model))


def test_once_the_real_episodes_are_played_all_is_imagined(played: Played):
    history, batches, _ = played
    ended = [e for p in history for e in p.episodes]
    real, imagined = ([e for e in ended if e.plan.source == source] for source in (REAL, IMAGINED))
    counters, replay = history[-1].rollout, history[-1].replay
    assert len(real) == 6 == counters["episodes"] and len(imagined) == counters["imagined_episodes"] > 6
    assert counters["decisions"] == sum(e.decisions for e in real)
    assert counters["imagined_decisions"] >= sum(e.decisions for e in imagined)
    assert len(batches) == 12 and decisions(batches[-1], REAL) == 0 < decisions(batches[0], REAL)
    assert replay["trained_imagined"] == sum(decisions(batch, IMAGINED) for batch in batches)
    assert replay["trained_decisions"] == sum(len(s) for batch in batches for s in batch)
    assert history[-1].world_model["learn_episodes"] == 6 == history[-1].world_model["learn_steps"]


def test_imagined_episodes_begin_where_real_ones_did(played: Played):
    firsts: dict[str, set[bytes]] = {REAL: set(), IMAGINED: set()}
    for segment in itertools.chain(*played[1]):
        if segment.origin.decision == 0:
            firsts[segment.source].add(segment.observations["observation.images.front"][0].tobytes())
    assert firsts[IMAGINED] and firsts[IMAGINED] <= firsts[REAL]


def test_without_imagination_a_run_ends_when_its_episodes_are_used_up(tiny_checkpoint: Path):
    history, batches, _ = run_locally(imagining(tiny_checkpoint, None))
    assert history[-1].done and 0 < len(batches) < 12
    assert history[-1].replay["available_decisions"] < 16 and history[-1].world_model == {}


def test_two_runs_are_equal_to_the_last_bit(played: Played, tiny_checkpoint: Path, world_model: Path):
    again = run_locally(imagining(tiny_checkpoint, world_model))
    one, other = (updates(history) for history, _, _ in (played, again))
    assert len(one) == 12 and one == other
    assert played[0][-1].world_model == again[0][-1].world_model
    for key, tensor in played[2]._adapter.export_trainable().items():
        np.testing.assert_array_equal(tensor, again[2]._adapter.export_trainable()[key])


@pytest.mark.slow
@pytest.mark.parametrize(("steps", "left_at"), [(3.0, 0.5), (0.0, 0.7)])
def test_a_run_that_was_left_goes_on_as_if_it_had_not(
    steps: float, left_at: float, tiny_checkpoint: Path, world_model: Path, tmp_path: Path
):
    """Imagined episodes and the world model's training included."""
    config = imagining(tiny_checkpoint, world_model, episodes=12, steps=steps)

    def reported(history: list[Progress]) -> list[Any]:
        last = history[-1]
        return [updates(history), last.rollout, last.replay, last.world_model]

    whole, _, expected = run_locally(config)
    first = LocalEngine(config, ("match",))
    first.train()
    before = [first.poll() for _ in range(round(left_at * len(whole)))]
    first.save(tmp_path)
    first.close()
    again = LocalEngine(config, ("match",), state=tmp_path / "training_state")
    again.train()
    after = drive(again)
    again.close()
    assert len(whole) == len(before) + len(after) and len(after) > 1
    assert reported(before + after) == reported(whole) and whole[-1].rollout["imagined_episodes"] > 8
    for key, tensor in expected._adapter.export_trainable().items():
        np.testing.assert_array_equal(tensor, again._adapter.export_trainable()[key])
    assert (tmp_path / "world_model" / "model.safetensors").is_file() is (steps > 0)


@pytest.mark.slow
def test_it_runs_asynchronously(tiny_checkpoint: Path, world_model: Path, tmp_path: Path):
    from accerl_lerobot.engines.ray_engine import RayEngine

    n = 80  # so many that some are left when the process is missed, on a busy machine too
    config = imagining(tiny_checkpoint, world_model, episodes=20)
    trainer = replace(config.trainer, updates=n)
    config = replace(config, rollout=replace(config.rollout, workers=2), trainer=trainer)
    engine = RayEngine(replace(config, output_dir=str(tmp_path)), ("match",))
    try:
        pids = engine.pids()
        assert "world-model learning" in set(pids)
        engine.train()
        history: list[Progress] = []
        for progress in polls(engine):
            history.append(progress)
            if progress.replay["inserted_segments"] > 0:
                os.kill(pids["rollout 0"], signal.SIGKILL)
                history += drive(engine)
                break
        engine.save(tmp_path / "saved")
    finally:
        engine.close()
    last = history[-1]
    assert last.rollout["restarts"] == 1.0
    assert last.version == n == len(updates(history))
    assert 0 < sum(e.plan.source == REAL for p in history for e in p.episodes) <= 20, "it ends by its updates"
    assert last.world_model["learn_episodes"] > 0 and last.world_model["version"] > 0
    assert 0 < last.replay["trained_imagined"] < last.replay["trained_decisions"]
    explained = (Path(__file__).parents[1] / "docs" / "metrics.md").read_text()
    for name in last.world_model:
        assert f"`world_model_{name}`" in explained, name
    spent = read_timeline(tmp_path).shares()
    assert {"compute", "wait_in"} <= spent["world-model learning"].keys()
    saved = snapshot.load(tmp_path / "saved" / TRAINING_STATE / ONLINE)
    assert saved["version"] >= last.world_model["learn_steps"]


def test_what_does_not_fit_is_refused_before_the_run_begins(
    tiny_checkpoint: Path, world_model: Path, tmp_path: Path
):
    config = imagining(tiny_checkpoint, world_model)
    nowhere = replace(config.imagination, path="nowhere")
    back = str(write_diffusion(tmp_path / "back", image=32, n_obs_steps=2))
    for changed, line in (
        (replace(config, env=replace(ENV, reward="dense")), "env.reward='dense': use success with"),
        (replace(config, env=replace(ENV, environment_state=True)), "state=True: no policy reads it"),
        (replace(config, policy=replace(config.policy, n_action_steps=2)), "chunk, and this run's is 2"),
        (replace(config, rollout=replace(config.rollout, segment_length=3)), "length=3: use 4 or more"),
        (replace(config, policy=replace(config.policy, path=back)), "policy.n_obs_steps=2: the policy looks"),
        (replace(config, imagination=nowhere), "imagination.path='nowhere': config.json: is missing"),
    ):
        with pytest.raises(InputError, match=line):
            check_imagination(changed)
    with pytest.raises(InputError, match=r"rollout\.episodes=2: use at least 4: each rollout worker needs"):
        replace(config, rollout=replace(config.rollout, workers=4, episodes=2))


def test_it_goes_on_with_what_it_has_learned_from_and_never_with_what_was_held_out(
    tiny_checkpoint: Path, tmp_path: Path
):
    dataset = record_dataset(tmp_path / "demos", ENV, episodes=6, failure_share=0.5)
    keys = [episode.key for episode in load_episodes(dataset, SPEC)]

    def with_dataset(learnt: list[str], **changes: str) -> RunConfig:
        path = saved_world(tmp_path / learnt[0], PixelModelConfig(channels=(8, 8)), learnt=learnt)
        config = imagining(tiny_checkpoint, path)
        learn = replace(config.imagination.learn, dataset=replace(dataset, **changes))
        return replace(config, imagination=replace(config.imagination, learn=learn))

    trainer = make_trainer(with_dataset(keys[1:4]))
    assert list(dict.fromkeys(start.episode.key for start in trainer._recorded)) == keys[1:4]
    with pytest.raises(InputError, match=r"^imagination\.learn\.dataset\.repo_id='a/b': the world"):
        make_trainer(with_dataset(["elsewhere"]))
    with pytest.raises(InputError, match=r"^imagination\.learn\.dataset\.root='nowhere': no meta/info.json"):
        check_imagination(with_dataset(keys[:1], root="nowhere"))


def test_a_run_warns_of_a_world_model_that_has_failed_a_check(
    tiny_checkpoint: Path, world_model: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    check_imagination(imagining(tiny_checkpoint, world_model))
    assert not caplog.messages
    path = saved_world(tmp_path / "w", PixelModelConfig(channels=(8, 8)), failed_checks=["auroc"])
    check_imagination(imagining(tiny_checkpoint, path))
    assert [text for text in caplog.messages if "failed checks (auroc)" in text]


def test_a_world_model_of_another_package_imagines_and_goes_on_learning(
    tiny_checkpoint: Path, tmp_path: Path
):
    package = "tests.world_model.linear_world"
    linear = importlib.import_module(package).LinearModelConfig
    path = saved_world(tmp_path / "w", linear(gain=3.0))
    LearnableModelConfig.get_known_choices().pop("linear")
    sys.modules.pop(package)
    config = imagining(tiny_checkpoint, path, episodes=24)
    config = replace(config, imagination=replace(config.imagination, discover_packages_path=package))
    running = local_engine(config)
    running.train()
    last = drive(running)[-1]
    running.save(tmp_path / "saved")
    running.close()
    assert last.world_model["learn_steps"] > 0 < last.replay["trained_imagined"]
    before, after = load_world(path, package), load_world(tmp_path / "saved" / WORLD_MODEL)
    moved = after.get_parameter("model.motion.weight") - before.get_parameter("model.motion.weight")
    assert float(moved.abs().max()) > 0


@pytest.mark.slow
def test_one_command_records_play_trains_a_world_model_on_it_and_practises(
    tiny_checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """Stopped after a part, it goes on with the next one."""
    config = imagining(tiny_checkpoint, None, environments=4)
    play = ImaginationConfig(
        environments=4, policy_episodes=8, expert_episodes=8, steps=30,
        learn=OnlineLearnConfig(steps_per_episode=1),
    )  # fmt: skip
    launch = replace(config.launch, engine="local")
    config = replace(config, imagination=play, launch=launch, env=replace(ENV, image_size=32))
    stopped = mock.patch("accerl_lerobot.run.play.pretrain", side_effect=KeyboardInterrupt)
    with one_process(), stopped, pytest.raises(KeyboardInterrupt):
        Run(config, tmp_path, Console()).execute()
    recorded = load_episodes(DatasetConfig(repo_id="a/b", root=str(tmp_path / "play")), SPEC)
    assert len(recorded) == 16 and {episode.success for episode in recorded} == {True, False}
    assert not (tmp_path / "pretraining").exists()
    capsys.readouterr()
    summary = Run(config, tmp_path, Console(), "last").execute()
    assert "episodes of play" not in capsys.readouterr().err, "they are there"
    assert summary["updates"] == 12 and summary["imagined_episodes"] > 0
    assert summary["episodes_explored"] == 6 and summary["imagined_decisions"] > 0
    learnt = load_world(tmp_path / "pretraining" / "world_model").learnt
    assert {episode.key for episode in recorded} > set(learnt)
    saved = load_world(tmp_path / "checkpoints" / "last" / WORLD_MODEL).learnt
    assert len(saved) == len(learnt) + 6, "and the real episodes of the run"


def test_a_process_that_takes_anothers_place_imagines_from_its_episodes(world_model: Path):
    """Although its real episodes have all been played, and it has seen none of them."""
    imagination = ImaginationConfig(environments=1, path=str(world_model))
    worker = RolloutWorker(ENV, RolloutConfig(environments=1), imagination=imagination)
    worker.ready(EpisodePlans(("match",), 0, budget=0), [("match", 5)])
    worker.report(True, [])
    plan = worker._plans.next(IMAGINED, worker._starts)
    assert worker._plans.next(REAL, worker._starts) is None and plan is not None and plan.task == "match"
    first, real = worker._environments[1].reset(plan.seed, "match"), make_environment(ENV).reset(5, "match")
    assert np.array_equal(first["observation.images.front"], real["observation.images.front"])
