# SPDX-License-Identifier: Apache-2.0
"""A private Ray is closed to others, ends with the run, and is watched; a cluster is checked first."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import MagicMock

import psutil
import pytest

from accerl_lerobot.engine import ray_session
from accerl_lerobot.engine.config import LaunchConfig
from accerl_lerobot.engine.ray_session import RaySession, process_kind
from accerl_lerobot.engine.stopping import WorkerError
from accerl_lerobot.errors import InputError

TOKEN, TOKEN_PATH = "RAY_AUTH_TOKEN", "RAY_AUTH_TOKEN_PATH"
VARIABLES = (*ray_session.WORKERS, *ray_session.PRIVATE, "RAY_AUTH_MODE", TOKEN, TOKEN_PATH, "RAY_TMPDIR")


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch) -> Iterator[pytest.MonkeyPatch]:
    """An environment in which nothing is set and Ray has not been imported."""
    for name in VARIABLES:
        monkeypatch.setenv(name, "")  # so that it is put back afterwards
        monkeypatch.delenv(name)
    monkeypatch.delitem(sys.modules, "ray", raising=False)
    monkeypatch.setattr(ray_session, "private_folder", ray_session.private_folder.__wrapped__)
    yield monkeypatch


def test_every_process_makes_its_own_token(bare: pytest.MonkeyPatch):
    tokens = []
    for _ in range(2):
        ray_session.prepare()
        assert os.environ["RAY_AUTH_MODE"] == "token" and TOKEN not in os.environ
        tokens.append(Path(os.environ.pop(TOKEN_PATH)).read_text())
        del os.environ["RAY_AUTH_MODE"]
    assert tokens[0] != tokens[1] and all(len(bytes.fromhex(token)) == 32 for token in tokens)


def test_a_token_was_never_open_to_others(bare: pytest.MonkeyPatch):
    """Modes are looked at when folder and file are made, before anything is in them."""
    seen: list[tuple[bool, int]] = []
    make, opened = os.mkdir, os.open

    def mkdir(path: str, *arguments: int, **options: int) -> None:
        make(path, *arguments, **options)
        seen.append((True, stat.S_IMODE(os.stat(path).st_mode)))

    def open_(path: str, *arguments: int, **options: int) -> int:
        handle = opened(path, *arguments, **options)
        found = os.fstat(handle)
        assert found.st_size == 0
        seen.append((False, stat.S_IMODE(found.st_mode)))
        return handle

    before = os.umask(0)
    try:
        bare.setattr(os, "mkdir", mkdir)
        bare.setattr(os, "open", open_)
        ray_session.write_token()
    finally:
        os.umask(before)
    assert seen == [(True, 0o700), (False, 0o600)]


@pytest.mark.parametrize("end", ["pass", "raise SystemExit(3)", "1 / 0"])
def test_the_token_goes_with_its_process(end: str):
    code = (
        "import os\nfrom accerl_lerobot.engine import ray_session\nray_session.prepare()\n"
        "child = os.fork()\nif child == 0: raise SystemExit(0)\nos.waitpid(child, 0)\n"
        f"path = os.environ['RAY_AUTH_TOKEN_PATH']\nassert os.path.isfile(path)\nprint(path)\n{end}"
    )
    clean = {k: v for k, v in os.environ.items() if not k.startswith("RAY_")}
    done = subprocess.run([sys.executable, "-c", code], env=clean, capture_output=True, text=True, timeout=60)
    path = Path(done.stdout.split()[-1])
    assert path.name == "token" and not path.parent.exists()


@pytest.mark.parametrize("name", ["RAY_AUTH_MODE", TOKEN, TOKEN_PATH])
def test_a_configured_token_is_left_alone(bare: pytest.MonkeyPatch, name: str):
    bare.setenv(name, "mine")
    ray_session.prepare()
    found = {k: os.environ[k] for k in ("RAY_AUTH_MODE", TOKEN, TOKEN_PATH) if k in os.environ}
    assert found == {name: "mine"}


def test_who_joins_a_cluster_has_the_user_s_token_and_nothing_else(bare: pytest.MonkeyPatch, tmp_path: Path):
    bare.setenv("HOME", str(tmp_path))
    ray_session.prepare(joins=True)
    assert not ray_session.has_token()
    assert not {"RAY_AUTH_MODE", TOKEN, TOKEN_PATH, "RAY_TMPDIR", *ray_session.PRIVATE} & os.environ.keys()
    assert ray_session.forwarded_environment().keys() >= ray_session.WORKERS.keys()
    (tmp_path / ".ray").mkdir()
    (tmp_path / ".ray" / "auth_token").write_text("mine")
    ray_session.prepare(joins=True)
    assert ray_session.has_token() and os.environ["RAY_AUTH_MODE"] == "token"
    bare.setenv(TOKEN, "mine")
    stranger = ray_session.without_token()
    assert not {TOKEN, TOKEN_PATH} & stranger.keys() and stranger["RAY_AUTH_MODE"] == "disabled"
    assert not (Path(stranger["HOME"]) / ".ray").exists()
    assert "mine" not in ray_session.forwarded_environment().values()


def test_a_folder_in_which_ray_cannot_make_sockets_is_refused_at_once(bare: pytest.MonkeyPatch):
    bare.setenv("RAY_TMPDIR", f"/tmp/{'x' * 105}")
    why = r"^RAY_TMPDIR='/tmp/x+': 110 bytes, .* leaves 37 to it; use a shorter one, or unset RAY_TMPDIR$"
    with pytest.raises(InputError, match=why):
        ray_session.prepare()
    with pytest.raises(InputError, match=why), ray_session.opened(LaunchConfig(), now=False):
        pass  # also where Ray starts only after SFT
    bare.setenv("RAY_TMPDIR", "/dev/null/x")
    with pytest.raises(InputError, match="^RAY_TMPDIR='/dev/null/x': /dev/null cannot hold folders"):
        ray_session.prepare()
    bare.setenv("RAY_TMPDIR", "/tmp/short/new")
    ray_session.prepare()
    bare.delenv("RAY_TMPDIR")  # as the message proposes
    ray_session.prepare()


LOOPBACK = {"127.0.0.1", "::1", "::ffff:127.0.0.1"}


def own_processes() -> list[psutil.Process]:
    """This process and all below it."""
    return [psutil.Process(), *psutil.Process().children(recursive=True)]


def listening() -> list[str]:
    """Addresses at which own processes accept TCP connections."""
    found = []
    for process in own_processes():
        with contextlib.suppress(psutil.Error):
            sockets = process.net_connections("tcp")
            found += [one.laddr.ip for one in sockets if one.status == psutil.CONN_LISTEN]
    return found


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="no /proc/net")
def test_everything_listens_on_the_loopback_interface_only(light_ray: None):
    addresses = listening()
    assert len(addresses) >= 4, "Ray's own processes were not found"
    assert set(addresses) <= LOOPBACK


def test_its_sockets_and_logs_are_nobody_else_s(light_ray: None):
    import ray

    session = Path(ray.get_runtime_context().worker.node.get_session_dir_path())
    folder = Path(os.environ["RAY_TMPDIR"])
    assert session.is_relative_to(folder) and stat.S_IMODE(folder.stat().st_mode) == 0o700


def test_workers_know_where_the_token_is_and_not_what(light_ray: None):
    import ray

    token = Path(os.environ[TOKEN_PATH]).read_text()
    there = ray.get(ray.remote(lambda: dict(os.environ)).remote())
    assert there[TOKEN_PATH] == os.environ[TOKEN_PATH]
    assert TOKEN not in there and not any(token in value for value in there.values())
    for process in own_processes():
        with contextlib.suppress(psutil.Error):
            assert token not in " ".join([*process.environ().values(), *process.cmdline()]), process


def test_a_client_without_the_token_is_refused(light_ray: None):
    import ray

    address = ray.get_runtime_context().gcs_address
    code = f"import ray; ray.init(address={address!r}, log_to_driver=False); print('connected')"

    def connect(**changes: str) -> subprocess.CompletedProcess[str]:
        clean = {k: v for k, v in os.environ.items() if not k.startswith("RAY_AUTH")}
        command = [sys.executable, "-c", code]
        return subprocess.run(command, env=clean | changes, capture_output=True, text=True, timeout=120)

    known = connect(RAY_AUTH_MODE="token", RAY_AUTH_TOKEN_PATH=os.environ[TOKEN_PATH])
    assert known.stdout.strip().endswith("connected"), known.stderr
    for strange in ({}, {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "0" * 64}):
        stranger = connect(**strange)
        assert stranger.returncode != 0 and "connected" not in stranger.stdout
        assert "InvalidAuthToken" in stranger.stderr


TOKENS = """
import json, sys
from pathlib import Path
from accerl_lerobot.engine import ray_session
ray_session.prepare()
from accerl_lerobot.engine.launch import RayEngine
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
    assert token({"HF_HOME": str(tmp_path)} | ray_session.NO_HUB_TOKEN["runtime_env"]["env_vars"]) == "None"


