# SPDX-License-Identifier: Apache-2.0
"""How the first rank deals with the others: real Ray actors that do what they are told, fail, die or hang."""

import os
import time
from types import SimpleNamespace
from typing import Any

import pytest
import ray

from accerl_lerobot.algorithms import ranks as rank_module
from accerl_lerobot.algorithms.config import TrainerConfig
from accerl_lerobot.trainer.worker import Peers


class LightRank:
    def step(self, how: str) -> None:
        if how == "dies":
            os._exit(1)
        if how == "hangs":
            time.sleep(60)
        if how == "fails":
            raise ArithmeticError("the gradient fell over")


@pytest.mark.parametrize(
    ("how", "error"), [("fails", "the gradient fell over"), ("dies", "died"), ("hangs", "Get timed out")]
)
def test_a_rank_that_is_lost_ends_the_wait(light_ray: None, how: str, error: str):
    actor: Any = ray.remote(LightRank).options(num_cpus=0).remote()
    assert ray.get(actor.__ray_ready__.remote())
    peers = Peers([actor], TrainerConfig(ranks=2), 2.0)
    with peers.joining("step", "fine"):
        pass
    with pytest.raises(ray.exceptions.RayError, match=error), peers.joining("step", how):
        pass
    ray.kill(actor)


def test_ranks_talk_over_the_interface_that_has_the_address(monkeypatch: pytest.MonkeyPatch):
    names = ("GLOO_SOCKET_IFNAME", "NCCL_SOCKET_IFNAME")
    for name in names:
        monkeypatch.setenv(name, "")
    at = SimpleNamespace
    faces = {"lo": [at(address="127.0.0.1")], "a": [at(address="fe80::1"), at(address="10.0.0.2")], "b": []}
    monkeypatch.setattr(rank_module.psutil, "net_if_addrs", lambda: faces)
    for address, expected in (("127.0.0.1", ["lo", ""]), ("10.0.0.2", ["a", "a"])):
        rank_module.use_only(address)
        assert [os.environ[name] for name in names] == expected
    with pytest.raises(RuntimeError, match=r"no interface of this machine has the address 10\.0\.0\.3"):
        rank_module.use_only("10.0.0.3")
