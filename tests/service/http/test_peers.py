"""Who is at the other end of a connection over loopback, with clients and servers of two users."""

import os
import select
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import httpx2
import pytest
import uvicorn
from websockets.sync.client import connect

from service.http.connections import Connection
from service.http.peers import Peer, peer_uid
from worker.process import tied

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="only root can be several users")
NOBODY, SOMEBODY, ANYBODY = 65534, 12345, 12346  # the first is whom the kernel names for unknown

BECOME = """
import os, socket, struct, sys
def become(uid):
    os.setgroups([]), os.setresgid(uid, uid, uid), os.setresuid(uid, uid, uid)
"""
# Connects as a user, sends a request, then does what comes by stdin, a word a line.
CLIENT = f"""{BECOME}
uid, host, port, local = int(sys.argv[1]), sys.argv[2], int(sys.argv[3]), int(sys.argv[4])
become(uid)
client = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
client.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
if local:
    client.bind((host, local))
client.connect((host, port))
client.sendall(b"".join(line.encode() + b"\\r\\n" for line in [*sys.argv[5:], ""]))
print(client.getsockname()[1], flush=True)
for word in map(str.strip, sys.stdin):
    if word == "shut":
        client.shutdown(socket.SHUT_WR)
    elif word == "reset":
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        client.close()
    elif word == "close":
        client.close()
    elif word == "read":
        answer = b""
        while b"True" not in answer and b"False" not in answer and (piece := client.recv(4096)):
            answer += piece
        word = b"True" in answer
    print(word, flush=True)
"""
# Listens as a user, and prints for every connection whether its other end is trusted.
SERVER = f"""{BECOME}
import resource
from service.http.peers import Peer
become(int(sys.argv[1]))
listener = socket.create_server(("127.0.0.1", 0))
print(listener.getsockname()[1], flush=True)
for word in sys.stdin:
    connection, _ = listener.accept()
    peer = Peer(connection)
    if word.strip() == "full":
        most = connection.fileno() + 1
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    print(peer.trusted, flush=True)
    del connection
"""
# In a network namespace of its own, connects to itself and gives the server's end away.
ELSEWHERE = """
import ctypes, fcntl, socket, struct, sys
libc = ctypes.CDLL(None, use_errno=True)
if libc.unshare(0x40000000):  # CLONE_NEWNET
    sys.exit(3)
with socket.socket() as any_socket:  # SIOCSIFFLAGS: lo is up
    fcntl.ioctl(any_socket, 0x8914, struct.pack("16sH22x", b"lo", 1))
listener = socket.create_server(("127.0.0.1", int(sys.argv[2])))
here = ("127.0.0.1", int(sys.argv[3]))
client = socket.create_connection(listener.getsockname(), source_address=here)
connection, _ = listener.accept()
with socket.socket(fileno=int(sys.argv[1])) as channel:
    socket.send_fds(channel, [b"."], [connection.fileno()])
sys.stdin.read()
"""


