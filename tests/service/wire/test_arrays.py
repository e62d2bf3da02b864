"""Files that hold no capture, or more than they should, are refused and nothing is stored."""

import struct
import zipfile
from typing import Any

import numpy as np
import orjson
import pytest
from starlette.testclient import TestClient

from tests.service.conftest import BYTES, problem, to_npz, to_safetensors, zip_of

pytestmark = pytest.mark.usefixtures("unchanged")

ARRAY = np.random.default_rng(0).uniform(1, 9, (1, 2, 4, 2)).astype(np.float32)
ARRAY[0, 0, 0, 0] = 8.5  # what the tests replace by infinity


def npy_header(shape: str, descr: str = "'<f4'") -> bytes:
    text = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}"
    text = text.ljust(((len(text) + 10 + 64) // 64) * 64 - 11) + "\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


def safetensors_of(header: bytes, data: bytes = b"") -> bytes:
    return struct.pack("<Q", len(header)) + header + data


def encrypted() -> bytes:
    data = bytearray(zip_of({"keypoints.npy": b"x" * 50}, zipfile.ZIP_STORED))
    data[6] |= 1
    data[data.index(b"PK\x01\x02") + 8] |= 1
    return bytes(data)


def broken_deflate() -> bytes:
    data = bytearray(zip_of({"keypoints.npy": np.random.default_rng(0).bytes(4000)}))
    data[60:90] = b"\xff" * 30
    return bytes(data)


def broken(compression: int, *, at: int) -> bytes:
    """Return an npz file with bytes of its one member replaced."""
    data = bytearray(zip_of({"keypoints.npy": np.random.default_rng(0).bytes(4000)}, compression))
    begin = 30 + len("keypoints.npy") + at
    data[begin : begin + 20] = b"\xff" * 20
    return bytes(data)


def npy_text(text: str, version: int = 1) -> bytes:
    """Return a file of one member with this header, and some bytes after it."""
    size = struct.pack("<H" if version == 1 else "<I", len(text.encode()))
    return zip_of(
        {"keypoints.npy": b"\x93NUMPY" + bytes([version, 0]) + size + text.encode() + b"1" * 64}
    )


HEADERS = [
    "",
    "\n",
    "{",
    "{'descr': '<f4', 'shape': (",
    "{'descr': '<f4', 'fortran_order': False, 'shape': (1,), ",
    "{'descr': (), 'fortran_order': False, 'shape': (1,), }",
    "{'descr': None, 'fortran_order': False, 'shape': (1,), }",
    "{'descr': ('<f4',), 'fortran_order': False, 'shape': (1,), }",
    "{'descr': [('a',)], 'fortran_order': False, 'shape': (1,), }",
    "{'descr': ('<f4', (2, -1)), 'fortran_order': False, 'shape': (1,), }",
    "{'descr': '<f4', 'fortran_order': False, 'shape': (True, 2, 4, 2), }",
    "{'descr': '<f4', 'fortran_order': False, 'shape': (1.0, 2, 4, 2), }",
    "{'descr': '<f4', 'fortran_order': False, 'shape': [1, 2, 4, 2], }",
    "{'descr': '<f4', 'fortran_order': False, 'shape': ((1,), 2), }",
    "{'descr': '<f4', 'fortran_order': False, 'shape': None, }",
    "{'descr': '<f4', 'fortran_order': 2, 'shape': (1,), }",
    "{'descr': '<f4', 'fortran_order': False, 'shape': (1L, 2L, }",
    "{'descr': '<f4', 'fortran_order': False, 1: 2}",
    "  {'descr':\n\t'<f4'\n  'shape'",
    "'\ud7ff",
    "[1, 2",
    "1 +",
    "lambda: 0",
    "{**{}}",
]
NPZ = to_npz(keypoints=ARRAY)
SAFETENSORS = to_safetensors(keypoints=ARRAY)
HEADER = b'{"keypoints":{"dtype":"%s","shape":%s,"data_offsets":[0,%d]}}'
UNREADABLE: dict[str, bytes] = {
    "empty": b"",
    "text": b"keypoints: 1 2 3",
    "json": orjson.dumps({"keypoints": ARRAY.tolist()}),
    "pickled member": to_npz(keypoints=np.array([{"a": 1}], object)),
    "pickled member beside": to_npz(keypoints=ARRAY, metadata=np.array([None])),
    "npy alone": npy_header("(1, 2, 4, 2)") + ARRAY.tobytes(),
    "npz cut at the end": NPZ[:-30],
    "npz cut in the middle": NPZ[: len(NPZ) // 2],
    "npz with a broken checksum": NPZ.replace(ARRAY.tobytes(), b"\x01" * ARRAY.nbytes),
    "npz that is encrypted": encrypted(),
    "npz that does not inflate": broken_deflate(),
    **{
        f"npz of compression {kind}, broken at {at}": broken(kind, at=at)
        for kind in (zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
        for at in (0, 4, 40, 2000)
    },
    **{
        f"npy of version {version} with the header {text[:60]!r}": npy_text(text, version)
        for text in HEADERS
        for version in (1, 2)
    },
    "zip of text": zip_of({"keypoints.npy": b"hello"}),
    "zip of nothing": zip_of({"keypoints.npy": b""}),
    "npy that promises much": zip_of({"keypoints.npy": npy_header("(100000, 16, 256, 2)")}),
    "npy that promises all": zip_of({"keypoints.npy": npy_header("(10**30,)")}),
    "npy of negative size": zip_of({"keypoints.npy": npy_header("(-1, 2, 4, 2)") + b"1" * 64}),
    "npy of overflowing size": zip_of({"k.npy": npy_header(f"({10**30}, 0)") + b"1" * 64}),
    "npy with code": zip_of({"keypoints.npy": npy_header("__import__('os')")}),
    "npy nested without end": zip_of({"keypoints.npy": npy_header("-" * 8000 + "1")}),
    "npy in brackets": zip_of({"keypoints.npy": npy_header("(" * 3000 + ")" * 3000)}),
    "npy of nothing": zip_of({"keypoints.npy": npy_header("(1, 2, 4, 2)", "'V0'")}),
    "npy of unknown type": zip_of({"keypoints.npy": npy_header("(1,)", "'<q9'") + b"1" * 64}),
    "npy of objects": zip_of({"keypoints.npy": npy_header("(1,)", "'|O'") + b"1" * 64}),
    "npy of version 9": zip_of({"keypoints.npy": b"\x93NUMPY\x09\x00" + b" " * 80}),
    "safetensors cut": SAFETENSORS[:-8],
    "safetensors cut in its header": SAFETENSORS[:20],
    "safetensors with a huge header": struct.pack("<Q", 2**40) + SAFETENSORS[8:],
    "safetensors with a long header": safetensors_of(b"{" + b" " * 1_100_000 + b"}"),
    "safetensors without json": safetensors_of(b"nothing!"),
    "safetensors of unknown type": safetensors_of(HEADER % (b"X9", b"[1,2,4,2]", 64), b"1" * 64),
    "safetensors of other size": safetensors_of(HEADER % (b"F32", b"[9,9,9,2]", 64), b"1" * 64),
    "safetensors of negative size": safetensors_of(HEADER % (b"F32", b"[-1]", 64), b"1" * 64),
}


@pytest.mark.parametrize("what", UNREADABLE)
def test_no_array_file(api: TestClient, model: str, what: str) -> None:
    for url in ("/datasets", "/datasets/ds_none/frames", f"/lift?model={model}"):
        response = api.post(url, content=UNREADABLE[what], headers=BYTES)
        assert response.status_code == 400, (what, response.text)
        problem(response, 400, "malformed_body")
    form = api.post("/datasets", files={"file": ("f", UNREADABLE[what])})
    problem(form, 400, "malformed_body")


@pytest.mark.parametrize(
    ("arrays", "pointer"),
    [
        ({"confidence": ARRAY[..., 0]}, "/keypoints"),
        ({"points": ARRAY}, "/keypoints"),
        ({"keypoints": ARRAY[0]}, "/keypoints"),
        ({"keypoints": ARRAY[..., :1]}, "/keypoints"),
        ({"keypoints": ARRAY[:0]}, "/keypoints"),
        ({"keypoints": ARRAY[:, :, :3]}, "/keypoints"),
        ({"keypoints": np.repeat(ARRAY, 401, 0)}, "/keypoints"),
        ({"keypoints": np.repeat(ARRAY, 3, 1)}, "/keypoints"),
        ({"keypoints": np.repeat(ARRAY, 9, 2)}, "/keypoints"),
        ({"keypoints": ARRAY.astype(complex)}, "/keypoints"),
        ({"keypoints": ARRAY > 0}, "/keypoints"),
        ({"keypoints": ARRAY.astype(str)}, "/keypoints"),
        ({"keypoints": ARRAY.astype("M8[s]")}, "/keypoints"),
        ({"keypoints": np.zeros((1, 2, 4, 2), [("x", "f4")])}, "/keypoints"),
        ({"keypoints": np.where(ARRAY > 8, np.inf, ARRAY)}, "/keypoints"),
        ({"keypoints": np.where(ARRAY > 8, 1e300, ARRAY.astype(float))}, "/keypoints"),
        ({"keypoints": ARRAY, "confidence": ARRAY}, "/confidence"),
        ({"keypoints": ARRAY, "confidence": ARRAY[..., 0] * 0 + 2}, "/confidence"),
        ({"keypoints": ARRAY, "points3d": np.zeros((1, 3, 3))}, "/points3d"),
        ({"keypoints": ARRAY, "points3d": np.full((1, 4, 3), np.inf)}, "/points3d"),
        ({"keypoints": ARRAY, "edges": np.array([[0, 4]])}, "/skeleton/edges/0"),
        ({"keypoints": ARRAY, "edges": np.zeros((20_000, 2), int)}, "/edges"),
        ({"keypoints": ARRAY, "edges": np.array(7)}, "/skeleton/edges"),
        ({"keypoints": ARRAY, "keypoint_names": np.zeros(4)}, "/skeleton/keypoint_names/0"),
        ({"keypoints": ARRAY, "image_sizes": np.ones((3, 2), int)}, "/image_sizes"),
    ],
)
def test_wrong_arrays(api: TestClient, arrays: dict[str, Any], pointer: str) -> None:
    response = api.post("/datasets", content=to_npz(**arrays), headers=BYTES)
    problem(response, 422, "invalid_input", pointer)


def test_zip_bombs(api: TestClient) -> None:
    bomb = zip_of({"keypoints.npy": npy_header("(5000000,)") + bytes(20_000_000)})
    assert len(bomb) < 50_000
    problem(api.post("/datasets", content=bomb, headers=BYTES), 413, "body_too_large")
    many = zip_of({f"a{n}.npy": b"" for n in range(70)})
    problem(api.post("/datasets", content=many, headers=BYTES), 413, "body_too_large")


def code_points(*numbers: int) -> Any:
    """Return an array of texts of a character each, whatever these numbers stand for."""
    return np.array(numbers, "<u4").view("<U1")


def test_texts_and_numbers_alone_describe(api: TestClient) -> None:
    for dtype in ("M8[s]", "m8[ns]", "c16", [("a", "f4")], [("a", "U1")], "V4"):
        for field in ("keypoint_names", "view_names", "image_sizes", "fps", "edges"):
            odd = np.zeros(1, dtype)
            body = to_npz(keypoints=ARRAY, **{field: odd})
            response = api.post("/datasets", content=body, headers=BYTES)
            problem(response, 422, "invalid_input", f"/{field}")


@pytest.mark.parametrize("number", [0xD800, 0xDBFF, 0xDC00, 0xDFFF, 0x110000, 0xFFFFFFFF])
@pytest.mark.parametrize("field", ["keypoint_names", "view_names", "image_sizes", "fps", "edges"])
def test_code_points_that_are_no_characters(api: TestClient, field: str, number: int) -> None:
    count = {"keypoint_names": 4, "view_names": 2}.get(field, 1)
    texts = code_points(*range(65, 65 + count - 1), number)
    body = to_npz(keypoints=ARRAY, **{field: texts})
    for send in (
        {"content": body, "headers": BYTES},
        {"files": {"file": ("f", body)}, "data": {"name": "a"}},
    ):
        response = api.post("/datasets", **send)
        pointers = [item["pointer"] for item in response.json()["errors"]]
        assert all(field in pointer for pointer in pointers), pointers
        problem(response, 422, "invalid_input")


@pytest.mark.parametrize(
    "charset", ["undefined", "idna", "punycode", "utf-7", "utf-16", "hex", "rot13", "none-such", ""]
)
def test_a_form_is_in_utf_8(api: TestClient, charset: str) -> None:
    name = b'--b\r\nContent-Disposition: form-data; name="name"\r\n\r\n+2AA-\r\n'
    file = b'--b\r\nContent-Disposition: form-data; name="file"; filename="f"\r\n\r\n'
    body = name + file + NPZ + b"\r\n--b--\r\n"
    for url in ("/datasets", "/models", "/datasets/ds_none/frames"):
        for spelling in (charset, f'"{charset}"'):
            headers = {"Content-Type": f"multipart/form-data; boundary=b; charset={spelling}"}
            response = api.post(url, content=body, headers=headers)
            problem(response, 415, "unsupported_media_type")
