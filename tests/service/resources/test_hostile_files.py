"""Files that are small and ask for much: memory, time, space on the disk."""

import json
import struct

import httpx2
from starlette.testclient import TestClient

from tests.service.conftest import problem, zip_of


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