class Child:
    """A process that answers a line with a line."""

    def __init__(self, code: str, *arguments: object, **more: Any) -> None:
        self.process = subprocess.Popen(
            tied(sys.executable, "-c", code, *map(str, arguments)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            **more,
        )

    def read(self) -> str:
        assert self.process.stdout is not None
        return str(self.process.stdout.readline()).strip()

    def ask(self, word: str) -> str:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{word}\n")
        self.process.stdin.flush()
        return self.read()


@contextmanager
def child(code: str, *arguments: object, **more: Any) -> Iterator[Child]:
    made = Child(code, *arguments, **more)
    with made.process as process:
        try:
            yield made
        finally:
            process.kill()


@contextmanager
def accepted(
    uid: int, listener: socket.socket, host: str = "127.0.0.1", local: int = 0
) -> Iterator[tuple[Child, socket.socket, tuple[str, int], tuple[str, int]]]:
    """Give a client of a user, our end of its connection, and the addresses of both ends."""
    with child(CLIENT, uid, host, listener.getsockname()[1], local, "DELETE /datasets") as client:
        port = int(client.read())
        connection, address = listener.accept()
        with connection:
            assert address[1] == port
            yield client, connection, address[:2], connection.getsockname()[:2]


def listen(host: str = "127.0.0.1", *, dual: bool = False) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.create_server((host, 0), family=family, dualstack_ipv6=dual)
    listener.settimeout(20)
    return listener


def reserved_port() -> int:
    """Return a free port that the system gives to nobody who does not ask for it by number."""
    least = int(Path("/proc/sys/net/ipv4/ip_local_port_range").read_text().split()[0])
    for port in range(least - 1, 1024, -1):
        with socket.socket() as tried, suppress(OSError):
            tried.bind(("127.0.0.1", port))
            return port
    raise AssertionError("no port is free")


ROADS = [
    ("127.0.0.1", "127.0.0.1", False),
    ("127.0.0.1", "127.0.0.1", True),  # IPv4 that comes to a socket of both
    ("::1", "::1", False),
    ("::1", "::1", True),
    ("::ffff:127.0.0.1", "::ffff:127.0.0.1", True),  # written as IPv6 by the client too
]


@pytest.mark.parametrize(("host", "seen", "dual"), ROADS)
def test_the_kernel_knows_the_user_at_the_other_end(host: str, seen: str, dual: bool) -> None:
    with listen("::" if dual else host, dual=dual) as listener:
        for uid in (0, NOBODY, SOMEBODY):
            with accepted(uid, listener, host) as (_, connection, theirs, ours):
                assert seen in theirs[0]
                assert peer_uid(theirs, ours) == uid
                assert Peer(connection).trusted == (uid == 0)


@pytest.mark.parametrize("word", ["close", "reset"])
def test_who_sends_and_closes_at_once_is_not_known(word: str) -> None:
    """The kernel names root for sockets that nobody has any more."""
    for uid in (NOBODY, 0):
        with listen() as listener, accepted(uid, listener) as (client, connection, theirs, ours):
            peer = Peer(connection)
            client.ask(word)
            select.select([connection], [], [], 20)
            assert peer_uid(theirs, ours) is None
            assert not peer.trusted
            assert not Peer(connection).trusted


def test_who_closes_after_our_end_did_is_not_known() -> None:
    """Its socket is in TIME_WAIT, or still waits for our last word."""
    with listen() as listener, accepted(NOBODY, listener) as (client, connection, theirs, ours):
        peer = Peer(connection)
        connection.shutdown(socket.SHUT_WR)
        assert peer_uid(theirs, ours) == NOBODY
        client.ask("close")
        assert peer_uid(theirs, ours) is None
        assert not peer.trusted


def test_who_only_stops_writing_is_still_known() -> None:
    for uid in (NOBODY, 0):
        with listen() as listener, accepted(uid, listener) as (client, connection, theirs, ours):
            client.ask("shut")
            while connection.recv(4096):
                pass
            assert peer_uid(theirs, ours) == uid
            assert Peer(connection).trusted == (uid == 0)


def test_who_takes_over_the_port_of_a_client_does_not_answer_for_it() -> None:
    """Its request may still be read after the client has broken the connection off."""
    port = reserved_port()
    with (
        listen() as listener,
        accepted(NOBODY, listener, local=port) as (client, lost, theirs, ours),
    ):
        peer = Peer(lost)
        client.ask("reset")
        with accepted(0, listener, local=theirs[1]) as (_, ours_now, again, _):
            assert again == theirs
            assert lost.recv(6) == b"DELETE"
            assert peer_uid(theirs, ours) == 0
            assert not peer.trusted
            assert not Peer(lost).trusted
            assert Peer(ours_now).trusted


def test_the_answer_is_asked_for_once() -> None:
    with listen() as listener, accepted(0, listener) as (client, connection, _, _):
        peer = Peer(connection)
        assert peer.trusted
        client.ask("close")
        assert peer.trusted  # what it has sent before is its own
    with listen() as listener, accepted(0, listener) as (client, connection, _, _):
        peer = Peer(connection)
        client.ask("close")
        assert not peer.trusted


@pytest.mark.parametrize(
    ("server", "trusted"),
    [
        (0, {0}),
        (SOMEBODY, {0, SOMEBODY}),
        (NOBODY, {0}),  # it stands for everybody whom a user namespace does not know
    ],
)
def test_trusted_are_root_and_the_user_of_the_service(server: int, trusted: set[int]) -> None:
    with child(SERVER, server) as service:
        port = service.read()
        for uid in (0, SOMEBODY, ANYBODY, NOBODY):
            with child(CLIENT, uid, "127.0.0.1", port, 0) as client:
                client.read()
                assert service.ask("tell") == str(uid in trusted)


def test_whoever_cannot_be_asked_for_is_not_trusted() -> None:
    """A question to the kernel takes a descriptor, and there is none."""
    with child(SERVER, 0) as service, child(CLIENT, 0, "127.0.0.1", service.read(), 0) as client:
        client.read()
        assert service.ask("full") == "False"


def test_a_connection_over_another_address_of_this_machine_is_nobodys() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as way_out:
        try:
            way_out.connect(("192.0.2.1", 9))  # sends nothing
        except OSError:
            pytest.skip("this machine has no address but loopback")
        address = way_out.getsockname()[0]
    for host in ("0.0.0.0", "::"):  # noqa: S104
        listener = listen(host, dual=host == "::")
        with listener, accepted(0, listener, address) as (_, connection, theirs, ours):
            assert peer_uid(theirs, ours) is None
            assert not Peer(connection).trusted


def test_a_connection_of_another_network_namespace_is_nobodys() -> None:
    """Even where the same addresses and ports are a connection of ours here."""
    with listen() as listener, accepted(0, listener) as (_, here, theirs, ours):
        receiving, giving = socket.socketpair()
        with (
            child(
                *(ELSEWHERE, giving.fileno(), ours[1], theirs[1]), pass_fds=[giving.fileno()]
            ) as other,
            receiving,
        ):
            giving.close()
            receiving.settimeout(20)
            _, descriptors, _, _ = socket.recv_fds(receiving, 1, 1)
            if not descriptors and other.process.wait(20) == 3:
                pytest.skip("no network namespace may be made here")
            with socket.socket(fileno=descriptors[0]) as there:
                assert (there.getpeername(), there.getsockname()) == (theirs, ours)
                assert Peer(here).trusted
                assert not Peer(there).trusted


@pytest.mark.parametrize(
    ("client", "server"),
    [
        (("127.0.0.1", 1), ("127.0.0.1", 1)),  # no such connection
        (("127.0.0.1", 99_999), ("127.0.0.1", 8000)),
        (("127.0.0.1", -1), ("127.0.0.1", 8000)),
        (("127.0.0.1", 5000), ("::1", 8000)),
        (("localhost", 5000), ("127.0.0.1", 8000)),
        (("", 0), ("", 0)),
        (("\0" * 9, 5000), ("127.0.0.1", 8000)),
    ],
)
def test_what_is_no_connection_is_nobodys(client: tuple[str, int], server: tuple[str, int]) -> None:
    assert peer_uid(client, server) is None


def test_what_only_listens_is_at_no_end() -> None:
    with listen() as listener:
        end = listener.getsockname()
        assert peer_uid(end, end) is None
        assert not Peer(listener).trusted
    here, there = socket.socketpair()
    with here, there:
        assert not Peer(here).trusted
    assert not Peer(here).trusted  # closed
    assert not Peer(None).trusted


# --- as requests find it --------------------------------------------------------------------------


async def telling(scope: Any, receive: Callable[[], Any], send: Callable[[Any], Any]) -> None:
    """Answer whether the other end is trusted, and which object knows it."""
    peer = scope["state"]["peer"]
    text = f"{peer.trusted} {id(peer)}"
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.accept"})
        await send({"type": "websocket.send", "text": text})
        await send({"type": "websocket.close"})
        return
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": text.encode()})


@pytest.fixture(scope="module")
def port() -> Iterator[int]:
    connection: Any = partial(Connection, seconds=20, on_refusal=lambda *_: None)
    config = uvicorn.Config(
        telling, loop="uvloop", http=connection, ws="websockets-sansio", lifespan="off"
    )
    server = uvicorn.Server(config)
    with listen() as listener:
        listener.settimeout(None)
        serving = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        serving.start()
        yield listener.getsockname()[1]
        server.should_exit = True
        serving.join()


def test_all_requests_of_a_connection_have_one_peer_and_others_another(port: int) -> None:
    url = f"http://127.0.0.1:{port}"
    with (
        httpx2.Client(base_url=url, trust_env=False) as one,
        httpx2.Client(base_url=url, trust_env=False) as other,
    ):
        first, second, again = (http.get("/").text for http in (one, other, one))
        assert first.startswith("True ")
        assert again == first != second


def test_a_websocket_has_the_peer_of_its_connection(port: int) -> None:
    with connect(f"ws://127.0.0.1:{port}/", proxy=None) as stream:
        assert str(stream.recv(20)).startswith("True ")


def test_another_user_is_recognised_over_http(port: int) -> None:
    upgrade = (
        *("Connection: Upgrade", "Upgrade: websocket", "Sec-WebSocket-Version: 13"),
        f"Sec-WebSocket-Key: {'A' * 22}==",
    )
    for uid in (0, NOBODY):
        for headers in ((), upgrade):
            request = ("GET / HTTP/1.1", "Host: localhost", *headers)
            with child(CLIENT, uid, "127.0.0.1", port, 0, *request) as client:
                client.read()
                assert client.ask("read") == str(uid == 0)
