"""What is no capture is refused with its field named, and nothing is stored."""

import random
from typing import Any

import numpy as np
import orjson
import pytest
from starlette.testclient import TestClient

from tests.deployments import on_every_deployment
from tests.service.conftest import (
    BYTES,
    JSON,
    frames_of,
    make_dataset,
    problem,
    to_npz,
    to_safetensors,
)

pytestmark = pytest.mark.usefixtures("unchanged")

FRAME = [[[[1.0, 2.0], [3.0, 4.0], [5.0, 7.0], [2.0, 9.0]]] * 2]  # 1 frame, 2 views, 4 keypoints
ARRAY = np.array(FRAME, np.float32)
NPZ = to_npz(keypoints=ARRAY)


def changed(*place: int, to: Any) -> list[Any]:
    """Return the frame with one of its parts replaced."""
    frame: list[Any] = orjson.loads(orjson.dumps(FRAME))
    part = frame
    for index in place[:-1]:
        part = part[index]
    part[place[-1]] = to
    return frame


KEYPOINTS: dict[str, Any] = {
    "none": None,
    "a number": 3,
    "a string": "keypoints",
    "an object": {"x": 1},
    "no frames": [],
    "no views": [[]],
    "no keypoints": [[[], []]],
    "rank 3": FRAME[0],
    "rank 5": [FRAME],
    "one coordinate": [[[[1.0]] * 4] * 2],
    "three coordinates": [[[[1.0, 2.0, 3.0]] * 4] * 2],
    "3 keypoints": [[[[1.0, 2.0]] * 3] * 2],
    "33 keypoints": [[[[1.0, 2.0]] * 33] * 2],
    "5 views": [[[[1.0, 2.0]] * 4] * 5],
    "401 frames": FRAME * 401,
    "a frame with fewer views": [*FRAME, FRAME[0][:1]],
    "a view with fewer keypoints": changed(0, 1, to=FRAME[0][0][:3]),
    "a point of three": changed(0, 1, 2, to=[1.0, 2.0, 3.0]),
    "a point of one": changed(0, 0, 2, to=[1.0]),
    "a number for a point": changed(0, 1, 2, to=7.0),
    "a number for a view": changed(0, 1, to=7.0),
    "a string for a coordinate": changed(0, 1, 2, 0, to="1.0"),
    "true for a coordinate": changed(0, 1, 2, 0, to=True),
    "all true": [[[[True, False]] * 4] * 2],
    "all strings": [[[["1", "2"]] * 4] * 2],
    "an object for a coordinate": changed(0, 1, 2, 0, to={}),
    "a list for a coordinate": changed(0, 1, 2, 0, to=[1.0]),
    "beyond float32": changed(0, 1, 2, 0, to=1e300),
    "beyond any image": changed(0, 1, 2, 0, to=1e7),
}


@pytest.mark.parametrize("what", KEYPOINTS)
def test_keypoints(api: TestClient, model: str, what: str) -> None:
    for url, field, more in (
        ("/datasets", "keypoints", {}),
        ("/lift", "frames", {"model": model}),
    ):
        body = orjson.dumps({field: KEYPOINTS[what], **more})
        response = api.post(url, content=body, headers=JSON)
        assert response.status_code == 422, (what, response.text)
        detail = problem(response, 422, "invalid_input")
        assert response.json()["errors"][0]["pointer"].startswith(f"/{field}"), response.text
        assert "expected" in detail or "must" in detail


def test_the_place_of_a_wrong_number_is_named(api: TestClient) -> None:
    body = orjson.dumps({"keypoints": changed(0, 1, 2, 0, to="7")})
    response = api.post("/datasets", content=body, headers=JSON)
    problem(response, 422, "invalid_input", "/keypoints/0/1/2/0")
    ragged = orjson.dumps({"keypoints": changed(0, 1, to=FRAME[0][0][:3])})
    detail = problem(
        api.post("/datasets", content=ragged, headers=JSON),
        422,
        "invalid_input",
        "/keypoints/0/1",
    )
    assert "expected 4 keypoints, got a list of 3" in detail


def test_a_dataset_of_nothing(api: TestClient) -> None:
    body = orjson.dumps({"keypoints": [[None, None]]})
    detail = problem(
        api.post("/datasets", content=body, headers=JSON), 422, "invalid_input", "/keypoints"
    )
    assert "no list of keypoints" in detail


