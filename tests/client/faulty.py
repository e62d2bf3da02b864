"""A line to the service that breaks where a test wants it."""

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field


@dataclass
class Line:
    """Passes connections on to ``target``, and breaks some.

    Attributes
    ----------
    faults
        Of the next request that holds these bytes, so many bytes of the answer come through;
        then the connection breaks. They are used up in order.
    asked
        All that was sent to the service.
    open_back
        While it is not set, answers wait.
    """

    target: tuple[str, int]
    port: int
    faults: list[tuple[bytes, int]] = field(default_factory=list)
    asked: list[bytes] = field(default_factory=list)
    open_back: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        self.open_back.set()

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    @contextmanager
    def open(self) -> Iterator[None]:
        listener = socket.create_server(("127.0.0.1", self.port))
        accepting = threading.Thread(target=self._accept, args=(listener,), daemon=True)
        accepting.start()
        try:
            yield
        finally:
            with suppress(OSError):
                listener.shutdown(socket.SHUT_RDWR)
            listener.close()
            accepting.join()

    def _accept(self, listener: socket.socket) -> None:
        with suppress(OSError):
            while True:
                client, _ = listener.accept()
                passing = threading.Thread(target=self._pass_on, args=(client,), daemon=True)
                passing.start()

    def _pass_on(self, client: socket.socket) -> None:
        service = socket.create_connection(self.target)
        left: list[int] = []  # bytes that may still come back, once there is a fault

        def back() -> None:
            with suppress(OSError):
                while data := service.recv(1024):
                    self.open_back.wait()
                    if left and left[0] < len(data):
                        client.sendall(data[: left[0]])
                        break
                    client.sendall(data)
                    if left:
                        left[0] -= len(data)
            _close(client, service)

        answering = threading.Thread(target=back, daemon=True)
        answering.start()
        with suppress(OSError):
            while data := client.recv(65536):
                self.asked.append(data)
                if self.faults and self.faults[0][0] in data:
                    left.append(self.faults.pop(0)[1])
                service.sendall(data)
        _close(client, service)
        answering.join()


def _close(*ends: socket.socket) -> None:
    for end in ends:
        with suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)
        end.close()
