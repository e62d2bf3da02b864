"""A proxy that gives the service a prefix, as an institute's web server would."""

import http.client
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import urlsplit


@contextmanager
def proxied(service: str, prefix: str) -> Iterator[str]:
    """Forward what comes below a prefix to the service; yield the address with the prefix."""
    target = urlsplit(service).netloc

    class Forward(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def forward(self) -> None:
            if not self.path.startswith(f"{prefix}/"):
                self.send_error(404)
                return
            length = int(self.headers.get("Content-Length") or 0)
            connection = http.client.HTTPConnection(target)
            connection.request(
                self.command,
                self.path.removeprefix(prefix),
                self.rfile.read(length) or None,
                {**dict(self.headers.items()), "X-Forwarded-For": "192.0.2.7"},
            )
            answer = connection.getresponse()
            body = answer.read()
            self.send_response(answer.status)
            for name, value in answer.getheaders():
                if name.lower() not in ("transfer-encoding", "content-length", "connection"):
                    self.send_header(name, value)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)
            connection.close()

        do_GET = do_POST = forward  # noqa: N815 (names that the base class asks for)

        def log_message(self, *_words: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Forward) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}{prefix}"
        server.shutdown()
