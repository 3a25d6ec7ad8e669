# SPDX-License-Identifier: Apache-2.0
"""Both transports against the contract, and which of them an endpoint chooses."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest
import ray

from accerl_lerobot.transport import endpoint as module
from accerl_lerobot.transport.contract import Client, ServiceStoppedError
from accerl_lerobot.transport.endpoint import Endpoint, RayClient
from accerl_lerobot.transport.shared_memory import Address, available
from tests.transport.contract import CHECKS, Check, Service

NO_MEMORY = pytest.mark.skipif(not available(), reason="no memfd, epoll and eventfd here")
WAYS = [pytest.param("ray"), pytest.param("auto", marks=NO_MEMORY)]


@pytest.fixture(scope="module", params=WAYS)
def service(request: pytest.FixtureRequest, light_ray: None) -> Iterator[Endpoint]:
    actor = ray.remote(Service).options(num_cpus=0).remote()
    address = None if request.param == "ray" else ray.get(actor.listen.remote(), timeout=60)
    yield Endpoint(name="service", method=actor.obey, address=address)
    ray.kill(actor)


@pytest.fixture
def connect(service: Endpoint) -> Iterator[Callable[[], Client]]:
    made: list[Client] = []

    def make() -> Client:
        made.append(service.connect())
        return made[-1]

    yield make
    for caller in made:
        caller.close()


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
def test_contract(check: Check, connect: Callable[[], Client]):
    check(connect)


def test_an_endpoint_is_ended_a_moment_after_it_is_told(light_ray: None, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "LAST_WORDS_S", 1.0)
    actor = ray.remote(Service).options(num_cpus=0).remote()
    ray.get(actor.obey.remote(("pid", None)), timeout=60)
    Endpoint(name="service", method=None, actor=actor).kill()
    ray.get(actor.obey.remote(("pid", None)), timeout=60)
    with pytest.raises(ray.exceptions.RayActorError):
        for _ in range(600):
            time.sleep(0.1)
            ray.get(actor.obey.remote(("pid", None)), timeout=60)


HERE, ELSEWHERE = "this node", "another node"


def end(node: str | None) -> Endpoint:
    address = None if node is None else Address(node, "accerl-nobody")
    return Endpoint(name="inference", method=None, address=address)


def test_ray_leads_to_another_node_and_where_nobody_listens(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "this_node", lambda: HERE)
    assert isinstance(end(ELSEWHERE).connect(), RayClient)
    assert isinstance(end(None).connect(), RayClient)
    if available():  # it does not fall back
        with pytest.raises(ServiceStoppedError, match="inference cannot be connected to"):
            end(HERE).connect()