def test_a_ray_that_others_could_talk_to_is_not_started():
    """Ray first, `prepare` after: too late for what Ray reads when it is imported."""
    program = (
        "import ray\nfrom accerl_lerobot.engine import ray_session\nray_session.prepare()\n"
        "from accerl_lerobot.engine.ray_session import start_ray\nstart_ray()\n"
    )
    clean = {k: v for k, v in os.environ.items() if not k.startswith("RAY_")}
    done = subprocess.run(
        [sys.executable, "-c", program], env=clean, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 1 and "would be open to others if started now" in done.stderr


class Stand:
    """Stands in for `ray`, and counts."""

    def __init__(self, failures: int = 0) -> None:
        self.there, self.failures, self.calls = False, failures, list[str]()

    def is_initialized(self) -> bool:
        return self.there

    def init(self, launch: LaunchConfig | None = None, **options: object) -> None:
        self.calls.append("init")
        if self.failures:
            self.failures -= 1
            raise Exception("The current node timed out\nduring startup.")  # a plain one, as Ray's
        self.there = True

    def shutdown(self) -> None:
        self.there = False
        self.calls.append("shutdown")


@pytest.fixture
def hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide the Ray that other tests use in this process, or it would be ended here."""
    monkeypatch.setattr(ray_session, "ray_processes", dict)


@pytest.fixture
def stand(hidden: None, monkeypatch: pytest.MonkeyPatch) -> Stand:
    stand = Stand()
    monkeypatch.setitem(sys.modules, "ray", stand)
    monkeypatch.setattr(ray_session, "start_ray", stand.init)
    return stand


def test_it_is_kept_for_those_who_come_later(stand: Stand):
    own = RaySession(LaunchConfig())
    own.start()
    own.start()
    own.close()
    own.close()
    assert stand.calls == ["init", "shutdown"] and not stand.there


def test_one_that_was_there_before_is_left_as_it_is(stand: Stand):
    stand.there = True
    own = RaySession(LaunchConfig())
    own.start()
    own.close()
    assert stand.calls == [] and stand.there


@pytest.mark.parametrize("failures", [0, 1])
def test_one_that_starts_beside_the_imports(stand: Stand, monkeypatch: pytest.MonkeyPatch, failures: int):
    modules: list[str] = []
    starts = iter([*failures * [MagicMock(side_effect=WorkerError("busy"))], stand.init])
    monkeypatch.setattr(ray_session, "start_ray", lambda launch: next(starts)(launch))
    monkeypatch.setattr(ray_session, "imported", modules.append)
    monkeypatch.setattr(ray_session, "prepare", lambda joins: None)
    with ray_session.opened(LaunchConfig(), now=True) as session:
        assert modules == ["accerl_lerobot.policies.loading:load_adapter"]
        assert stand.there == (not failures)
        assert session is not None
        session.start()  # as the engine does
    assert stand.calls == ["init", "shutdown"]
    with ray_session.opened(LaunchConfig(engine="local"), now=True) as session:
        assert session is None


@pytest.fixture
def raylet(monkeypatch: pytest.MonkeyPatch) -> Iterator[psutil.Process]:
    """A process that is taken for Ray's only one."""
    with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"]) as process:
        one = psutil.Process(process.pid)  # made once: there is none of a process that has gone
        monkeypatch.setattr(ray_session, "ray_processes", lambda: {one: "raylet"})
        yield one
        process.kill()


@pytest.mark.parametrize(("number", "how"), [(signal.SIGKILL, "died"), (signal.SIGSTOP, "been stopped for")])
def test_a_process_of_ray_that_is_lost_is_named_and_a_new_ray_is_started(
    stand: Stand, number: signal.Signals, how: str, raylet: psutil.Process, monkeypatch: pytest.MonkeyPatch
):
    own = RaySession(LaunchConfig(stall_s=0.1))
    own.start()
    assert not own.lost
    raylet.send_signal(number)
    while not own.lost:
        time.sleep(0.01)
    assert own.lost.startswith(f"Ray's raylet (process {raylet.pid}) has {how}")
    own.close()
    assert own.lost and not raylet.is_running()
    monkeypatch.setattr(ray_session, "ray_processes", dict)
    own.start()
    assert not own.lost and stand.calls == ["init", "shutdown", "init"]
    own.close()


def test_who_goes_on_is_not_taken_for_stopped(raylet: psutil.Process):
    own = RaySession(LaunchConfig(stall_s=3600.0))
    own.watch()
    raylet.suspend()
    while raylet.status() != psutil.STATUS_STOPPED:
        time.sleep(0.01)
    assert not own.lost and own._stopped
    raylet.resume()
    while own._stopped:
        assert not own.lost
    own.close()


HANGS = """
import os, signal, sys, time
import psutil
from accerl_lerobot import guardian
from accerl_lerobot.engine import ray_session
from accerl_lerobot.engine.config import LaunchConfig
gcs_server = psutil.Process(int(sys.argv[1]))
ray_session.ray_processes = lambda: {gcs_server: "gcs_server"}
ray_session.kill_ray = lambda processes: None
ray_session.GIVE_UP_S = 0.1
guardian.explain(hint="to resume: accerl train --resume=true")
ray_session.RaySession(LaunchConfig()).watch()
os.kill(int(sys.argv[1]), signal.SIGKILL)
time.sleep(600)
"""


def test_a_main_thread_that_hangs_in_ray_does_not_keep_the_process(raylet: psutil.Process):
    command = [sys.executable, "-c", HANGS, str(raylet.pid)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240)
    said = f"accerl: Ray's gcs_server (process {raylet.pid}) has died; to resume: accerl train --resume=true"
    assert (done.returncode, done.stderr.splitlines()[-1:]) == (1, [said])


@pytest.mark.parametrize("failures", [2, ray_session.STARTS])
def test_a_ray_that_does_not_start_is_started_again_a_few_times(
    hidden: None, failures: int, monkeypatch: pytest.MonkeyPatch
):
    stand = Stand(failures=failures)
    monkeypatch.setitem(sys.modules, "ray", stand)
    monkeypatch.setattr(ray_session.time, "sleep", lambda seconds: None)
    if failures < ray_session.STARTS:
        ray_session.start_ray()
        assert stand.there and stand.calls.count("init") == failures + 1
        return
    with pytest.raises(WorkerError) as raised:
        ray_session.start_ray()
    assert str(raised.value) == (
        f"Ray did not start in {failures} attempts: The current node timed out during startup."
    )


def test_rays_own_processes_are_told_from_its_workers():
    assert process_kind(["/x/ray/core/src/ray/raylet/raylet", "--raylet_socket_name=x"]) == "raylet"
    assert process_kind(["python", "-u", "/x/ray/_private/log_monitor.py"]) == "log monitor"
    assert process_kind(["ray::DashboardAgent" + " " * 90]) == "dashboard agent"
    assert process_kind(["python", "/x/ray/_private/workers/default_worker.py", "--raylet=/x"]) is None
    assert process_kind(["ray::RolloutWorker"]) is None and process_kind([]) is None


@pytest.fixture
def address() -> Iterator[str]:
    """Where somebody listens."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"127.0.0.1:{server.getsockname()[1]}"


@pytest.mark.parametrize(
    ("status", "says"),
    [
        ("raise OSError('boom')", "it does not answer as Ray does: OSError: boom"),
        ("raise OSError('InvalidAuthToken: wrong')", "it does not take the token that is configured here"),
        ("pass", "it asks for no token, so whoever reaches it runs code"),
        ("import time; time.sleep(600)", "it does not answer as Ray does: no answer within 1 s"),
    ],
)
def test_what_is_no_cluster_to_join_is_refused(
    address: str, status: str, says: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(ray_session, "STATUS", ("-c", status))
    if "sleep" in status:  # the others have to start a process on a machine that may be busy
        monkeypatch.setattr(ray_session, "ANSWER_S", 1.0)
    with pytest.raises(InputError, match=rf"^launch\.address='{address}': {says}"):
        ray_session.check_cluster(LaunchConfig(address=address))


def test_a_cluster_that_answers_those_with_a_token_only_is_joined(
    address: str, monkeypatch: pytest.MonkeyPatch
):
    asks = "import os; assert os.environ['RAY_AUTH_MODE'] == 'token'"
    monkeypatch.setattr(ray_session, "STATUS", ("-c", asks))
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    ray_session.check_cluster(LaunchConfig(address=address))
