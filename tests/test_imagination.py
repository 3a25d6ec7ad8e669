# SPDX-License-Identifier: Apache-2.0
"""Runs in which the policy learns from rollouts too, through either engine."""

from __future__ import annotations

import os
import signal
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from accerl_lerobot.engine.imagination import ImaginationWorker, WorldModelLearningWorker

from accerl_lerobot import cli
from accerl_lerobot.checkpoint import snapshot
from accerl_lerobot.checkpoint.layout import TRAINING_STATE
from accerl_lerobot.console import Console
from accerl_lerobot.engine.config import RunConfig
from accerl_lerobot.engine.local import LocalEngine
from accerl_lerobot.engine.loop import Progress
from accerl_lerobot.engine.run import Run
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.experience import IMAGINED, REAL, Segment
from accerl_lerobot.rollout.runner import RolloutConfig
from accerl_lerobot.timeline.read import read_timeline
from accerl_lerobot.trainer.config import TrainerConfig
from accerl_lerobot.world_model.config import (
    ImaginationConfig,
    OnlineLearnConfig,
    PixelModelConfig,
    ValidationConfig,
    WorldModelConfig,
)
from accerl_lerobot.world_model.learners import new_success_model
from accerl_lerobot.world_model.pixels import PixelWorldModel
from accerl_lerobot.world_model.pretrain import world_spec
from accerl_lerobot.world_model.store import save_world_model
from tests.policies.checkpoints import write_diffusion
from tests.runs import adjusted, drive, polls, tiny_run

# About half of all episodes succeed when it is acted at random.
ENV = SimulatedConfig(max_steps=16, hold=8, tolerance=0.45)
LOOSE = ValidationConfig(
    skill_first=-1e9, skill_last=-1e9, sensitivity=0.0, auroc=-1.0, false_success=1.0, recall=-1.0,
    stride=4, max_windows=40,
)  # fmt: skip
CONSTANTS = ("window", "min_real_episodes", "max_gap")


def learning(validate_every: int = 2, held_out: float = 0.4, validation: ValidationConfig = LOOSE) -> Any:
    """A world model that is trained in the run, and validated after so many episodes."""
    constants = {"validate_every": validate_every, "held_out": held_out, "validation": validation}
    return adjusted(OnlineLearnConfig, **constants)(steps_per_episode=1.0)


