"""Servers of HTTP and of WebSockets that note which keys come, and answer as a test wants."""

import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

from websockets.http11 import Request, Response
from websockets.sync.server import ServerConnection, serve


class Heard(ThreadingHTTPServer):
    """An HTTP server that notes who comes, and answers as a test wants."""

    daemon_threads = True

    def __init__(self, host: str) -> None:
        self.keys: list[str | None] = []  # of every request
        self.status, self.headers, self.body = 200, dict[str, str](), b'{"service": "1", "api": 1}'
        if ":" in host:
            self.address_family = socket.AF_INET6
        super().__init__((host, 0), _Answering)

    @property
    def port(self) -> int:
        return int(self.server_address[1])


class _Answering(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        server = self.server
        assert isinstance(server, Heard)
        server.keys.append(self.headers["Authorization"])
        self.send_response(server.status)
        for name, value in {**server.headers, "Content-Length": str(len(server.body))}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(server.body)

    def log_message(self, *_arguments: object) -> None:
        pass


@contextmanager
def heard(host: str = "127.0.0.1") -> Iterator[Heard]:
    with Heard(host) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        try:
            yield server
        finally:
            server.shutdown()
            thread.join()


@contextmanager
def hearing_streams(
    answer: Callable[[], tuple[HTTPStatus, Mapping[str, str], str]],
) -> Iterator[tuple[int, list[str | None]]]:
    """Give the port of a server of WebSockets that opens none, and the keys that came."""
    keys: list[str | None] = []

    def refuse(connection: ServerConnection, request: Request) -> Response:
        keys.append(request.headers.get("Authorization"))
        status, headers, text = answer()
        response = connection.respond(status, text)
        response.headers.update(headers)
        return response

    with ExitStack() as stack:
        server = serve(lambda _: None, "127.0.0.1", 0, process_request=refuse)
        stack.enter_context(server)
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        stack.callback(thread.join)
        stack.callback(server.shutdown)
        yield server.socket.getsockname()[1], keys
