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
"""What is pushed comes back as it was, through the real client and a Hub on this machine."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from accerl_lerobot import cli
from accerl_lerobot.checkpoint import save_checkpoint
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.loading import load_adapter, save_pretrained
from tests.hub_server import HubServer, environment
from tests.policies.tiny import perturb

ROOT = Path(__file__).parents[2]
TINY = ROOT / "datasets" / "metaworld_tiny"
NAME = "alice/door"


def accerl(*arguments: str) -> int:
    return cli.main(list(arguments))


def fresh(server: HubServer, home: Path, code: str, *arguments: str) -> Any:
    """What a new process with an empty cache prints last, as JSON."""
    command = [sys.executable, "-c", code, *arguments]
    variables = {k: v for k, v in os.environ.items() if not k.startswith("HF_")} | environment(server, home)
    done = subprocess.run(command, env=variables, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.strip().splitlines()[-1])


@pytest.fixture
def checkpoint(tiny_checkpoint: Path, tmp_path: Path) -> Path:
    """The last checkpoint of a run, with a critic and a backbone of its own."""
    config = PolicyConfig(path=str(tiny_checkpoint), device="cpu")
    adapter = load_adapter(config)
    perturb(adapter, 0.1)

    def write(directory: Path) -> int:
        save_pretrained(adapter, directory, config)
        return 12

    save_checkpoint(tmp_path / "run" / "checkpoints", write, {"algorithm": "gipo"})
    return tmp_path / "run" / "checkpoints" / "last" / "pretrained_model"


LOAD = """
import json, sys, hashlib
from accerl_lerobot.policies.config import PolicyConfig
from accerl_lerobot.policies.loading import load_adapter
from accerl_lerobot.policies.plugins import register_policies
path, revision = sys.argv[1], sys.argv[2] or None
def digest(state):
    return hashlib.sha256(b"".join(k.encode() + v.numpy().tobytes() for k, v in sorted(state.items()))).hexdigest()
adapter = load_adapter(PolicyConfig(path=path, revision=revision, device="cpu"))
found = {"policy": digest(adapter.policy.state_dict()), "critic": digest(adapter.value_head.state_dict())}
if len(sys.argv) > 3:
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors
    register_policies()
    stock = get_policy_class(PreTrainedConfig.from_pretrained(path).type).from_pretrained(path)
    make_pre_post_processors(stock.config, pretrained_path=path)
    found["stock"] = digest(stock.state_dict())
print(json.dumps(found))
"""


def test_a_policy(hub: HubServer, checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert accerl("push", f"--path={checkpoint}", f"--repo_id={NAME}") == 0
    pushed = json.loads(capsys.readouterr().out)
    commit = hub.repo(NAME).branches["main"]
    assert pushed["commit"] == commit and pushed["kind"] == "policy" and hub.repo(NAME).private
    moved = tmp_path / "elsewhere"
    checkpoint.parents[2].rename(moved)  # whatever still names the old place is found out
    assert accerl("pull", f"--repo_id={NAME}", f"--output_dir={tmp_path / 'pulled'}") == 0
    pulled = json.loads(capsys.readouterr().out)
    assert pulled["commit"] == commit and pulled["unchecked"] == 0 and pulled["checked"] > 8
    record = json.loads((tmp_path / "pulled" / "accerl_pulled.json").read_text())
    assert record["commit"] == commit and record["repo_id"] == NAME
    home = str(tmp_path / "home")
    before = fresh(hub, tmp_path / "home", LOAD, str(moved / "checkpoints/000012/pretrained_model"), "")
    after = fresh(hub, tmp_path / "home", LOAD, str(tmp_path / "pulled"), "", "stock")
    assert after["stock"] == after.pop("stock") == after["policy"]
    assert before == after
    assert not list(tmp_path.glob(".pulling-*")) and not Path(home, "hub", "models--alice--door").exists()


def test_a_policy_straight_from_the_hub_at_a_commit(hub: HubServer, checkpoint: Path, tmp_path: Path):
    assert accerl("push", f"--path={checkpoint}", f"--repo_id={NAME}") == 0
    commit = hub.repo(NAME).branches["main"]
    hub.plant(NAME, {"model.safetensors": b"something else"})
    home = tmp_path / "home"
    assert fresh(hub, home, LOAD, NAME, commit) == fresh(hub, home, LOAD, str(checkpoint), "")
