# SPDX-License-Identifier: Apache-2.0
"""A run's numbers on disk: one JSON object a line, the same in TensorBoard, nothing JSON cannot hold."""

import re
import sys
from contextlib import closing
from pathlib import Path
from unittest.mock import MagicMock, Mock

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

from accerl_lerobot.algorithms import chunk_critic
from accerl_lerobot.engines.config import RunConfig, parse
from accerl_lerobot.inference.batcher import Batcher, merge_metrics
from accerl_lerobot.metrics import MetricsLog, WandBConfig
from accerl_lerobot.run.loop import Loop
from accerl_lerobot.timeline import ROLES, STATES
from accerl_lerobot.world_model.latent import LatentModel
from tests.runs import local_engine, records

ROOT = Path(__file__).parents[1]


def events(directory: Path) -> dict[str, list[tuple[int, float]]]:
    found: dict[str, list[tuple[int, float]]] = {}
    for path in sorted((directory / "tensorboard").iterdir()):
        for event in EventFileLoader(str(path)).Load():
            for value in event.summary.value:
                number = value.tensor.float_val[0] if value.HasField("tensor") else value.simple_value
                found.setdefault(value.tag, []).append((event.step, number))
    return found


def test_each_record_is_a_line_and_an_event(tmp_path: Path) -> None:
    log = MetricsLog(tmp_path, WandBConfig(), {})
    log.write("train", 1, {"loss": 0.5, "decisions": 128})
    assert len(records(tmp_path)) == 1, "on disk at once"
    values = {
        "nan": float("nan"), "inf": np.float32("inf"), "single": np.float32(0.5), "whole": np.int64(3),
        "yes": np.bool_(True), "name": "during-1", "tasks": {"a": {"ci95": [float("nan"), np.float64(1.0)]}},
    }  # fmt: skip
    log.write("evaluation", 7, values)
    log.close()
    first, second = records(tmp_path)
    assert 0 <= first.pop("wall_s") <= second.pop("wall_s")
    assert first == {"kind": "train", "update": 1, "loss": 0.5, "decisions": 128}
    assert second == {
        "kind": "evaluation", "update": 7, "nan": None, "inf": None, "single": 0.5, "whole": 3, "yes": True,
        "name": "during-1", "tasks": {"a": {"ci95": [None, 1.0]}},
    }  # fmt: skip
    train = {"train/loss": [(1, 0.5)], "train/decisions": [(1, 128.0)]}
    of_evaluation = {"single": 0.5, "whole": 3.0, "yes": 1.0}
    assert events(tmp_path) == train | {f"evaluation/{k}": [(7, v)] for k, v in of_evaluation.items()}


def test_wandb_only_when_enabled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    wandb = MagicMock()
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    MetricsLog(tmp_path, WandBConfig(), {"seed": 1}).close()
    assert wandb.mock_calls == []
    log = MetricsLog(tmp_path, WandBConfig(enable=True, project="p"), {"seed": 1})
    log.write("train", 4, {"loss": 1.0, "nan": float("nan"), "name": "x"})
    log.close()
    MetricsLog(tmp_path, WandBConfig(enable=True, project="p"), {"seed": 1}).close()
    started, resumed = (call.kwargs for call in wandb.init.mock_calls if call.kwargs)
    assert started["project"] == "p" and started["config"] == {"seed": 1}
    wandb.init().log.assert_called_once_with({"train/loss": 1.0, "update": 4})
    assert wandb.init().finish.call_count == 2
    assert resumed["id"] == started["id"] and resumed["resume"] == "allow", "one run, gone on with"


def test_a_tracker_that_fails_ends_nothing(tmp_path: Path, monkeypatch, caplog) -> None:
    fails = Mock(side_effect=ConnectionError("the server is away"))
    run = Mock(log=fails, finish=fails)
    monkeypatch.setitem(sys.modules, "wandb", Mock(**{"init.return_value": run}))
    log = MetricsLog(tmp_path, WandBConfig(enable=True), {})
    log.write("train", 1, {"loss": 1.0})
    log.write("train", 2, {"loss": 0.5})
    log.close()
    assert [line["loss"] for line in records(tmp_path)] == [1.0, 0.5] and fails.call_count == 3
    assert [m for m in caplog.messages if "the server is away" in m] == caplog.messages[:1]


def explained(section: str) -> set[str]:
    """Names in the first column of a table of docs/metrics.md."""
    text = (ROOT / "docs" / "metrics.md").read_text()
    body = text.split(f"## `{section}`")[1].split("\n## ")[0]
    cells = [line.split("|")[1] for line in body.splitlines() if line.startswith("| `")]
    return {name for cell in cells for name in re.findall(r"`([a-z_0-9/]+)`", cell)}


def test_every_logged_number_is_explained(tiny_checkpoint: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And nothing is explained that is not logged."""
    monkeypatch.setattr(LatentModel, "first_steps", 1)
    monkeypatch.setattr(chunk_critic, "FIRST_STEPS", 5)
    arguments = [
        "--env.type=simulated", f"--policy.path={tiny_checkpoint}", "--launch.engine=local",
        "--replay.min_decisions=32", "--trainer.batch_decisions=16", "--rollout.environments=4",
    ]  # fmt: skip
    off_policy = [
        "--algorithm.type=chunk_critic", "--algorithm.policy_steps=1", "--world_model.type=latent",
        "--rollout.segment_length=10", "--trainer.value_warmup_updates=0",
    ]  # fmt: skip
    told: set[str] = set()
    # The teacher is measured against successes, and the world model needs some episodes.
    for more, last in ((off_policy, {"distance", "world_model_contrast"}), ([], {"approx_kl"})):
        with closing(local_engine(parse(RunConfig, arguments + more))) as engine:
            engine.train()
            while last - told:
                progress = engine.poll()
                told = told.union(*progress.updates)
    with_ray = {"wait_s", "update_s", "publish_s"}
    of_tdmpc = {"world_model_consistency", "world_model_return"}
    assert explained("train") == (told - {"update"}) | with_ray | of_tdmpc
    rollout = progress.rollout.keys() | {f"replay_{k}" for k in progress.replay}
    served = Batcher(1, 0.0).counts | {"busy_share": 0.0, "version": 0.0}
    rollout |= {"restarts", "success_exploring", "inference_restarts"}
    rollout |= {f"inference_{k}" for k in merge_metrics([served])}
    assert explained("rollout") == rollout | {f"episode_{name}" for name in ("return", "steps", "decisions")}


def test_the_timeline_and_the_summary_are_explained() -> None:
    text = (ROOT / "docs" / "metrics.md").read_text().split("## Timeline")[1].split("\n## ")[0]
    assert set(re.findall(r"`([a-z_]+(?: model|-model learning)?)`", text)) == {*ROLES, *STATES}
    logged = set(Loop._summary(MagicMock(lags=[]), MagicMock(), MagicMock()))
    whens = {f"{name}_{when}" for name in ("success", "n", "ci95", "tasks") for when in ("before", "after")}
    text = (ROOT / "docs" / "metrics.md").read_text().split("## `summary.json`")[1]
    assert whens <= logged and logged - whens == set(re.findall(r"`([a-z_0-9]+)`", text)) - whens
