# Copyright 2026 The accerl-lerobot authors.
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.
"""A run's numbers on disk: one JSON object a line, the same in TensorBoard, nothing JSON cannot hold."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

from accerl_lerobot.console import Console
from accerl_lerobot.metrics import MetricsLog, WandBConfig


def lines(directory: Path) -> list[dict[str, Any]]:
    def constant(name: str) -> None:
        raise AssertionError(f"{name} is not JSON")

    text = (directory / "metrics.jsonl").read_text().splitlines()
    return [json.loads(line, parse_constant=constant) for line in text]


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
    log.write("train", 2, {"loss": 0.25, "decisions": 130})
    log.close()
    first, second = lines(tmp_path)
    assert first | {"wall_s": 0} == {
        "kind": "train", "wall_s": 0, "update": 1, "loss": 0.5, "decisions": 128
    }  # fmt: skip
    assert second["update"] == 2 and 0 <= first["wall_s"] <= second["wall_s"]
    assert events(tmp_path) == {
        "train/loss": [(1, 0.5), (2, 0.25)],
        "train/decisions": [(1, 128.0), (2, 130.0)],
    }


def test_what_json_does_not_know(tmp_path: Path) -> None:
    log = MetricsLog(tmp_path, WandBConfig(), {})
    values = {
        "nan": float("nan"),
        "inf": np.float32("inf"),
        "single": np.float32(0.5),
        "whole": np.int64(3),
        "yes": np.bool_(True),
        "tasks": {"a": {"ci95": [float("nan"), np.float64(1.0)]}},
        "name": "during-1",
    }
    log.write("evaluation", 7, values)
    log.close()
    (record,) = lines(tmp_path)
    assert record["nan"] is None and record["inf"] is None
    assert (record["single"], record["whole"], record["yes"]) == (0.5, 3, True)
    assert record["tasks"] == {"a": {"ci95": [None, 1.0]}} and record["name"] == "during-1"
    assert events(tmp_path).keys() == {"evaluation/single", "evaluation/whole", "evaluation/yes"}


def test_a_line_is_on_disk_at_once(tmp_path: Path) -> None:
    """Whoever watches a run, or finds it after it was killed, sees all of it."""
    log = MetricsLog(tmp_path, WandBConfig(), {})
    log.write("train", 1, {"loss": 1.0})
    assert len(lines(tmp_path)) == 1
    log.close()


def test_wandb_only_when_enabled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[Any] = []
    run = SimpleNamespace(log=calls.append, finish=lambda: calls.append("finish"))

    def init(**arguments: Any) -> Any:
        calls.append(arguments)
        return run

    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=init))
    log = MetricsLog(tmp_path, WandBConfig(), {"seed": 1})
    log.close()
    assert calls == []
    log = MetricsLog(tmp_path, WandBConfig(enable=True, project="p"), {"seed": 1})
    log.write("train", 4, {"loss": 1.0, "nan": float("nan"), "name": "x"})
    log.close()
    started, logged, finished = calls
    assert started["project"] == "p" and started["config"] == {"seed": 1}
    assert logged == {"train/loss": 1.0, "update": 4} and finished == "finish"


def test_console_without_a_terminal_prints_lines(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("accerl_lerobot.console.PLAIN_EVERY_S", -1.0)
    console = Console()
    with console.stage("SFT", total=10) as stage:
        stage.update(4, "loss 0.5")
    console.say("success [not markup]")
    out, err = capsys.readouterr()
    assert out == ""
    assert "SFT …" in err and "SFT 4/10 loss 0.5" in err and "success [not markup]" in err
