# SPDX-License-Identifier: Apache-2.0
"""Where each episode of a dataset began."""

from __future__ import annotations

from pathlib import Path

import pytest

from accerl_lerobot.checkpoint.safety import Origin
from accerl_lerobot.demos.record import DemosConfig, record_demos
from accerl_lerobot.demos.starts import STARTS, read_starts
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError


def test_a_dataset_that_does_not_say_how_it_began(tmp_path: Path):
    origin, recorded = Origin("dataset.root", "here"), tmp_path / "recorded"
    demos = DemosConfig(episodes=8, failure_share=0.5, processes=1, root=str(recorded), repo_id="a/b")
    record_demos(SimulatedConfig(max_steps=60, hold=25, image_size=16), demos)
    assert {task for task, _ in read_starts(recorded, 8, origin)} == {"match"}
    with pytest.raises(InputError, match="8 pairs|7 pairs"):
        read_starts(recorded, 7, origin)
    with pytest.raises(InputError, match=r"accerl_starts.json: is missing: nobody knows how its episodes"):
        read_starts(tmp_path, 8, origin)
    (tmp_path / "meta").mkdir()
    for content in (
        '{"starts": [["match", -1]]}',
        '{"starts": [["match", true]]}',
        '{"starts": [[1, 1]]}',
        "{}",
    ):
        (tmp_path / STARTS).write_text(content)
        with pytest.raises(InputError, match="1 pairs of a task and a seed"):
            read_starts(tmp_path, 1, origin)
