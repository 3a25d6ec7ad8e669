# SPDX-License-Identifier: Apache-2.0
"""How the first rank deals with the others: real Ray actors that do what they are told, fail, die or hang."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import ray

from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.trainer.peers import Peers

THREE = TrainerConfig(ranks=3)
WAIT_S = 2.0


class LightRank:
    """Answers `step` in the way it is asked to."""

    def __init__(self) -> None:
        self.steps = 0

    def step(self, how: str) -> int:
        if how == "dies":
            os._exit(1)
        if how == "hangs":
            time.sleep(60)
        if how == "fails":
            raise ArithmeticError("the gradient fell over")
        self.steps += 1
        return self.steps

    def made(self) -> int:
        return self.steps


class Split:
    """Rank 2 does something else than rank 1."""

    def __init__(self, actor: Any, how: str) -> None:
        self.step = self
        self._actor, self._how = actor, how

    def remote(self, _: str) -> Any:
        return self._actor.step.remote(self._how)


@pytest.fixture
def peers(light_ray: None) -> Iterator[Callable[[str, str], Peers]]:
    actors: list[Any] = []

    def make(first: str, second: str) -> Peers:
        actors.extend(ray.remote(LightRank).options(num_cpus=0).remote() for _ in range(2))
        ray.get([actor.made.remote() for actor in actors])
        return Peers([Split(actors[-2], first), Split(actors[-1], second)], THREE, WAIT_S)

    yield make
    for actor in actors:
        ray.kill(actor)


def test_they_have_done_it_when_the_first_goes_on(peers: Callable[[str, str], Peers]):
    both = peers("fine", "fine")
    for _ in range(3):
        with both.joining("step", ""):
            pass
    assert [ray.get(actor._actor.made.remote()) for actor in both._actors] == [3, 3]


@pytest.mark.parametrize(
    ("how", "error"), [("fails", "the gradient fell over"), ("dies", "died"), ("hangs", "Get timed out")]
)
def test_a_rank_that_is_lost_ends_the_wait(peers: Callable[[str, str], Peers], how: str, error: str):
    with pytest.raises(ray.exceptions.RayError, match=error), peers("fine", how).joining("step", ""):
        pass


def test_an_error_of_the_first_is_its_own(peers: Callable[[str, str], Peers]):
    with pytest.raises(KeyError, match="mine"), peers("hangs", "hangs").joining("step", ""):
        raise KeyError("mine")


def test_ranks_talk_over_the_interface_that_has_the_address(monkeypatch: pytest.MonkeyPatch):
    from accerl_lerobot.algorithms import ranks

    for name in ("GLOO_SOCKET_IFNAME", "NCCL_SOCKET_IFNAME"):
        monkeypatch.setenv(name, "")
    at = SimpleNamespace
    faces = {"lo": [at(address="127.0.0.1")], "a": [at(address="fe80::1"), at(address="10.0.0.2")], "b": []}
    monkeypatch.setattr(ranks.psutil, "net_if_addrs", lambda: faces)
    ranks.use_only("127.0.0.1")
    assert (os.environ["GLOO_SOCKET_IFNAME"], os.environ["NCCL_SOCKET_IFNAME"]) == ("lo", "")
    ranks.use_only("10.0.0.2")
    assert (os.environ["GLOO_SOCKET_IFNAME"], os.environ["NCCL_SOCKET_IFNAME"]) == ("a", "a")
    with pytest.raises(RuntimeError, match=r"no interface of this machine has the address 10\.0\.0\.3"):
        ranks.use_only("10.0.0.3")