@pytest.mark.parametrize(
    ("more", "pointer"),
    [
        ({"confidence": [[[1.0] * 4] * 3]}, "/confidence"),
        ({"confidence": [[[1.0] * 3] * 2]}, "/confidence"),
        ({"confidence": [[1.0] * 4]}, "/confidence/0/0"),
        ({"confidence": 1.0}, "/confidence"),
        ({"confidence": [[[1.5] * 4] * 2]}, "/confidence"),
        ({"confidence": [[[-0.1] * 4] * 2]}, "/confidence"),
        ({"confidence": [[["1"] * 4] * 2]}, "/confidence/0/0/0"),
        ({"points3d": [[[1.0, 2.0, 3.0]] * 3]}, "/points3d"),
        ({"points3d": [[[1.0, 2.0]] * 4]}, "/points3d"),
        ({"points3d": [[[1.0, 2.0, 3.0]] * 4] * 2}, "/points3d"),
        ({"points3d": [[[1.0, 2.0, 1e300]] * 4]}, "/points3d"),
        ({"skeleton": {"edges": [[0, 4]]}}, "/skeleton/edges/0"),
        ({"skeleton": {"edges": [[0, 1], [2, 2]]}}, "/skeleton/edges/1"),
        ({"skeleton": {"edges": [[0, -1]]}}, "/skeleton/edges/0/1"),
        ({"skeleton": {"edges": [[0, 1, 2]]}}, "/skeleton/edges/0"),
        ({"skeleton": {"edges": [[0, 10**30]]}}, "/skeleton/edges/0/1"),
        ({"skeleton": {"keypoint_names": list("abc")}}, "/skeleton/keypoint_names"),
        ({"skeleton": {"keypoint_names": list("abca")}}, "/skeleton/keypoint_names"),
        ({"skeleton": {"keypoint_names": ["a", "b", "c", ""]}}, "/skeleton/keypoint_names/3"),
        ({"skeleton": {"bones": []}}, "/skeleton/bones"),
        ({"image_sizes": [[640, 480]]}, "/image_sizes"),
        ({"image_sizes": [[640, 480], [640]]}, "/image_sizes/1"),
        ({"image_sizes": [[640, 480], [0, 480]]}, "/image_sizes/1/0"),
        ({"metadata": {"text": "x" * 70_000}}, "/metadata"),
        ({"metadata": [1]}, "/metadata"),
        ({"name": ""}, "/name"),
        ({"name": "n" * 201}, "/name"),
        ({"name": 5}, "/name"),
        ({"colour~of/x": 1}, "/colour~0of~1x"),
        ({"fps": "50"}, "/fps"),
        ({"image_sizes": [[640, "480"]]}, "/image_sizes/0/1"),
        ({"skeleton": {"edges": [[0, 1], [False, 1]]}}, "/skeleton/edges/1/0"),
    ],
)
def test_other_fields(api: TestClient, more: dict[str, Any], pointer: str) -> None:
    # Integers beyond 64 bits are no business of orjson's.
    body = str({"keypoints": FRAME, **more}).replace("'", '"').replace("False", "false").encode()
    problem(api.post("/datasets", content=body, headers=JSON), 422, "invalid_input", pointer)


@pytest.mark.parametrize(
    ("more", "pointer"),
    [
        ({"name": "a\0"}, "/name"),
        ({"tags": ["a\0"]}, "/tags/0"),
        ({"metadata": {"deep": [{"a\0": 1}]}}, "/metadata"),
        ({"metadata": {"deep": [{"a": "\0"}]}}, "/metadata"),
        ({"view_names": ["a", "b\0"]}, "/view_names/1"),
        ({"skeleton": {"keypoint_names": ["a", "b", "c", "\0"]}}, "/skeleton/keypoint_names/3"),
    ],
)
def test_text_with_nul(api: TestClient, more: dict[str, Any], pointer: str) -> None:
    problem(api.post("/datasets", json={"keypoints": FRAME} | more), 422, "invalid_input", pointer)


def nest(depth: int) -> bytes:
    return b"[" * depth + b"]" * depth


@pytest.mark.parametrize("url", ["/datasets", "/lift", "/fits"])
@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"{",
        b"keypoints",
        b'{"frames": NaN}',
        b'{"frames": [Infinity]}',
        b'{"frames": [[[[-Infinity, 1]]]]}',
        b'{"frames": [1e400]}',
        b'{"frames": [' + b"9" * 400 + b"]}",
        b'{"name": "\xff\xfe"}',
        b'{"name": "\\ud800"}',
        b'\xef\xbb\xbf{"frames": []',
        b'{"frames": ' + nest(100_000) + b"}",
    ],
)
def test_no_json(api: TestClient, url: str, body: bytes) -> None:
    problem(api.post(url, content=body, headers=JSON), 400, "malformed_body")


