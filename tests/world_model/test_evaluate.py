# SPDX-License-Identifier: Apache-2.0
"""``accerl world-model-eval`` on several sources, and episodes that are played again."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from accerl_lerobot import cli
from accerl_lerobot.checkpoint.safety import Origin
from accerl_lerobot.demos.record import DemosConfig, record_demos
from accerl_lerobot.demos.starts import STARTS, read_starts
from accerl_lerobot.demos.windows import open_metadata
from accerl_lerobot.engine.config import DatasetConfig
from accerl_lerobot.envs import SimulatedConfig, make_world
from accerl_lerobot.errors import InputError
from accerl_lerobot.world_model import evaluate
from accerl_lerobot.world_model.by_source import source_rows
from accerl_lerobot.world_model.config import (
    NetworkConfig,
    PerturbedConfig,
    PixelModelConfig,
    WorldModelConfig,
)
from accerl_lerobot.world_model.dataset import fingerprint, load_episodes
from accerl_lerobot.world_model.episodes import Episode
from accerl_lerobot.world_model.offline import world_spec
from accerl_lerobot.world_model.perturbed import check_world, perturbed, perturbed_episodes
from accerl_lerobot.world_model.pixels import PixelWorldModel
from accerl_lerobot.world_model.store import Source, save_world_model
from accerl_lerobot.world_model.success import new_success_model
from tests.rounding import assert_close
from tests.runs import replacing
from tests.world_model.test_learn_device import moved

ENV = SimulatedConfig(max_steps=60, hold=25, image_size=16)
CONFIG = WorldModelConfig(
    image_size=16,
    chunk=5,
    model=PixelModelConfig(network=NetworkConfig(channels=(8, 8), condition=8, planes=2)),
)
TOLD = ["--env.type=simulated", "--env.image_size=16", "--env.hold=25", "--env.max_steps=60"]


def recorded(folder: Path, seed: int) -> Path:
    episodes = DemosConfig(
        episodes=8, failure_share=0.5, processes=1, root=str(folder), repo_id="a/b", seed=seed
    )
    return record_demos(ENV, episodes)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """Demonstrations, a world model that has learnt from some of them (nothing yet), and other episodes."""
    root = tmp_path_factory.mktemp("evaluated")
    demos, others = recorded(root / "demos", 0), recorded(root / "others", 1)
    torch.manual_seed(0)
    print_ = fingerprint(open_metadata(DatasetConfig(repo_id="a/b", root=str(demos))))
    source = Source(repo_id="a/b", fingerprint=print_, learnt=(0, 1, 2, 3), held_out=(4, 5, 6, 7))
    spec = world_spec(CONFIG, ENV)
    save_world_model(root / "model", PixelWorldModel(spec, CONFIG.model), new_success_model(5), [source])
    return demos, root / "model", others


def episodes_of(folder: Path) -> list[Episode]:
    return load_episodes(DatasetConfig(repo_id="a/b", root=str(folder)), world_spec(CONFIG, ENV))


def told(folders: tuple[Path, Path, Path], out: Path, *more: str) -> list[str]:
    demos, model, _ = folders
    return [
        "world-model-eval", f"--path={model}", "--dataset.repo_id=a/b", f"--dataset.root={demos}",
        f"--output_dir={out}", "--trial.depth=2", "--inverse.steps=5", *more,
    ]  # fmt: skip


def test_the_same_measures_on_every_source(
    folders: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    out = tmp_path / "out"
    more = ["--online.repo_id=a/b", f"--online.root={folders[2]}", "--perturbed.episodes=3", *TOLD]
    code = cli.main(told(folders, out, *more))
    stdout, stderr = capsys.readouterr()
    found = json.loads(stdout)
    assert code == 1 and found == json.loads((out / "trial.json").read_text())
    every = {found["name"]: found} | found["sources"]
    assert {name: one["tried"]["episodes"] for name, one in every.items()} == {
        "held out": 4, "online": 8, "perturbed": 3,
    }  # fmt: skip
    for one in every.values():
        assert set(one["gates"]) == set(found["gates"])
        assert {
            "skill_changed",
            "sensitivity_shuffled",
            "legible_real",
            "legible_true",
            "legible_change",
        } < {*one["depths"][0]}
    assert {p.name for p in out.iterdir()} == {
        "config.yaml", "trial.json", "preview.mp4", "preview_online.mp4", "preview_perturbed.mp4",
    }  # fmt: skip
    assert "By source" in stderr and "perturbed" in stderr and "gates that hold" in stderr
    assert cli.main(["report", str(out)]) == 0
    page = (out / "report.html").read_text()
    assert "By source" in page and "Dreams of perturbed episodes" in page and "read off the dreams" in page


def test_what_dreams_and_what_judges_go_to_the_device(
    folders: tuple[Path, Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    asked, went = moved(monkeypatch)
    tried: list[list[str]] = []
    real = evaluate.try_sources

    def try_sources(*args: Any, **options: Any) -> Any:
        tried.append([kind for kind, device in went if device == torch.device("cpu", 0)])
        return real(*args, **options)

    monkeypatch.setattr(evaluate, "try_sources", try_sources)
    cli.main(told(folders, tmp_path / "out", "--device=cuda:3"))
    assert asked == ["cuda:3"] and tried == [["PixelWorldModel", "SuccessPairsRewardModel"]]
    stands_in: list[Any] = []

    def load_stand_in(*args: Any) -> Any:
        stands_in.append(args[3])
        raise InputError("success.path", "x", "enough")

    monkeypatch.setattr(evaluate, "rehearse_stand_in", lambda *args: None)
    monkeypatch.setattr(evaluate, "load_stand_in", load_stand_in)
    cli.main(told(folders, tmp_path / "again", "--success.path=x"))
    assert asked == ["cuda:3", "auto"] and stands_in == [torch.device("cpu", 0)]


def test_one_that_does_not_know_the_dataset_is_tried_on_all_of_it(
    folders: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    arguments = [a.replace(str(folders[0]), str(folders[2])) for a in told(folders, tmp_path / "out")]
    cli.main(arguments)
    found = json.loads(capsys.readouterr().out)
    assert found["name"] == "dataset" and found["tried"]["episodes"] == 8 and found["sources"] == {}
    assert "legible_real" in found["depths"][0], "the probe has learnt from half of them"


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--online={repo_id: a/b, root: nowhere}", "online.root='nowhere': no meta/info.json there"),
        ("--perturbed.noise=0", "perturbed.noise=0.0: use a number above 0"),
        ("--env.state_dim=6", "env=6: the world's state_dim, and the model's is 4"),
        ("--env.image_size=32", "does not begin as it was recorded"),
        ("--env.task=mirror", "env.task='mirror': the dataset's episodes are of match"),
    ],
)
def test_what_is_refused(
    folders: tuple[Path, Path, Path],
    option: str,
    message: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    assert cli.main(replacing(told(folders, tmp_path / "out", "--perturbed.episodes=2", *TOLD), option)) == 2
    assert message in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_a_dataset_that_does_not_say_how_it_began(tmp_path: Path, folders: tuple[Path, Path, Path]):
    origin = Origin("dataset.root", "here")
    assert {task for task, _ in read_starts(folders[0], 8, origin)} == {"match"}
    with pytest.raises(InputError, match="8 pairs|7 pairs"):
        read_starts(folders[0], 7, origin)
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


def test_without_noise_an_episode_is_played_again_as_it_was(folders: tuple[Path, Path, Path]):
    episodes, spec, world = episodes_of(folders[0]), world_spec(CONFIG, ENV), make_world(ENV)
    starts = read_starts(folders[0], 8, Origin("dataset.root", "here"))
    again = perturbed_episodes(world, starts, episodes, PerturbedConfig(noise=1e-9), spec, 0)
    for one, other in zip(again, episodes, strict=True):
        assert np.array_equal(one.frames[:-1], other.frames) and len(one) == len(other)
        assert one.success_at == other.success_at and one.source == "perturbed"
        assert_close(one.state[:-1], other.state)
    played: list[int] = []
    config = PerturbedConfig(noise=1.0)
    far = perturbed_episodes(world, starts, episodes, config, spec, 0, played.append)
    assert played == list(range(1, 9)) and sum(e.success for e in far) < sum(e.success for e in episodes)
    assert all(np.array_equal(a.frames[0], b.frames[0]) for a, b in zip(far, episodes, strict=True))
    moved = [e.actions - o.actions[: len(e)] for e, o in zip(far, episodes, strict=True)]
    assert all(abs(m).max() > 0.3 for m in moved)
    same = perturbed_episodes(world, starts[:2], episodes[:2], config, spec, 0)
    assert all(np.array_equal(a.actions, b.actions) for a, b in zip(same, far, strict=False))
    other = perturbed_episodes(world, starts[:1], episodes[:1], config, spec, 1)
    assert not np.array_equal(other[0].actions, far[0].actions)


def test_noise_is_held_and_within_the_world_s_bounds():
    world = make_world(ENV).spec
    config = PerturbedConfig(noise=0.3, hold=4)
    noise = perturbed(np.zeros((10, 2), np.float32), world, config, np.random.default_rng(0))
    assert noise.shape == (10, 2) and noise.dtype == np.float32
    assert (noise[:4] == noise[0]).all() and (noise[4:8] == noise[4]).all() and (noise[8:] == noise[8]).all()
    assert len(np.unique(noise[:, 0])) == 3
    far = perturbed(
        np.zeros((400, 2), np.float32), world, replace(config, noise=50.0), np.random.default_rng(0)
    )
    assert (far == 1).any() and (far == -1).any() and (np.abs(far) == 1).mean() > 0.95
    wide = perturbed(
        np.zeros((4000, 2), np.float32), world, replace(config, hold=1), np.random.default_rng(0)
    )
    assert wide.std() == pytest.approx(0.3, rel=0.05), "half the range of these actions is 1"


def test_a_world_of_other_cameras_is_refused():
    spec = world_spec(CONFIG, ENV)
    check_world(make_world(ENV).spec, spec)
    with pytest.raises(InputError, match="the model is of observation.images.top"):
        check_world(make_world(ENV).spec, replace(spec, cameras=("observation.images.top",)))


def test_rows_of_sources_leave_out_what_none_of_them_has():
    skill = {"value": 0.5, "low": 0.25, "high": 0.75}
    one = {"gates": {"a": {"holds": True}, "b": {"holds": False}}, "depths": [{"skill_changed": skill}]}
    empty = {"gates": {}, "depths": [], "tried": {"episodes": 3}}
    assert source_rows([one, empty]) == [
        ("episodes", ["", "3"]),
        ("gates that hold", ["1 of 2", "0 of 0"]),
        ("skill, changed pixels, first chunk", ["0.50 [0.25, 0.75]", ""]),
        ("last chunk", ["0.50 [0.25, 0.75]", ""]),
    ]


@pytest.mark.parametrize(("name", "value"), [("episodes", -1), ("hold", 0)])
def test_bad_values_name_their_field(name: str, value: int):
    with pytest.raises(InputError, match=f"^perturbed.{name}={value}"):
        PerturbedConfig(**{name: value})
