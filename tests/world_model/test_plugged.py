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
"""A class of world models that is not ours: learnt, saved, tried, dreamt with and learnt on in a run."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from accerl_lerobot import cli, console
from accerl_lerobot.config import parse
from accerl_lerobot.envs import SimulatedConfig
from accerl_lerobot.errors import InputError
from accerl_lerobot.verb_configs import WorldModelRun
from accerl_lerobot.world_model.config import PixelModelConfig, WorldModelConfig
from accerl_lerobot.world_model.contract import new_learnable
from accerl_lerobot.world_model.imagination_config import ImaginationConfig, OnlineLearnConfig
from accerl_lerobot.world_model.offline import world_spec
from accerl_lerobot.world_model.store import load_world_model, save_world_model
from accerl_lerobot.world_model.success import new_success_model
from accerl_lerobot.world_model.zoo import make_dreamer
from tests.test_imagining import LOOSE, decisions, dreaming, lived
from tests.world_model.linear_world import LinearModelConfig, LinearWorldModel
from tests.world_model.test_offline import arguments, recorded

PACKAGE = "tests.world_model.linear_world"
NAMED = [f"--world_model.discover_packages_path={PACKAGE}", "--world_model.model.type=linear"]


def saved(folder: Path, gain: float = 1.0) -> Path:
    torch.manual_seed(0)
    config = LinearModelConfig(gain=gain)
    env = SimulatedConfig(max_steps=16, hold=8)
    spec = world_spec(WorldModelConfig(chunk=4, image_size=32, model=config), env)
    save_world_model(folder, new_learnable(spec, config), new_success_model(4))
    return folder


def test_it_is_learnt_and_tried_by_naming_its_package(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(console, "PLAIN_EVERY_S", -1.0)
    demos, out = recorded(tmp_path / "dataset", 8, 0), tmp_path / "out"
    ours = "--world_model.model.network.channels=16,24"
    told = [a for a in arguments(demos, out) if a != ours] + [*NAMED, "--world_model.learn.steps=300"]
    cli.main([*told, "--world_model.learn.lr=0.03", "--world_model.learn.validate_every=100"])
    stdout, stderr = capsys.readouterr()
    found = json.loads(stdout)
    assert "world model 300/300 motion 0." in stderr
    losses = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    held = [row["motion"] for row in losses if row["kind"] == "world_model_held_out"]
    assert len(held) == 3 and 0 < held[-1] < 0.5, (
        "in usual motions; of one that knows nothing it is 1 or more"
    )
    model, success = load_world_model(out / "world_model", PACKAGE)
    assert isinstance(model, LinearWorldModel) and success is not None and model.config.context == 1
    assert model.spec.provides == {"pixels", "state"} and float(model.doubt) == 1.0
    capsys.readouterr()  # LeRobot prints
    path, trial = f"--path={out / 'world_model'}", "--trial.depth=2"
    dataset = ["--dataset.repo_id=a/b", f"--dataset.root={demos}", f"--output_dir={tmp_path / 'again'}"]
    cli.main(["world-model-eval", path, *dataset, trial, f"--discover_packages_path={PACKAGE}"])
    again = json.loads(capsys.readouterr().out)
    (first, _), (same, _) = found["depths"], again["depths"]
    assert first["state_error"] == pytest.approx(same["state_error"])
    assert not found["passed"], "its pictures never change"


def test_its_fields_are_fields_of_the_command_line():
    run = parse(WorldModelRun, [*NAMED, "--world_model.model.gain=2", "--world_model.image_size=18"])
    assert run.world_model.model == LinearModelConfig(gain=2.0) and run.world_model.type == "tiny"
    small = parse(WorldModelRun, [*NAMED, "--world_model.type=small"]).world_model
    assert small.model == LinearModelConfig() and small.image_size == 128
    with pytest.raises(InputError, match="^world_model.model.gain=0.0: use a positive number"):
        parse(WorldModelRun, [*NAMED, "--world_model.model.gain=0"])
    with pytest.raises(InputError, match="^world_model.model.context=0: use at least 1"):
        LinearModelConfig(context=0)
    with pytest.raises(InputError, match="^world_model.model.heads=3: no such field"):
        parse(WorldModelRun, [*NAMED, "--world_model.model.heads=3"])
    with pytest.raises(InputError, match="^world_model.discover_packages_path='no.such': cannot be imported"):
        parse(WorldModelRun, ["--world_model.discover_packages_path=no.such"])


def test_ours_are_one_type_of_several():
    assert parse(WorldModelRun, ["--world_model.model.steps=2"]).world_model.model == PixelModelConfig(
        steps=2
    )
    with pytest.raises(InputError, match=r"^world_model.model.type='spiral': .*pixels"):
        parse(WorldModelRun, ["--world_model.model.type=spiral"])


def test_whoever_does_not_name_its_package_is_told_to(tmp_path: Path):
    """In a process that has not heard of it."""
    script = (
        "import sys; from pathlib import Path\n"
        "from accerl_lerobot.errors import InputError\n"
        "from accerl_lerobot.world_model.store import load_world_model\n"
        "for package in (None, sys.argv[2]):\n"
        "    try:\n"
        "        model, _ = load_world_model(Path(sys.argv[1]), package, room='imagination')\n"
        "        print('>', type(model).__name__)\n"
        "    except InputError as error:\n"
        "        print('>', error)\n"
    )
    told = [sys.executable, "-c", script, str(saved(tmp_path / "w")), PACKAGE]
    printed = subprocess.run(told, check=True, capture_output=True, text=True).stdout.splitlines()
    one, other = (line[2:] for line in printed if line.startswith("> "))  # LeRobot prints, too
    wanted = "config.json: model.type: 'linear'; use one of pixels, or name its package: "
    assert one.startswith("imagination.path=") and one.endswith(f"{wanted}imagination.discover_packages_path")
    assert other == "LinearWorldModel"
    with pytest.raises(InputError, match="^imagination.discover_packages_path='no.such': cannot be imported"):
        load_world_model(tmp_path / "w", "no.such", room="imagination")


def test_what_its_file_says_is_its_configs_to_refuse(tmp_path: Path):
    file = saved(tmp_path / "w") / "config.json"
    good = json.loads(file.read_text())
    assert good["model"] == {"type": "linear", "context": 1, "gain": 1.0}
    for model, why in (
        ({"gain": -1.0}, "use a positive number"),
        ({"gain": "much"}, "not a world model of accerl world-model"),
        ({"context": 65}, "config.json: model.context"),
        ({"type": ["linear"]}, "use one of"),
    ):
        file.write_text(json.dumps(good | {"model": good["model"] | model}))
        with pytest.raises(InputError, match=f"^path=.*{why}"):
            load_world_model(tmp_path / "w")


def test_it_goes_on_learning_in_a_run_and_is_saved_when_promoted(tiny_checkpoint: Path, tmp_path: Path):
    learn = OnlineLearnConfig(steps_per_episode=1.0, try_every=2, held_out=0.4, trial=LOOSE, batch=4)
    path = str(saved(tmp_path / "w", gain=3.0))
    config = dreaming(tiny_checkpoint, path=path, discover_packages_path=PACKAGE, learn=learn, episodes=12)
    history, batches, engine = lived(config)
    dreamt = [s for batch in batches for s in batch if decisions([s], "imagined")]
    assert history[-1].imagination["promoted"] >= 1 and dreamt
    assert {s.world_version for s in dreamt} > set() and all(s.world_version for s in dreamt)
    assert engine._dreams is not None
    engine._dreams.save_promoted(tmp_path / "promoted")
    before, after = (load_world_model(tmp_path / name)[0] for name in ("w", "promoted"))
    assert isinstance(after, LinearWorldModel) and after.gain == 3.0
    moved = after.motion.weight - before.get_parameter("motion.weight")
    assert float(moved.abs().max()) > 0


def test_it_can_be_told_the_wrong_actions(tmp_path: Path):
    config = ImaginationConfig(share=0.5, model="shuffled", path=str(saved(tmp_path / "w")))
    named = replace(config, discover_packages_path=PACKAGE)
    env = SimulatedConfig(max_steps=16, hold=8)
    model, success = make_dreamer(named, env, None, 4, "cpu")  # type: ignore[arg-type]  # only an oracle asks
    state = {"frames": torch.zeros(2, 1, 32, 32, 3, dtype=torch.uint8), "robot": torch.zeros(2, 4)}
    actions = torch.stack([torch.zeros(4, 2), torch.ones(4, 2)])
    right, wrong = (m.step(state, actions, [0, 0]).robot for m in (model.model, model))  # type: ignore[attr-defined]
    assert success is not None and torch.equal(right.flip(0), wrong) and not torch.equal(right, wrong)