@pytest.mark.parametrize("field", ["keypoints", "metadata", "skeleton", "confidence", "name"])
@pytest.mark.parametrize("depth", [70, 300, 1000])
def test_deeply_nested_json(api: TestClient, field: str, depth: int) -> None:
    if (field, depth) == ("metadata", 70):
        return  # that much is metadata's own business
    body = b'{"keypoints":%s,"%s":{"a":%s}}' % (orjson.dumps(FRAME), field.encode(), nest(depth))
    response = api.post("/datasets", content=body, headers=JSON)
    problem(response, 422, "invalid_input")
    assert len(response.content) < 2000


def test_few_nulls_cannot_stand_for_many_numbers(api: TestClient) -> None:
    first = [[[1.0, 2.0]] * 32] * 4
    frames = [first] + [[None] * 4] * 8000  # 8 MB as float32
    body = orjson.dumps({"keypoints": frames})
    detail = problem(
        api.post("/datasets", content=body, headers=JSON), 422, "invalid_input", "/keypoints"
    )
    assert "8001 x 4 x 32 x 2" in detail


@pytest.mark.parametrize("url", ["/datasets", "/lift", "/fits", "/datasets/ds_x/frames"])
def test_wrong_content_types(api: TestClient, url: str) -> None:
    for kind in ("text/plain", "application/x-www-form-urlencoded", "image/png", "", "json"):
        response = api.post(url, content=b"{}", headers={"Content-Type": kind})
        problem(response, 415, "unsupported_media_type")
    problem(api.post(url), 415, "unsupported_media_type")


MULTIPART = {"Content-Type": "multipart/form-data; boundary=x"}
PART = b'--x\r\nContent-Disposition: form-data; name="file"; filename="f"\r\n\r\n'

FIELD = b'--x\r\nContent-Disposition: form-data; name="%s"\r\n\r\n'


@pytest.mark.parametrize(
    ("body", "headers", "status", "pointer"),
    [
        (b"", MULTIPART, 422, "/file"),
        (b"hello", MULTIPART, 400, None),
        (PART + NPZ, {"Content-Type": "multipart/form-data"}, 400, None),
        (PART + NPZ[:50], MULTIPART, None, None),
        (b'--x\r\nContent-Disposition: form-data; name="file"\r\n\r\nno file\r\n--x--\r\n',
         MULTIPART, 422, "/file"),
        ((PART + NPZ + b"\r\n") * 2 + b"--x--\r\n", MULTIPART, 400, None),
        (PART + NPZ + b"\r\n" + FIELD % b"metadata" + b"{no\r\n--x--", MULTIPART, 422, "/metadata"),
        (PART + NPZ + b"\r\n" + FIELD % b"colour" + b"1\r\n--x--", MULTIPART, 422, "/colour"),
    ],
)  # fmt: skip
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # Starlette's
def test_malformed_forms(
    api: TestClient, body: bytes, headers: dict[str, str], status: int | None, pointer: str | None
) -> None:
    response = api.post("/datasets", content=body, headers=headers)
    assert 400 <= response.status_code < 500
    assert response.headers["content-type"] == "application/problem+json"
    if status is not None:
        assert response.status_code == status, response.text
    if pointer is not None:
        problem(response, 422, "invalid_input", pointer)


@on_every_deployment
@pytest.mark.parametrize("identifier", ["x", "ds_00000000000000000000000000", "%00", "..", "%ff"])
def test_unknown_identifiers(api: TestClient, identifier: str) -> None:
    for method, url in (
        ("GET", "/datasets/{}"),
        ("DELETE", "/datasets/{}"),
        ("GET", "/fits/{}"),
        ("DELETE", "/fits/{}"),
        ("POST", "/fits/{}/cancel"),
        ("GET", "/fits/{}/events"),
        ("GET", "/fits/{}/reconstruction"),
        ("GET", "/models/{}"),
        ("DELETE", "/models/{}"),
        ("GET", "/models/{}/weights"),
    ):
        response = api.request(method, url.format(identifier))
        if identifier == "..":  # which leads elsewhere
            assert 400 <= response.status_code < 500 or method == "GET"
        else:
            problem(response, 404, "not_found")
    if identifier[0] not in "%.":
        body = {"dataset_id": identifier}
        problem(api.post("/fits", json=body), 404, "not_found")
        lift = {"model": identifier, "frames": FRAME}
        problem(api.post("/lift", json=lift), 404, "not_found")
        problem(
            api.post(f"/datasets/{identifier}/frames", json={"keypoints": FRAME}),
            404,
            "not_found",
        )


def test_too_long_identifiers(api: TestClient) -> None:
    problem(api.get(f"/datasets/{'x' * 201}"), 422, "invalid_input", "/dataset_id")
    body = {"dataset_id": "x" * 201}
    problem(api.post("/fits", json=body), 422, "invalid_input", "/dataset_id")


