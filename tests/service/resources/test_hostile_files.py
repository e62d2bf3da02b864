"""Files that are small and ask for much: memory, time, space on the disk."""

import json
import os
import struct
from collections.abc import Callable

import httpx2
import pytest
from starlette.testclient import TestClient

from store import access_keys
from store.access_keys import SCOPES
from store.database import Store
from store.quotas import Quotas
from tests.client.readers.mutations import mutated
from tests.client.readers.test_mutated_files import WRITERS, nwb_file
from tests.service.conftest import problem, zip_of

COUNT = int(os.environ.get("FEWVIEW_TEST_MUTATIONS", "4"))  # each is read in a process of its own


def refused(answer: httpx2.Response, field: str = "files") -> str:
    return problem(answer, 422, "invalid_input", f"/{field}")


def test_all_files_of_a_request_have_one_bound_of_what_they_unpack_to(api: TestClient) -> None:
    """64 MiB, as they are small."""
    table = b"x,y,z\n" + b"1,2,3\n" * 2**20  # no keypoints
    sent = [("files", (f"{n}.zip", zip_of({f"{n}/a.csv": table * 3}))) for n in range(4)]
    message = refused(api.post("/datasets", files=sent))
    assert message.startswith("files: 3.zip: unpacks to "), message
    assert "67,108,864 bytes, which files of this size may" in message
    message = refused(api.post("/previews", files=sent))
    assert "67,108,864" in message


def test_files_unpack_to_what_is_left_of_the_quota(api: TestClient) -> None:
    """Not to the whole of it again with each request."""
    store: Store = api.app.state.store  # type: ignore[attr-defined]
    quotas = Quotas(stored_bytes=100_000)
    _, token = access_keys.create(
        store, name="lab", scopes=SCOPES, project="full lab", quotas=quotas
    )
    api.app.state.keyring.look()  # type: ignore[attr-defined]
    header = {"Authorization": f"Bearer {token}"}
    sent = [("files", ("a.zip", zip_of({"a.csv": b"1,2,3\n" * 10_000})))]
    assert "may still keep" not in refused(api.post("/previews", files=sent, headers=header))
    body = {"keypoints": [[[[1, 2]] * 4] * 2], "metadata": {"log": "x" * 50_000}}
    assert api.post("/datasets", json=body, headers=header).status_code == 201
    for where in ("/datasets", "/previews"):
        message = refused(api.post(where, files=sent, headers=header))
        assert "unpacks to 60,000 bytes" in message
        assert "bytes that this key may still keep" in message


def test_strangers_words_take_linear_time_and_come_out_cut(api: TestClient) -> None:
    """Words with which patterns that are not linear take minutes."""
    for words in ("/+" * 32_000, " (--" * 16_000, "1" * 64_000 + "a1", "._ " * 20_000 + "x"):
        for field, name, data in (
            ("files", "a.json", json.dumps({words: [1]}).encode()),
            ("table_columns", "a.csv", f"{words},b,c\n1,2,3\n4,5,6\n".encode()),
        ):
            message = refused(api.post("/datasets", files=[("files", (name, data))]), field)
            assert len(message) < 3000
            assert message.startswith(f"{field}: {name}: "), message


def test_a_directory_of_millions_is_not_listed(api: TestClient) -> None:
    entry = b"PK\x01\x02" + bytes(42)
    count = 80_000
    end = struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 0, 0, len(entry) * count, 4, 0)
    data = b"PK\x03\x04" + entry * count + end
    refused(api.post("/datasets", files=[("files", ("a.npz", data))]))
    answer = api.post("/datasets", files={"file": ("a.npz", data)})
    assert "64 arrays" in problem(answer, 413, "body_too_large")


@pytest.mark.parametrize("written", WRITERS)
def test_a_file_that_is_nearly_right_is_read_or_refused(
    api: TestClient, written: Callable[[], bytes]
) -> None:
    whole, sizes = written(), [(640, 480)] * (2 if written is nwb_file else 1)
    for content in (whole, *mutated(whole, COUNT)):
        sent = [("files", ("cam1.file", content))]
        answer = api.post("/datasets", files=sent, data={"image_sizes": json.dumps(sizes)})
        if answer.status_code == 201:
            assert api.delete(f"/datasets/{answer.json()['id']}").status_code == 204
        else:
            assert content != whole, answer.text
            assert answer.status_code in (400, 422), answer.text
            assert answer.headers["content-type"] == "application/problem+json"
