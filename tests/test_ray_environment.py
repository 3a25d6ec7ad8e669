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
"""Ray is a run's own: nobody else can reach it, and nobody who could is let in."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from accerl_lerobot import ray_environment
from tests.light_workers import light_ray

__all__ = ["light_ray"]

TOKEN = "RAY_AUTH_TOKEN"
VARIABLES = (
    *ray_environment.WORKERS,
    *ray_environment.PRIVATE,
    "RAY_AUTH_MODE",
    TOKEN,
    "RAY_AUTH_TOKEN_PATH",
)


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """An environment in which nothing is set and Ray has not been imported."""
    for name in VARIABLES:
        monkeypatch.setenv(name, "")  # so that it is put back afterwards
        monkeypatch.delenv(name)
    monkeypatch.delitem(sys.modules, "ray", raising=False)
    return monkeypatch


def test_every_process_makes_its_own_token(bare: pytest.MonkeyPatch):
    tokens = []
    for _ in range(2):
        ray_environment.prepare()
        assert os.environ["RAY_AUTH_MODE"] == "token"
        tokens.append(os.environ.pop(TOKEN))
        del os.environ["RAY_AUTH_MODE"]
    assert tokens[0] != tokens[1] and all(len(bytes.fromhex(token)) == 32 for token in tokens)


@pytest.mark.parametrize("name", ["RAY_AUTH_MODE", TOKEN, "RAY_AUTH_TOKEN_PATH"])
def test_a_configured_token_is_left_alone(bare: pytest.MonkeyPatch, name: str):
    bare.setenv(name, "mine")
    ray_environment.prepare()
    found = {k: os.environ[k] for k in ("RAY_AUTH_MODE", TOKEN, "RAY_AUTH_TOKEN_PATH") if k in os.environ}
    assert found == {name: "mine"}


def test_what_the_user_has_set_is_kept(bare: pytest.MonkeyPatch):
    bare.setenv("OMP_NUM_THREADS", "7")
    ray_environment.prepare()
    assert os.environ["OMP_NUM_THREADS"] == "7" and os.environ["OMP_WAIT_POLICY"] == "PASSIVE"


def test_a_ray_that_is_imported_already_has_read_its_environment(bare: pytest.MonkeyPatch):
    bare.setitem(sys.modules, "ray", sys)
    ray_environment.prepare()
    assert TOKEN not in os.environ and not set(ray_environment.PRIVATE) & os.environ.keys()


def test_everything_listens_on_the_loopback_interface_only(light_ray: None):
    psutil = pytest.importorskip("psutil")
    me = psutil.Process()
    mine = {me.pid, *(child.pid for child in me.children(recursive=True))}
    listening = [
        c for c in psutil.net_connections("inet") if c.status == psutil.CONN_LISTEN and c.pid in mine
    ]
    assert len(listening) >= 4, "Ray's own processes were not found"
    assert {c.laddr.ip for c in listening} <= {"127.0.0.1", "::ffff:127.0.0.1", "::1"}


def test_a_client_without_the_token_is_refused(light_ray: None):
    import ray

    address = ray.get_runtime_context().gcs_address
    code = f"import ray; ray.init(address={address!r}, log_to_driver=False); print('connected')"

    def connect(environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", code]
        return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)

    assert connect(dict(os.environ)).stdout.strip().endswith("connected")
    stranger = connect({k: v for k, v in os.environ.items() if not k.startswith("RAY_AUTH")})
    assert stranger.returncode != 0 and "connected" not in stranger.stdout
    assert "InvalidAuthToken" in stranger.stderr


TOKENS = """
import json, sys
from pathlib import Path
from accerl_lerobot import ray_environment
ray_environment.prepare()
from accerl_lerobot.launch import RayEngine
from accerl_lerobot.inference import worker as inference
from accerl_lerobot.trainer import worker as trainer
from tests.light_workers import LightInference, LightTrainer
from tests.runs import tiny_run
inference.InferenceWorker, trainer.TrainerWorker = LightInference, LightTrainer
engine = RayEngine(tiny_run(Path("nowhere")), ("match",))
try:
    found = {name: Path(f"/proc/{pid}/environ").read_text() for name, pid in engine.pids().items()}
finally:
    engine.close()
print(json.dumps({name: text.count(sys.argv[1]) for name, text in found.items()}))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_processes_that_run_worlds_do_not_get_the_hubs_token():
    token = "hf_notforenvironments"
    secrets = {"HF_TOKEN": token, "HUGGING_FACE_HUB_TOKEN": token}
    done = subprocess.run(
        [sys.executable, "-c", TOKENS, token],
        env={k: v for k, v in os.environ.items() if not k.startswith("RAY_AUTH")} | secrets,
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["rollout 0"] == 0
    assert found["inference"] == 2, "it may have to fetch a policy, and shows that the token was there"


def test_a_client_in_such_a_process_finds_no_token(tmp_path: Path):
    (tmp_path / "token").write_text("hf_storedstoredstored")
    code = "import huggingface_hub; print(huggingface_hub.get_token())"

    def token(variables: dict[str, str]) -> str:
        environment = {k: v for k, v in os.environ.items() if not k.startswith("HF_")} | variables
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    assert token({"HF_HOME": str(tmp_path)}) == "hf_storedstoredstored"
    assert token({"HF_HOME": str(tmp_path)} | ray_environment.TOKENLESS["runtime_env"]["env_vars"]) == "None"