def test_identifiers_with_nul(api: TestClient, model: str) -> None:
    fit, lift = {"dataset_id": "ds_\0"}, {"dataset_id": "ds_", "model_id": "mdl_\0"}
    problem(api.post("/fits", json=fit), 422, "invalid_input", "/dataset_id")
    problem(
        api.post("/fits", json=lift | {"from_model": "\0"}), 422, "invalid_input", "/from_model"
    )
    problem(api.post("/lifts", json=lift), 422, "invalid_input", "/model_id")
    realtime = {"model": f"{model}\0", "frames": FRAME}
    problem(api.post("/lift", json=realtime), 422, "invalid_input", "/model")
    posted = api.post(f"/lift?model={model}%00", content=b"", headers=BYTES)
    problem(posted, 422, "invalid_input", "/model")


@pytest.mark.parametrize("kind", ["datasets", "fits", "models"])
def test_pages(api: TestClient, kind: str) -> None:
    for query, pointer in (
        ("limit=0", "/limit"),
        ("limit=201", "/limit"),
        ("limit=many", "/limit"),
        ("limit=" + "9" * 5000, "/limit"),
        ("cursor=", "/cursor"),
        ("cursor=x", "/cursor"),
        ("cursor=xx_00000000000000000000000000", "/cursor"),
        ("cursor=%27%20OR%201=1", "/cursor"),
    ):
        problem(api.get(f"/{kind}?{query}"), 422, "invalid_input", pointer)
    problem(api.get("/fits?status=done"), 422, "invalid_input", "/status")


def test_unknown_routes_and_methods(api: TestClient) -> None:
    assert "GET /nothing" in problem(api.get("/nothing"), 404, "not_found")


def mutations(seed: int, count: int) -> list[tuple[bytes, dict[str, str]]]:
    """Bodies that are nearly right."""
    rng = random.Random(seed)  # noqa: S311
    keypoints = np.round(np.random.default_rng(seed).uniform(0, 900, (2, 2, 16, 2)), 1)
    text = orjson.dumps({"model": "MODEL", "frames": frames_of(keypoints)})
    files = [
        (text, JSON),
        (text.replace(b'"frames"', b'"keypoints"').replace(b'"model":"MODEL",', b""), JSON),
        (to_npz(frames=keypoints), BYTES),
        (to_npz(keypoints=keypoints.astype(np.float32), edges=np.array([[0, 1]])), BYTES),
        (to_safetensors(frames=keypoints, confidence=np.ones((2, 2, 16))), BYTES),
        (to_safetensors(keypoints=keypoints), BYTES),
    ]
    tokens = [b"null", b"[", b"]", b",", b"-1", b"1e39", b"true", b'"x"', b"{}", b"NaN", b"\xff"]
    found = []
    for _ in range(count):
        body, headers = rng.choice(files)
        data = bytearray(body)
        for _ in range(rng.randint(1, 3)):
            at = rng.randrange(min(len(data), rng.choice([60, 400, 10**6])))
            change = rng.randrange(4)
            if change == 0:
                data[at] = rng.randrange(256)
            elif change == 1:
                del data[at : at + rng.randint(1, 20)]
            elif change == 2:
                data[at:at] = rng.choice(tokens)
            else:
                data[at : at + 2] = rng.choice(tokens)
        found.append((bytes(data), headers))
    return found


def test_nothing_makes_it_stumble(api: TestClient, model: str) -> None:
    statuses: dict[int, int] = {}
    made: list[str] = []
    for body, headers in mutations(seed=11, count=500):
        for url in (f"/lift?model={model}", "/datasets"):
            data = body.replace(b"MODEL", model.encode())
            response = api.post(url, content=data, headers=headers)
            statuses[response.status_code] = statuses.get(response.status_code, 0) + 1
            assert response.status_code < 500, (url, headers, data)
            if response.status_code == 201:
                made.append(response.json()["id"])
            elif response.status_code != 200:
                assert response.headers["content-type"] == "application/problem+json"
                assert response.json()["detail"]
    assert {200, 201, 400, 422} <= statuses.keys()  # every kind of answer was met
    for dataset in made:
        assert api.delete(f"/datasets/{dataset}").status_code == 204


def test_a_refused_chunk_leaves_the_dataset_as_it_was(api: TestClient) -> None:
    made = make_dataset(api)
    url = f"/datasets/{made['id']}/frames"
    for data, headers in (
        (NPZ[:-20], BYTES),
        (to_npz(keypoints=ARRAY), BYTES),
        (to_npz(keypoints=ARRAY, edges=np.array([[0, 1]])), BYTES),
        (orjson.dumps({"keypoints": FRAME, "name": "x"}), JSON),
    ):
        assert 400 <= api.post(url, content=data, headers=headers).status_code < 500
    assert api.get(f"/datasets/{made['id']}").json() == made
    assert api.delete(f"/datasets/{made['id']}").status_code == 204
