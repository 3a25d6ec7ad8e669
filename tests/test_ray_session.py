# SPDX-License-Identifier: Apache-2.0
"""A private Ray is closed to others and ends with the run; a cluster is joined with the user's token."""

import contextlib
import itertools
import os
import socket
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import psutil
import pytest

from accerl_lerobot.engines import ray_session
from accerl_lerobot.engines.config import LaunchConfig
from accerl_lerobot.errors import InputError

TOKEN = "RAY_AUTH_TOKEN"


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """An environment in which nothing is set and Ray has not been imported."""
    own = ("RAY_AUTH_MODE", TOKEN, "RAY_AUTH_TOKEN_PATH", "RAY_TMPDIR")
    for name in (*ray_session.WORKERS, *ray_session.PRIVATE, *own):
        monkeypatch.setenv(name, "")  # so that it is put back afterwards
        monkeypatch.delenv(name)
    monkeypatch.delitem(sys.modules, "ray", raising=False)
    return monkeypatch


def test_every_process_makes_its_own_token_unless_the_user_has_chosen(bare: pytest.MonkeyPatch):
    tokens = []
    for _ in range(2):
        ray_session.prepare()
        assert os.environ.pop("RAY_AUTH_MODE") == "token"
        tokens.append(os.environ.pop(TOKEN))
    assert tokens[0] != tokens[1] and all(len(bytes.fromhex(token)) == 32 for token in tokens)
    folder = Path(os.environ["RAY_TMPDIR"])
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    bare.setenv("RAY_AUTH_MODE", "disabled")
    ray_session.prepare()
    assert TOKEN not in os.environ


def test_who_joins_a_cluster_has_the_user_s_token_and_nothing_else(bare: pytest.MonkeyPatch, tmp_path: Path):
    bare.setenv("HOME", str(tmp_path))
    ray_session.prepare(joins=True)
    assert not ray_session.has_token()
    assert not {"RAY_AUTH_MODE", TOKEN, "RAY_TMPDIR", *ray_session.PRIVATE} & os.environ.keys()
    with pytest.raises(InputError, match=r"launch\.address='auto': there is no token"):
        ray_session.start_ray(LaunchConfig(address="auto"))
    (tmp_path / ".ray").mkdir()
    (tmp_path / ".ray" / "auth_token").write_text("mine")
    ray_session.prepare(joins=True)
    assert ray_session.has_token()
    assert ray_session.forwarded_environment().keys() >= ray_session.WORKERS.keys()
    assert "mine" not in ray_session.forwarded_environment().values()


def test_an_address_at_which_nobody_listens_is_refused_at_once(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(TOKEN, "mine")
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"127.0.0.1:{server.getsockname()[1]}"
    with pytest.raises(InputError, match=rf"^launch\.address='{address}': this process cannot join it"):
        ray_session.start_ray(LaunchConfig(address=address))


LOOPBACK = {"127.0.0.1", "::1", "::ffff:127.0.0.1"}


def of_own_processes(ask: Callable[[psutil.Process], Any]) -> list[Any]:
    """What this process and all below it answer."""
    found = []
    for process in (psutil.Process(), *psutil.Process().children(recursive=True)):
        with contextlib.suppress(psutil.Error):
            found.append(ask(process))
    return found


def listening() -> list[str]:
    sockets = itertools.chain(*of_own_processes(lambda process: process.net_connections("tcp")))
    return [one.laddr.ip for one in sockets if one.status == psutil.CONN_LISTEN]


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="no /proc/net")
def test_everything_listens_on_the_loopback_interface_only(light_ray: None):
    addresses = listening()
    assert len(addresses) >= 4, "Ray's own processes were not found"
    assert set(addresses) <= LOOPBACK


def test_a_client_without_the_token_is_refused_and_the_token_is_in_no_log(light_ray: None):
    import ray

    context = ray.get_runtime_context()
    code = f"import ray; ray.init(address={context.gcs_address!r}, log_to_driver=False); print('connected')"
    clean = {name: value for name, value in os.environ.items() if not name.startswith("RAY_AUTH")}
    wrong = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "0" * 64, "RAY_NUM_REDIS_GET_RETRIES": "2"}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=clean | wrong, capture_output=True, text=True, timeout=120)
    assert done.returncode != 0 and "connected" not in done.stdout and "InvalidAuthToken" in done.stderr
    logs = Path(context.worker.node.get_session_dir_path()) / "logs"
    texts = [path.read_text(errors="replace") for path in logs.rglob("*") if path.is_file()]
    texts += [done.stderr, *itertools.chain(*of_own_processes(psutil.Process.cmdline))]
    assert len(texts) > 9 and not any(os.environ[TOKEN] in text for text in texts)


def test_processes_that_run_environments_do_not_get_the_hubs_token(light_engine, tmp_path: Path):
    given = psutil.Process(light_engine().pids()["rollout 0"]).environ()
    hidden = ray_session.NO_HUB_TOKEN["runtime_env"]["env_vars"]
    assert given.items() >= hidden.items()
    (tmp_path / "token").write_text("hf_storedstoredstored")
    command = [sys.executable, "-c", "import huggingface_hub; print(huggingface_hub.get_token())"]
    clean = {k: v for k, v in os.environ.items() if not k.startswith("HF_")} | {"HF_HOME": str(tmp_path)}
    for environment, token in ((clean, "hf_storedstoredstored\n"), (clean | hidden, "None\n")):
        assert subprocess.check_output(command, env=environment, text=True) == token


def test_a_ray_that_others_could_talk_to_is_not_started(bare: pytest.MonkeyPatch):
    """Ray has been imported before `prepare`, which is too late for what it reads then."""
    bare.setitem(sys.modules, "ray", MagicMock())
    ray_session.prepare()
    with pytest.raises(RuntimeError, match="would be open to others if started now"):
        ray_session.start_ray()


def test_a_ray_that_does_not_start_is_started_again_a_few_times(monkeypatch: pytest.MonkeyPatch):
    error = Exception("The current node timed out\nduring startup.")  # a plain one, as Ray's
    failures = [error] * (ray_session.STARTS - 1)
    stand = MagicMock(**{"init.side_effect": [*failures, None, *failures, error]})
    monkeypatch.setitem(sys.modules, "ray", stand)
    ray_session.start_ray()
    with pytest.raises(RuntimeError, match="Ray did not start: Exception: The current node timed out"):
        ray_session.start_ray()
