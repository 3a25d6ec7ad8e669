# SPDX-License-Identifier: Apache-2.0
"""Checks of a cluster before a run joins it; with real ones, see `test_launch_nodes`."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from accerl_lerobot.engine import cluster
from accerl_lerobot.engine.config import LaunchConfig
from accerl_lerobot.engine.contract import WorkerError
from accerl_lerobot.errors import InputError
from tests.test_placement import cluster as nodes_of
from tests.test_placement import run, where


@pytest.fixture
def listening() -> Iterator[str]:
    """An address at which somebody listens."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        yield f"127.0.0.1:{server.getsockname()[1]}"


@pytest.mark.parametrize(
    ("answer", "says"),
    [
        ("raise OSError('boom')", r".*does not answer as Ray .* does: OSError: boom"),
        ("raise OSError('InvalidAuthToken: wrong')", r"it does not take the token that is configured here"),
        ('print(\'{"ray_version": "2.0.0"}\')', r"it runs Ray 2\.0\.0, and this is "),
        ("print('{}')", r"it asks for no token, so whoever reaches it runs code"),
    ],
)
def test_what_is_no_cluster_to_join_is_refused(
    listening: str, answer: str, says: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(cluster, "ASK", answer)
    with pytest.raises(InputError, match=rf"^launch\.address='{listening}': {says}"):
        cluster._check_cluster(cluster._found(listening), LaunchConfig(address=listening))


def test_who_answers_those_with_a_token_only_is_joined(
    listening: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    answer = "import os\nassert os.environ['RAY_AUTH_MODE'] == 'token'\nprint('{}')"
    monkeypatch.setattr(cluster, "ASK", answer)
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    cluster._check_cluster(listening, LaunchConfig(address=listening))
    monkeypatch.setattr(cluster, "ASK", "print('{}')")
    cluster._check_cluster(listening, LaunchConfig(address=listening, open_cluster=True))


def test_a_cluster_that_keeps_silent_is_not_waited_for(listening: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cluster, "ASK", "import time\ntime.sleep(600)")
    monkeypatch.setattr(cluster, "ANSWER_S", 0.3)
    with pytest.raises(InputError, match="no answer within 0 s"):
        cluster._check_cluster(listening, LaunchConfig(address=listening))


def test_a_node_that_leaves_while_it_is_asked_is_planned_without(monkeypatch: pytest.MonkeyPatch):
    there = [frozenset({"key0", "key1"})]
    asked: list[int] = []

    def seen(config: object) -> object:
        asked.append(len(there[0]))
        if len(asked) == 1:
            there[0] = frozenset({"key0"})
            raise WorkerError("node 1 could not say which versions it has")
        return lambda node: node

    monkeypatch.setattr(cluster, "alive", lambda: there[0])
    monkeypatch.setattr(cluster, "_seen", seen)
    monkeypatch.setattr(cluster, "_nodes", lambda: (nodes_of((8, 0)), True))
    assert set(where(cluster.placed(run())).values()) == {(0, 0.0)} and asked == [2, 1]
    asked.clear()
    there[0] = frozenset({"key0"})
    with pytest.raises(WorkerError, match="could not say"):  # it is there, and broken
        cluster.placed(run())


def test_what_others_have_just_given_back_is_waited_for(monkeypatch: pytest.MonkeyPatch):
    looks = iter([(nodes_of((8, 1)), False), (nodes_of((8, 2)), False)])
    monkeypatch.setattr(cluster, "alive", frozenset)
    monkeypatch.setattr(cluster, "_seen", lambda config: lambda node: node)
    monkeypatch.setattr(cluster, "_nodes", lambda: next(looks))
    assert where(cluster.placed(run(ranks=2)))["trainer rank 1"] == (0, 0.6)
    monkeypatch.setattr(cluster, "_nodes", lambda: (nodes_of((8, 1)), True))
    with pytest.raises(InputError, match="2 ranks on 1 GPUs leave 1 without"):  # nothing is taken
        cluster.placed(run(ranks=2))
