# SPDX-License-Identifier: Apache-2.0
"""Both transports against the contract, and which of them an endpoint chooses."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
import ray

from accerl_lerobot.transport import endpoint as module
from accerl_lerobot.transport.contract import Client, ServiceStoppedError
from accerl_lerobot.transport.endpoint import Endpoint, RayClient
from accerl_lerobot.transport.shared_memory import Address, available
from tests.light_workers import light_ray
from tests.transport.contract import CHECKS, Check, Service

__all__ = ["light_ray"]

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
