# SPDX-License-Identifier: Apache-2.0
"""Every moment of every worker is in one state; for the asynchronous engine see ``test_launch.py``."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from accerl_lerobot.engines.config import LaunchConfig
from accerl_lerobot.engines.local import LocalEngine
from accerl_lerobot.timeline import Row, Timeline, read_timeline
from tests.runs import drive, tiny_run


def adds_up(timeline: Timeline) -> None:
    """A worker is in one state at a time, and every moment of its processes is in one."""
    for row in timeline.rows:
        whole = int(row.ends[-1] - row.starts[0] - gaps(row).sum())
        assert row.spent((0.0, timeline.seconds + 1.0)).sum() == pytest.approx(whole, rel=1e-9) and whole > 0
    for own in timeline.shares().values():
        assert sum(own.values()) == pytest.approx(1.0)


def gaps(row: Row) -> np.ndarray:
    """Lengths of the times between two processes of a worker."""
    between: np.ndarray = row.starts[1:] - row.ends[:-1]
    assert (between >= 0).all()
    return between[between > 0]


def test_the_engine_in_one_process_is_one_row(tiny_checkpoint: Path, tmp_path: Path) -> None:
    launch = LaunchConfig(engine="local")
    engine = LocalEngine(tiny_run(tiny_checkpoint, output_dir=str(tmp_path), launch=launch), ("match",))
    try:
        engine.train()
        drive(engine)
        engine.save(tmp_path / "saved")
    finally:
        engine.close()
    assert (tmp_path / "episodes.jsonl").stat().st_size
    timeline = read_timeline(tmp_path)
    adds_up(timeline)
    assert [row.worker for row in timeline.rows] == ["local"]
    assert timeline.shares()["local"].keys() == {"recovery", "compute", "wait_in", "checkpoint"}
