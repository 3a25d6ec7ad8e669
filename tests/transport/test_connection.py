# SPDX-License-Identifier: Apache-2.0
"""Messages over sockets: the promises at the top of `transport`; which weights replicas get."""

import copy
import socket
import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from accerl_lerobot import transport
from accerl_lerobot.experience import Decision, Request
from accerl_lerobot.trainer import worker
from accerl_lerobot.trainer.worker import WeightPublisher
from accerl_lerobot.transport import Client, PendingRequest, ReconnectingClient, Server, ServiceStoppedError
from tests.replay.segments import make_segment
from tests.runs import eventually

LONG_S = 120.0


class Service:
    """A service on a thread, which echoes, holds or fails as a message says."""

    def __init__(self, host: str | None) -> None:
        self.held: list[PendingRequest] = []
        self.server = Server(self._take, host)
        self.over = False
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def client(self) -> Client:
        return Client("service", self.server.address)

    def _serve(self) -> None:
        while not self.over:
            self.server.poll(1.0)

    def _take(self, request: PendingRequest) -> None:
        what, value = request.message
        if what == "hold":
            self.held.append(request)
        elif what == "fail":
            request.answer(value, failed=True)
        else:
            request.answer(value)
        if what == "release":
            for held in self.held:
                held.answer(held.message[1])

    def close(self) -> None:
        if not self.over:
            self.over = True
            self.server.wake()
            self._thread.join()
            self.server.close()


@pytest.fixture(params=[None, "127.0.0.1"], ids=["unix", "tcp"])
def service(request: pytest.FixtureRequest) -> Iterator[Service]:
    made = Service(request.param)
    yield made
    made.close()


def ask(client: Client, *messages: Any) -> list[Any]:
    """Replies in the order of the messages."""
    return awaited(client, [client.send(message) for message in messages])


def awaited(client: Client, tickets: list[int]) -> list[Any]:
    replies: dict[int, Any] = {}
    while len(replies) < len(tickets):
        more = client.done(LONG_S)
        assert more, "it takes too long"
        replies |= more
    return [replies[ticket] for ticket in tickets]


def parts(message: Any) -> Any:
    """What a message is made of, with types, dtypes and shapes."""
    if isinstance(message, np.ndarray | np.generic):
        return message.dtype, message.shape, message.tobytes()
    if isinstance(message, dict):
        return [(key, parts(value)) for key, value in message.items()]
    if isinstance(message, list | tuple):
        return type(message), [parts(value) for value in message]
    return type(message), parts(vars(message)) if hasattr(message, "__dict__") else repr(message)


def test_what_is_sent_arrives_whole_and_can_be_written_to(service: Service):
    client, image = service.client(), np.arange(96 * 64 * 3, dtype=np.uint8).reshape(96, 64, 3)
    chunk = np.random.default_rng(0).normal(size=(4, 2)).astype(np.float32)
    arrays = {
        "strided": image[::2, :, 1],
        "turned": np.arange(12_000, dtype=np.float64).reshape(30, 400).T,
        "none": np.zeros((0, 3), np.float32),
        "scalar": np.array(0.5, np.float16),
        "other way round": np.arange(3000, dtype=">i4"),
    }
    observation = {"observation.images.front": image, "observation.state": chunk, "task": "öffne 🚪"}
    for message in (
        arrays,
        [Request(observation=observation, noise_seed=2**63 + 5), Request(observation={}, noise_seed=0)],
        [Decision(chunk=chunk, latent={"x": chunk}, log_prob=chunk[0], version=2**40)],
        [make_segment("a", 3), make_segment("b", 2)],
        [True, None, 1, -0.0, float("inf"), "", (1, [2, {3: {}}])],
    ):
        (reply,) = ask(client, ("echo", message))
        assert parts(reply) == parts(message)
    (reply,) = ask(client, ("echo", np.zeros(100_000)))
    reply += 1
    client.close()


def test_replies_go_to_the_messages_they_answer_and_to_their_client(service: Service):
    clients = [service.client() for _ in range(3)]
    late = clients[0].send(("hold", "late"))
    assert ask(clients[0], *(("echo", i) for i in range(8))) == list(range(8))
    assert ask(clients[1], ("echo", "other")) == ["other"]
    clients[1].close()
    assert ask(clients[2], ("release", None), ("echo", 1)) == [None, 1]
    assert clients[0].done(LONG_S) == [(late, "late")] and clients[0].done(0.0) == []


def test_many_large_messages_are_under_way_and_their_arrays_may_change(service: Service):
    """Neither end waits for the other to read first."""
    client = service.client()
    sizes = [10, 300_000, 70, 5_000_000, 0, *[400_000] * 12]
    array = np.empty(max(sizes), np.uint8)
    tickets = []
    for i, size in enumerate(sizes):
        array[:] = i
        tickets.append(client.send(("echo", array[:size])))
    array[:] = 255
    replies = awaited(client, tickets)
    assert [len(reply) for reply in replies] == sizes
    assert all((reply == i).all() for i, reply in enumerate(replies))