@pytest.fixture(scope="module")
def world_model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A new one, which has learnt nothing."""
    torch.manual_seed(0)
    config = PixelModelConfig(channels=(8, 8))
    spec = world_spec(WorldModelConfig(chunk=4, image_size=32, model=config), ENV)
    folder = tmp_path_factory.mktemp("environment") / "world_model"
    save_world_model(folder, PixelWorldModel(spec, config), new_success_model(4))
    return folder


def imagining(
    checkpoint: Path, *, episodes: int = 6, sections: dict[str, Any] | None = None, **config: Any
) -> RunConfig:
    constants: dict[str, Any] = {"window": 10_000, "samples_per_insert": 1.0, "rollouts": 4}
    constants |= {name: config.pop(name) for name in CONSTANTS if name in config}
    fields: dict[str, Any] = {"share": 0.5}
    return tiny_run(
        checkpoint,
        env=ENV,
        imagination=adjusted(ImaginationConfig, **constants)(**(fields | config)),
        rollout=RolloutConfig(environments=4, segment_length=4, episodes=episodes),
        trainer=TrainerConfig(updates=12, batch_decisions=16, warmup_updates=2, value_warmup_updates=2),
        **(sections or {}),
    )


def run_locally(config: RunConfig) -> tuple[list[Progress], list[list[Segment]], LocalEngine]:
    """A run in one process: what was reported, the batches that were learnt from, and the engine."""
    engine = LocalEngine(config, ("match",))
    batches: list[list[Segment]] = []
    step = engine._update.step
    engine._update.step = lambda segments: batches.append(segments) or step(segments)  # type: ignore
    engine.train()
    history = drive(engine)
    engine.close()
    return history, batches, engine


def decisions(segments: list[Segment], source: str) -> int:
    return sum(len(s) for s in segments if s.source == source)


def test_half_of_what_is_learned_from_is_imagined(tiny_checkpoint: Path):
    history, batches, _ = run_locally(imagining(tiny_checkpoint, model="oracle", episodes=0))
    assert len(batches) == 12
    for batch in batches:
        assert 8 <= decisions(batch, REAL) < 8 + 4 and 8 <= decisions(batch, IMAGINED) < 8 + 4
        for segment in batch:
            imagined = segment.source == IMAGINED
            assert segment.key.startswith("imagination." if imagined else "local.")
            assert (segment.world_version is not None) is imagined
    assert history[-1].imagination["rollouts"] > 20 and history[-1].imagination["on"] == 1


def test_when_the_real_episodes_have_been_played_imagination_goes_on(tiny_checkpoint: Path):
    history, batches, engine = run_locally(imagining(tiny_checkpoint, model="oracle"))
    explored = [e for p in history for e in p.episodes if e.plan.explore]
    assert len(explored) == 6 and history[-1].rollout["episodes"] == 6
    real = [decisions(b, REAL) for b in batches]
    assert len(batches) == 12 and real[-1] == 0 and real[0] >= 8
    assert all(len(b) and decisions(b, REAL) + decisions(b, IMAGINED) >= 16 for b in batches)
    books = history[-1].replay
    assert books["trained_decisions"] == sum(real)
    assert books["imagined_trained_decisions"] == sum(decisions(b, IMAGINED) for b in batches)
    assert real and sum(real) <= 2 * books["inserted_decisions"], "as often as samples_per_insert says"
    assert engine._replay.real_ended


def test_without_imagination_a_run_ends_when_its_episodes_are_used_up(tiny_checkpoint: Path):
    config = imagining(tiny_checkpoint, share=0.0)
    history, batches, _ = run_locally(config)
    assert history[-1].done and 0 < len(batches) < 12
    books = history[-1].replay
    assert books["available_decisions"] < 16 and history[-1].imagination == {}


def test_two_runs_are_equal_to_the_last_bit(tiny_checkpoint: Path, world_model: Path):
    learn = learning()
    config = imagining(tiny_checkpoint, path=str(world_model), learn=learn, episodes=24)
    runs = [run_locally(config) for _ in range(2)]
    one, other = ([u for p in history for u in p.updates] for history, _, _ in runs)
    assert len(one) == 12 and one == other
    ends = [history[-1].imagination for history, _, _ in runs]
    assert ends[0] == pytest.approx(ends[1], rel=0, abs=0, nan_ok=True)
    for key, tensor in runs[0][2]._adapter.export_trainable().items():
        np.testing.assert_array_equal(tensor, runs[1][2]._adapter.export_trainable()[key])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "left_at"), [("learned", 0.1), ("learned", 0.6), ("shuffled", 0.8), ("oracle", 0.6)]
)
def test_a_run_that_was_left_goes_on_as_if_it_had_not(
    model: str, left_at: float, tiny_checkpoint: Path, world_model: Path, tmp_path: Path
):
    """Rollouts, world model and success model included."""
    learn = learning(validate_every=8, held_out=0.5)
    chosen: dict[str, Any] = {"model": model, "window": 4, "max_gap": 2.0}
    chosen["min_real_episodes"] = 2
    if model != "oracle":
        chosen |= {"path": str(world_model), "learn": learn}
    config = imagining(tiny_checkpoint, episodes=24, **chosen)

    def told(history: list[Progress]) -> list[Any]:
        return [[u for p in history for u in p.updates], history[-1].rollout, history[-1].replay]

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
    assert len(whole) == len(before) + len(after) and len(after) > 1 and whole[-1].imagination["rollouts"] > 8
    assert told(before + after) == told(whole)
    ends = [history[-1].imagination for history in (whole, after)]
    assert ends[0] == pytest.approx(ends[1], rel=0, abs=0, nan_ok=True)
    for key, tensor in expected._adapter.export_trainable().items():
        np.testing.assert_array_equal(tensor, again._adapter.export_trainable()[key])
    promoted = before[-1].imagination.get("promoted", 0) > 0
    assert (tmp_path / "world_model" / "model.safetensors").is_file() is promoted


@pytest.mark.slow
def test_nothing_is_imagined_before_the_model_has_passed(tiny_checkpoint: Path, world_model: Path):
    learn = learning()
    history, batches, _ = run_locally(
        imagining(tiny_checkpoint, path=str(world_model), learn=learn, episodes=24)
    )
    imagined = [p.imagination["rollouts"] for p in history]
    passed = [p.imagination["promoted"] for p in history]
    first = next(i for i, n in enumerate(passed) if n)
    assert imagined[first - 1] == 0 < imagined[-1]
    versions = {s.world_version for b in batches for s in b if s.source == IMAGINED}
    assert versions and 0 not in versions, "the one it began with never imagined"
    strict = learning(validation=replace(LOOSE, sensitivity=1e9))
    history, batches, _ = run_locally(imagining(tiny_checkpoint, path=str(world_model), learn=strict))
    assert history[-1].imagination["rejected"] >= 2 and history[-1].imagination["rollouts"] == 0
    assert 0 < len(batches) < 12 and not any(decisions(b, IMAGINED) for b in batches)


@pytest.mark.slow
def test_it_runs_asynchronously(tiny_checkpoint: Path, world_model: Path, tmp_path: Path):
    from accerl_lerobot.engine.launch import RayEngine

    n = 20  # of these 8 are held out; of 12 episodes at times only failures were, and no model could pass
    config = imagining(tiny_checkpoint, path=str(world_model), learn=learning(), episodes=n)
    trainer = replace(config.trainer, updates=n)
    config = replace(config, rollout=replace(config.rollout, workers=2), trainer=trainer)
    engine = RayEngine(replace(config, output_dir=str(tmp_path)), ("match",))
    try:
        pids = engine.pids()
        assert {"imagination", "world-model learning"} < set(pids)
        engine.train()
        history: list[Progress] = []
        for progress in polls(engine):
            history.append(progress)
            if progress.replay["inserted_segments"] > 0:  # what imagines from then on finds the next one, too
                os.kill(pids["inference"], signal.SIGKILL)
                history += drive(engine)
                break
        engine.save(tmp_path / "saved")
    finally:
        engine.close()
    last = history[-1]
    assert last.inference["restarts"] == 1.0
    assert last.version == n == len([u for p in history for u in p.updates])
    assert sum(e.plan.explore for p in history for e in p.episodes) == n
    assert last.imagination["promoted"] >= 1 and last.imagination["rollouts"] > 0
    assert last.imagination["learn_episodes"] >= 5
    assert last.replay["imagined_trained_decisions"] > 0 < last.replay["trained_decisions"]
    assert last.replay["inserted_segments"] >= n
    explained = (Path(__file__).parents[1] / "docs" / "metrics.md").read_text()
    for name in last.imagination:
        assert f"`imagination_{name}`" in explained or name.startswith("check_"), name
    spent = read_timeline(tmp_path).shares()
    assert {"recovery", "compute", "transport", "wait_in"} <= spent["imagination"].keys()
    assert len(list((tmp_path / "timeline").glob("imagination*"))) == 1
    saved = snapshot.load(tmp_path / "saved" / TRAINING_STATE / "imagination")["core"]
    assert len(saved["rows"]) == 4 and saved["counters"]["decisions"] >= last.imagination["decisions"]
    assert {"recovery", "compute", "transport", "wait_in"} <= spent["world-model learning"].keys()


@pytest.mark.parametrize("kind", [ImaginationWorker, WorldModelLearningWorker])
def test_one_that_hangs_is_found_when_it_is_saved(kind: type, tmp_path: Path):
    """And not after the minutes that large files may take; `benchmarks.faults` does it to a whole run."""
    worker, held = object.__new__(kind), threading.Lock()
    worker._limit, worker._promoted, worker._changing = 1.0, "something that nobody takes over", held
    message = f"{kind.step_name} has not ended for \\d s or more; raise launch.stall_s"  # type: ignore[attr-defined]
    with held, pytest.raises(TimeoutError, match=message):
        worker.save(tmp_path)
    assert not held.locked()


def test_what_does_not_fit_is_refused_before_the_run_begins(
    tiny_checkpoint: Path, world_model: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    def told(*options: str, share: float = 0.5) -> str:
        arguments = [
            "train", "--env.type=simulated", f"--policy.path={tiny_checkpoint}",
            f"--imagination.share={share}", f"--output_dir={tmp_path / 'out'}", *options,
        ]  # fmt: skip
        assert cli.main(arguments) == 2
        return capsys.readouterr().err

    assert "imagination.path=None: give the folder world_model" in told()
    assert "imagination.path='nowhere': config.json: is missing" in told("--imagination.path=nowhere")
    paid = told(f"--imagination.path={world_model}", "--env.reward=dense")
    assert "env.reward='dense': use success with imagination.share" in paid
    for model in ("learned", "oracle"):
        seen = told(
            f"--imagination.path={world_model}",
            f"--imagination.model={model}",
            "--env.environment_state=true",
        )
        assert "env.environment_state=True: no policy reads it, and nothing imagined has it" in seen
    few = told(f"--imagination.path={world_model}", "--rollout.episodes=4")
    assert "rollout.episodes=4: none is held out, so no world model can pass: use at least 5" in few
    whole = told("--imagination.model=oracle", share=0.999)
    assert "imagination.share=0.999: that is 128 of the trainer.batch_decisions=128; leave both some" in whole
    looks = told(f"--imagination.path={world_model}", "--env.image_size=32", "--policy.n_action_steps=2")
    assert "executes 2 actions per decision; train one with world_model.chunk=2" in looks
    tiny_checkpoint = write_diffusion(tmp_path / "back", image=32, n_obs_steps=2)
    history = told("--imagination.model=oracle")
    assert "policy.n_obs_steps=2: the policy looks back so many env steps" in history
    assert not (tmp_path / "out" / "checkpoints").exists()


def test_the_summary_says_what_was_imagined(tiny_checkpoint: Path, tmp_path: Path):
    config = imagining(tiny_checkpoint, model="oracle")
    config = replace(config, launch=replace(config.launch, engine="local"))
    summary = Run(config, tmp_path, Console()).execute()
    assert summary["episodes_explored"] == 6 and summary["imagination"]["decisions"] > 0
    assert summary["updates"] == 12
