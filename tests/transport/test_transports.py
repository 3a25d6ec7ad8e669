# SPDX-License-Identifier: Apache-2.0
"""Both transports against the contract, and which of them an endpoint chooses."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import ray

from accerl_lerobot.errors import InputError
from accerl_lerobot.transport import endpoint as module
from accerl_lerobot.transport.contract import Client, ServiceStoppedError
from accerl_lerobot.transport.endpoint import Endpoint, RayClient, Transport, uses_shared_memory
from accerl_lerobot.transport.memfd import available
from accerl_lerobot.transport.shared_memory import Address, SharedMemoryClient
from tests.light_workers import LightInference, light_ray
from tests.transport.contract import CHECKS, Check, Service, messages, same

__all__ = ["light_ray"]

NO_MEMORY = pytest.mark.skipif(not available(), reason="no memfd, epoll and eventfd here")
WAYS = [pytest.param("ray"), pytest.param("shared_memory", marks=NO_MEMORY)]


def endpoint_of(actor: Any, method: str, transport: Transport) -> Endpoint:
    address = None if transport == "ray" else ray.get(actor.listen.remote(), timeout=60)
    return Endpoint(name="service", method=getattr(actor, method), address=address, transport=transport)


@pytest.fixture(scope="module", params=WAYS)
def service(request: pytest.FixtureRequest, light_ray: None) -> Iterator[Endpoint]:
    actor = ray.remote(Service).options(num_cpus=0).remote()
    yield endpoint_of(actor, "obey", request.param)
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


@NO_MEMORY
def test_both_give_the_same_decisions(light_ray: None):
    actor = ray.remote(LightInference).options(num_cpus=0).remote()
    requests = messages()[1]
    callers = [endpoint_of(actor, "decide", way).connect() for way in ("ray", "shared_memory")]
    assert [type(caller) for caller in callers] == [RayClient, SharedMemoryClient]
    through_ray, through_memory = (caller.ask([requests, requests[:1]], 60.0) for caller in callers)
    assert same(through_ray, through_memory) and [len(some) for some in through_ray] == [2, 1]
    ray.kill(actor)


HERE, ELSEWHERE = "this node", "another node"


@pytest.fixture
def nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "this_node", lambda: HERE)


def end(node: str | None, transport: Transport) -> Endpoint:
    address = None if node is None else Address(node, "accerl-nobody")
    return Endpoint(name="inference", method=None, address=address, transport=transport)


def test_auto_is_ray_for_another_node_and_where_nobody_listens(nodes: None):
    assert isinstance(end(ELSEWHERE, "auto").connect(), RayClient)
    assert isinstance(end(None, "auto").connect(), RayClient)
    assert isinstance(end(None, "ray").connect(), RayClient)


@NO_MEMORY
def test_auto_is_shared_memory_on_one_node_and_does_not_fall_back(nodes: None):
    with pytest.raises(ServiceStoppedError, match="inference cannot be connected to"):
        end(HERE, "auto").connect()


def test_shared_memory_between_nodes_is_refused(nodes: None):
    with pytest.raises(InputError, match="inference is on another node; use auto or ray"):
        end(ELSEWHERE, "shared_memory").connect()


def test_what_the_system_does_not_have_is_refused_when_it_is_asked_for(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "available", lambda: False)
    assert not uses_shared_memory("auto") and not uses_shared_memory("ray")
    with pytest.raises(InputError, match=r"launch.transport='shared_memory': this system has no memfd"):
        uses_shared_memory("shared_memory")


@NO_MEMORY
def test_where_there_is_shared_memory_it_is_offered_unless_ray_is_asked_for():
    assert (
        uses_shared_memory("auto") and uses_shared_memory("shared_memory") and not uses_shared_memory("ray")
    )
