"""The keys that a process holds valid, while several threads read them."""

import threading
from collections.abc import Iterator, Mapping

from starlette.testclient import TestClient

from service.http.keyring import Caller, Keyring
from store import access_keys
from store.access_keys import SCOPES
from store.database import Store


class Gate(Mapping[str, Caller]):
    """No fixed callers. Who reads them first after `opened` is cleared waits for it."""

    def __init__(self) -> None:
        self.reached, self.opened = threading.Event(), threading.Event()
        self.opened.set()

    def __getitem__(self, digest: str) -> Caller:
        raise KeyError(digest)

    def __len__(self) -> int:
        return 0

    def __iter__(self) -> Iterator[str]:
        if not self.opened.is_set() and not self.reached.is_set():
            self.reached.set()
            self.opened.wait(10)
        return iter(())


def test_a_reader_that_began_before_a_revocation_does_not_bring_the_key_back(
    api: TestClient,
) -> None:
    store: Store = api.app.state.store  # type: ignore[attr-defined]
    record, token = access_keys.create(store, name="test", scopes=SCOPES)
    gate = Gate()
    keyring = Keyring(store, gate)
    keyring.close()  # its own thread reads no more
    assert keyring.find(token) is not None
    gate.opened.clear()
    early, late = (threading.Thread(target=keyring.look) for _ in range(2))
    early.start()
    assert gate.reached.wait(10)
    access_keys.revoke(store, record.id)
    late.start()
    late.join(0.2)
    gate.opened.set()
    early.join(10)
    late.join(10)
    assert keyring.find(token) is None