def test_no_end_waits_for_one_that_reads_nothing(monkeypatch: pytest.MonkeyPatch):
    """A message to a service that has stopped, and a reply to such a client, are kept."""
    monkeypatch.setattr(transport, "SEND_S", 0.05)
    requests: list[PendingRequest] = []
    server = Server(requests.append)
    client = Client("service", server.address)
    large = np.arange(3_000_000)
    started = time.monotonic()
    client.send(large)
    assert client.done(0.01) == [] and time.monotonic() - started < LONG_S
    while not requests:
        server.poll(0.01)
        client.done(0.0)
    requests[0].answer(large)
    while not (replies := client.done(0.0)):
        server.poll(0.01)
    np.testing.assert_array_equal(replies[0][1], large)
    server.close()


def test_a_client_learns_that_the_service_has_failed_or_is_gone(service: Service):
    client = service.client()
    client.send(("fail", "it fell over"))
    with pytest.raises(ServiceStoppedError, match=r"service: .*it fell over"):
        client.done(LONG_S)
    client.send(("hold", 1))
    new = service.client()  # which may not have been served yet
    service.close()
    for late in (client, new):
        with pytest.raises(ServiceStoppedError, match="service is gone"):
            late.done(LONG_S)
    with pytest.raises(ServiceStoppedError, match="service cannot be connected to"):
        service.client()


def test_what_a_client_that_is_gone_had_asked_is_forgotten(service: Service):
    client = service.client()
    client.send(("hold", np.zeros(100_000)))
    ask(client, ("echo", None))
    (request,) = service.held
    assert not request.gone()
    client.close()
    assert eventually(request.gone)
    request.answer("nobody is there")
    assert ask(Client("other", service.server.address), ("echo", 1)) == [1]


def test_who_does_not_know_the_key_is_refused_before_anything_is_read(service: Service):
    address = service.server.address
    with pytest.raises(ServiceStoppedError, match="cannot be connected to"):
        Client("service", transport.Address(address.at, b"another key"))
    family = socket.AF_UNIX if isinstance(address.at, str) else socket.AF_INET
    with socket.socket(family) as end:
        end.connect(address.at)
        end.sendall(b"cos\nsystem\n(S'exit'\ntR." * 100)
        assert ask(Client("service", address), ("echo", 1)) == [1]


def test_a_message_is_as_old_as_its_sender_says_if_that_can_be(monkeypatch: pytest.MonkeyPatch):
    taken: list[PendingRequest] = []
    server = Server(taken.append)
    client = Client("service", server.address)
    before = time.monotonic()
    client.send("now")
    time.sleep(0.1)
    monkeypatch.setattr(transport.time, "monotonic", lambda now=time.monotonic: now() - 1e6)
    client.send("of a node that has just been started")
    monkeypatch.undo()
    while len(taken) < 2:
        server.poll(1.0)
    assert 0 <= taken[0].sent - before < 0.1, "it was read later"
    assert 0 <= time.monotonic() - taken[1].sent < 60
    server.close()


def test_what_was_not_answered_is_asked_again_in_order_under_the_same_ticket(monkeypatch: Any):
    monkeypatch.setattr(transport, "RETRY_S", 0.0)
    services = [Service(None)]
    client: Any = ReconnectingClient(SimpleNamespace(connect=lambda timeout_s: services[-1].client()))
    tickets = [client.send(message) for message in (("hold", "a"), ("echo", "b"), ("hold", "c"))]
    assert client.done(LONG_S) == [(tickets[1], "b")]
    services[-1].close()
    assert client.done(LONG_S) == []
    tickets += [client.send(("hold", "d"))]  # while nobody is there
    for _ in range(2):  # the second one is lost as well
        assert client.done(0.0) == []
        services.append(Service(None))
        assert client.done(0.0) == [] and eventually(lambda: len(services[-1].held) == 3)
        assert [request.message[1] for request in services[-1].held] == ["a", "c", "d"]
        if len(services) == 2:
            services[-1].close()
            assert client.done(LONG_S) == []
    tickets += [client.send(("release", "e"))]
    del tickets[1]
    assert awaited(client, tickets) == ["a", "c", "d", "e"]
    services[-1].close()


def test_a_replica_gets_the_newest_set_and_waits_for_a_newer_one_not_for_ever(monkeypatch: Any):
    publisher, tensor = WeightPublisher(["inference"], copy.deepcopy), np.zeros(3)
    for version in range(5):
        tensor[:] = version
        publisher.publish(version, {"w": tensor})
    tensor[:] = -1
    version, (newest,) = publisher.next_weights("inference", -1)
    assert version == 4 and (newest["w"] == 4).all()
    threading.Timer(0.05, publisher.publish, (5, {})).start()
    assert publisher.next_weights("inference", 4) == (5, [{}])
    monkeypatch.setattr(worker, "ASK_S", 0.01)
    assert publisher.next_weights("inference", 5) == (5, [])


def test_flush_waits_until_each_replica_has_applied_the_newest(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(worker, "ASK_S", 0.0)
    publisher = WeightPublisher(["inference 0", "inference 1"], copy.deepcopy)
    publisher.wait_until_applied(30)
    publisher.publish(1, {})
    publisher.next_weights("inference 0", 1)
    publisher.next_weights("inference 1", 0)
    with pytest.raises(TimeoutError, match=r"weights not applied within 0\.1 s by inference 1"):
        publisher.wait_until_applied(0.1)
    threading.Timer(0.05, publisher.next_weights, ("inference 1", 1)).start()
    publisher.wait_until_applied(30)
