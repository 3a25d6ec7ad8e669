# SPDX-License-Identifier: Apache-2.0
"""Which threshold each source is judged by, and which gates count."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from accerl_lerobot.console import Console
from accerl_lerobot.demos.record import DemosConfig, record_demos
from accerl_lerobot.engine.config import DatasetConfig
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model import sources
from accerl_lerobot.world_model.config import NetworkConfig, PixelModelConfig, TrialConfig, WorldModelConfig
from accerl_lerobot.world_model.offline import world_spec
from accerl_lerobot.world_model.sources import HELD_OUT, ONLINE, open_rooms, try_sources

SAVED, SET = 0.8, 0.6


class Tried:
    """In place of a trial: what each source was judged by, in order."""

    def __init__(self) -> None:
        self.judged: list[tuple[str, float, bool]] = []

    def __call__(
        self, model: Any, episodes: Any, config: Any, success: Any, seed: int, fresh: bool
    ) -> dict[str, Any]:
        self.judged.append((episodes, success.config.threshold, fresh))
        if fresh:
            success.config.threshold = SET
        gate = {"value": 1.0, "wanted": "above 0", "holds": episodes != "fails"}
        return {"gates": {"skill": gate}, "passed": gate["holds"], "threshold": success.config.threshold}


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> Tried:
    tried = Tried()
    monkeypatch.setattr(sources, "try_out", tried)
    monkeypatch.setattr(sources, "film", lambda path, *_: path.write_bytes(b"film"))
    monkeypatch.setattr(sources, "amount", lambda episodes: {"episodes": 1})
    return tried


def told(tmp_path: Path, of: dict[str, Any], **options: Any) -> tuple[dict[str, Any], float]:
    success: Any = SimpleNamespace(config=SimpleNamespace(threshold=SAVED))
    found = try_sources(
        None, of, TrialConfig(), success, tmp_path, Console(), **options  # type: ignore[arg-type]
    )  # fmt: skip
    return found, success.config.threshold


def test_what_is_set_on_a_policys_episodes_is_kept_and_judges_the_others(tried: Tried, tmp_path: Path):
    """They come first then, but in what is told the first stays the first."""
    of = {HELD_OUT: "demos", ONLINE: "policy's"}
    found, threshold = told(tmp_path, of, learnt=of, fresh=ONLINE, kept=True)
    assert threshold == SET
    assert tried.judged == [
        ("policy's", SAVED, True),
        ("demos", SET, False),
    ]
    assert found["name"] == HELD_OUT and list(found["sources"]) == [ONLINE]
    assert {path.name for path in tmp_path.iterdir()} == {"preview.mp4", "preview_online.mp4"}


def test_a_threshold_that_was_saved_is_only_set_anew_where_it_comes_from(tried: Tried, tmp_path: Path):
    of = {HELD_OUT: "demos", ONLINE: "another policy's", "perturbed": "again"}
    found, threshold = told(tmp_path, of, learnt=[HELD_OUT], fresh=HELD_OUT)
    assert threshold == SAVED and found["threshold"] == SET
    assert tried.judged == [
        ("demos", SAVED, True),
        ("another policy's", SAVED, False),
        ("again", SAVED, False),
    ]


def test_gates_of_what_it_has_learnt_from_count(tried: Tried, tmp_path: Path):
    of = {HELD_OUT: "demos", ONLINE: "fails"}
    found, _ = told(tmp_path, of, learnt=of)
    assert not found["passed"] and {k: g["holds"] for k, g in found["gates"].items()} == {
        "skill": True, "online.skill": False,
    }  # fmt: skip
    found, _ = told(tmp_path, of, learnt=[HELD_OUT])
    assert found["passed"] and list(found["gates"]) == ["skill"]


def test_a_dataset_is_known_by_the_order_of_its_episodes_too(tmp_path: Path):
    env = SimulatedConfig(max_steps=60, hold=25, image_size=16)

    def recorded(name: str, seed: int) -> DatasetConfig:
        of = DemosConfig(
            episodes=3, failure_share=0.5, processes=1, root=str(tmp_path / name), repo_id="a/b", seed=seed
        )
        return DatasetConfig(repo_id="a/b", root=str(record_demos(env, of)))

    config = WorldModelConfig(image_size=16, model=PixelModelConfig(network=NetworkConfig(channels=(16, 24))))
    spec = world_spec(config, env)
    one, other = recorded("one", 0), recorded("other", 1)
    opened = open_rooms({"dataset": one, "online": other}, spec)
    assert [meta.total_episodes for meta in opened.values()] == [3, 3]
    meta = opened["dataset"]
    ends = {key: list(meta.episodes[key]) for key in ("dataset_from_index", "dataset_to_index")}
    turned = SimpleNamespace(stats=meta.stats, fps=meta.fps, episodes=ends)
    assert sources.fingerprint(turned) == sources.fingerprint(meta)
    ends["dataset_to_index"][0] += 1
    ends["dataset_from_index"][1] += 1
    assert sources.fingerprint(turned) != sources.fingerprint(opened["dataset"])
    with pytest.raises(InputError, match="^online.repo_id='a/b': it is the one in dataset; name another"):
        open_rooms({"dataset": one, "online": one}, spec)
    with pytest.raises(InputError, match="^online.root='nowhere': no meta/info.json there"):
        open_rooms({"dataset": one, "online": DatasetConfig(repo_id="a/b", root="nowhere")}, spec)
