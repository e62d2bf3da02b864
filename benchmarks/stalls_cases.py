"""Bodies and answers that take much to read or to write: the cases of `stalls.py`."""

import io
import select
import socket
import struct
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import httpx2
import numpy as np
import orjson
from safetensors.numpy import save

from benchmarks.service_rig import BYTES, Service

JSON = "application/json"
MIB = 2**20
LONGEST_JSON = 63 * MIB
LONGEST = 250 * MIB
FRAMES = 30_000  # of a lift
LISTED = 200
FLOOD_SECONDS = 3.0

Send = Callable[[httpx2.Client], str]
Make = Callable[[], tuple[Send, int]]  # what sends it, and how many bytes come with it


class Case(NamedTuple):
    """What is sent, made as late as possible: together they would fill the memory."""

    name: str
    make: Make


def cases(running: Service, model: str) -> Iterator[Case]:
    """Yield all cases."""
    yield from _captures()
    yield from _odd_bodies()
    yield from _lifts(running, model)
    yield from _other_json()
    yield from _binary()
    yield from _answers(running)
    yield from _sockets(running, model)


def capture(frames: int, views: int = 4, keypoints: int = 17) -> np.ndarray[Any, Any]:
    """Return keypoints with three decimals."""
    rng = np.random.default_rng(0)
    return np.round(rng.uniform(0, 1000, (frames, views, keypoints, 2)), 3)


def text(**fields: Any) -> bytes:
    """Return JSON, arrays too."""
    return orjson.dumps(fields, option=orjson.OPT_SERIALIZE_NUMPY)


def posted(
    path: str, body: bytes | Callable[[], bytes], kind: str = JSON, method: str = "POST"
) -> Make:
    """Return what makes a request."""

    def make() -> tuple[Send, int]:
        content = body if isinstance(body, bytes) else body()

        def send(client: httpx2.Client) -> str:
            answer = client.request(method, path, content=content, headers={"Content-Type": kind})
            return _in_short(answer)

        return send, len(content)

    return make


def _in_short(answer: httpx2.Response) -> str:
    reason = answer.json()["detail"][:60] if answer.status_code >= 400 else ""
    return f"{answer.status_code} {reason} {len(answer.content) / MIB:.1f} MiB"


def _captures() -> Iterator[Case]:
    yield Case("capture 11 MiB", posted("/datasets", lambda: text(keypoints=capture(9_900))))
    yield Case("capture 60 MiB", posted("/datasets", lambda: text(keypoints=capture(54_000))))
    ones = b"[[" + b",".join([b"[" + b",".join([b"[1,2]"] * 17) + b"]"] * 4) + b"]"
    many = LONGEST_JSON // len(ones)
    compact = b'{"keypoints":[' + b",".join([ones[1:]] * min(many, 99_000)) + b"]}"
    yield Case("capture of small numbers", posted("/datasets", compact))

    def gapped() -> bytes:
        points = capture(50_000).tolist()
        for frame in points[::2]:
            frame[1] = None
            frame[0][3] = None
        return text(keypoints=points)

    yield Case("capture with gaps", posted("/datasets", gapped))

    def broken() -> bytes:
        points = capture(50_000).tolist()
        points[-1][-1].pop()
        return text(keypoints=points)

    yield Case("capture, irregular at its end", posted("/datasets", broken))
    whole = text(keypoints=capture(50_000))
    yield Case("capture, cut off", posted("/datasets", lambda: whole[:-3]))
    nulls = (
        b'{"keypoints":['
        + b",".join([text(a=capture(1, 16, 256))[6:-2]] + [b"null"] * 8000)
        + b"]}"
    )
    yield Case("capture, small with nulls", posted("/datasets", nulls))
    all_null = b'{"keypoints":[' + b",".join([b"null"] * (LONGEST_JSON // 5)) + b"]}"
    yield Case("capture of nulls", posted("/datasets", all_null))


def _odd_bodies() -> Iterator[Case]:
    start = b'{"keypoints":[[[[1,2],[3,4],[5,6],[7,8]],[[1,2],[3,4],[5,6],[7,8]]]],"'

    def filled(name: bytes, item: bytes, size: int = LONGEST_JSON) -> bytes:
        body = start + name + b'":[' + item * ((size - 100) // len(item))
        return body.rstrip(b",") + b"]}"

    for size in (MIB - 1000, LONGEST_JSON):
        what = f"{size / MIB:.0f} MiB"
        for name, item in (
            (b"strange", b"1,"),
            (b"strange", b"[],"),
            (b"strange", b'"a",'),
            (b"view_names", b"1,"),
            (b"times", b"1,"),
            (b"times", b"[],"),
            (b"points3d", b"[[1,2,3],[4,5,6],[7,8,9],[1,2,3]],"),
        ):
            case = f"{name.decode()} of {item.decode()} {what}"
            yield Case(case, posted("/datasets", partial(filled, name, item, size)))
        many = (size - 200) // 16
        keys = start + b'x":{' + b",".join(b'"%010d":0' % n for n in range(many)) + b"}}"
        yield Case(f"keys {what}", posted("/datasets", keys))
        named = start + b'name":"' + b"\\n" * ((size - 200) // 2) + b'"}'
        yield Case(f"a long name {what}", posted("/datasets", named))
        wide = start + b'name":"' + "ä\U0001f600".encode() * ((size - 200) // 6) + b'"}'
        yield Case(f"a long name, wide {what}", posted("/datasets", wide))
        edges = start + b'skeleton":{"edges":[' + b"[-1,-1]," * 24_000 + b"[0,0]]}}"
    yield Case("edges", posted("/datasets", edges))
    tags = start + b'tags":[' + b'"",' * 49_000 + b'""]}'
    yield Case("tags", posted("/datasets", tags))


def _lifts(running: Service, model: str) -> Iterator[Case]:
    frames = capture(FRAMES)
    for refine in ("off", "auto"):  # what is loaded with the first lift has nothing to do with it
        asked = {"model": model, "frames": frames[:300].tolist(), "refine": refine}
        running.client.post("/lift", json=asked).raise_for_status()
    yield Case("lift", posted("/lift", lambda: text(model=model, frames=frames, refine="off")))
    films = frames[:10_000]
    times = np.arange(len(films)) / 50
    yield Case(
        "lift with times",
        posted("/lift", lambda: text(model=model, frames=films, refine="off", times=times)),
    )
    path = f"/lift?model={model}&refine=off"
    data = save({"frames": frames.astype(np.float32)})
    for form in ("json", "npz", "safetensors"):
        yield Case(f"lift, {form}", posted(f"{path}&format={form}", lambda: data, BYTES))
    yield Case(
        "lift of views that are null",
        posted("/lift", lambda: text(model=model, frames=[[None] * 4] * 90_000)),
    )


def _other_json() -> Iterator[Case]:
    points = capture(45_000, 1, 17)[:, 0]
    points = np.concatenate((points, points[..., :1]), -1)
    yield Case("evaluation", posted("/evaluations", lambda: text(points=points, truth=points)))
    junk = b'{"dataset_id":"ds_1","config":{"x":[' + b"[]," * (LONGEST_JSON // 3 - 99) + b"0]}}"
    for method, path in (
        ("POST", "/fits"),
        ("POST", "/lifts"),
        ("PATCH", "/models/mdl_1"),
        ("POST", "/evaluations"),
        ("POST", "/lift"),
    ):
        yield Case(f"junk {method} {path}", posted(path, junk, method=method))

    def form() -> tuple[Send, int]:
        arrays = io.BytesIO()
        np.savez(arrays, keypoints=np.ones((1, 2, 4, 2), np.float32))
        fields = {f"f{n}": "[" + "[]," * 340_000 + "0]" for n in range(15)}

        def send(client: httpx2.Client) -> str:
            files = {"file": ("a.npz", arrays.getvalue())}
            return _in_short(client.post("/datasets", files=files, data=fields))

        return send, 15 * MIB

    yield Case("form of JSON", form)


def _binary() -> Iterator[Case]:
    def arrays() -> dict[str, Any]:
        size = LONGEST // (4 * 8 * 100 * 2)
        return {"keypoints": capture(size, 8, 100).astype(np.float32)}

    def npz() -> bytes:
        file = io.BytesIO()
        np.savez(file, **arrays())
        return file.getvalue()

    def packed(size: int, part: float) -> bytes:
        """Return keypoints of so many bytes, of which a part alone cannot be packed."""
        keypoints = np.ones((size // (4 * 8 * 100 * 2), 8, 100, 2), np.float32)
        noisy = keypoints[: int(part * len(keypoints))]
        noisy += np.random.default_rng(0).normal(size=noisy.shape)
        file = io.BytesIO()
        np.savez_compressed(file, keypoints=keypoints)
        return file.getvalue()

    yield Case("npz", posted("/datasets", npz, BYTES))
    yield Case("safetensors", posted("/datasets", lambda: save(arrays()), BYTES))
    for size, part in ((15 * MIB, 0.0), (220 * MIB, 0.0), (220 * MIB, 0.3)):
        name = f"npz of {size / MIB:.0f} MiB, {100 * part:.0f} % noise, packed"
        yield Case(name, posted("/datasets", partial(packed, size, part), BYTES))
    yield Case("no weights", posted("/models", lambda: save(arrays()), BYTES))

    def form(client: httpx2.Client, data: bytes) -> str:
        return _in_short(client.post("/datasets", files={"file": ("a.npz", data)}))

    def in_form() -> tuple[Send, int]:
        data = npz()
        return partial(form, data=data), len(data)

    yield Case("npz in a form", in_form)


def _answers(running: Service) -> Iterator[Case]:
    def got(path: str) -> tuple[Send, int]:
        return lambda client: _in_short(client.get(path)), 0

    body = text(
        keypoints=capture(1),
        metadata={str(n): "x" * 40 for n in range(1200)},
        view_names=["v" * 200] * 4,
        skeleton={"keypoint_names": ["k" * 60 + str(n) for n in range(17)], "edges": []},
    )
    for _ in range(LISTED):
        running.client.post("/datasets", content=body, headers={"Content-Type": JSON})
    yield Case("list of datasets", partial(got, f"/datasets?limit={LISTED}"))
    dataset = running.upload_many(capture(20_000).astype(np.float32), 20_000)
    config = {"steps": 20, "cameras": "moving", "refine": "off"}
    fit, _ = running.run("/fits", {"dataset_id": dataset, "config": config})
    path = f"/fits/{fit['id']}/reconstruction"
    for query in ("format=json", "format=npz", "format=safetensors", "format=json&refine=auto"):
        yield Case(f"reconstruction {query}", partial(got, f"{path}?{query}"))
    asked = {"model_id": fit["model_id"], "dataset_id": dataset, "refine": "off"}
    lift, _ = running.run("/lifts", asked)
    for form in ("jsonl", "npz"):
        yield Case(
            f"lift's result {form}", partial(got, f"/lifts/{lift['id']}/result?format={form}")
        )
    yield Case("capture, downloaded", partial(got, f"/datasets/{dataset}/capture"))


def _sockets(running: Service, model: str) -> Iterator[Case]:
    start = text(model=model, refine="off")
    for name, (first, again) in FLOODS.items():
        for reads in (False, True):
            how = "read" if reads else "unread"
            flood = partial(_flood, running, frame(1, start) + first, again * 10_000, reads)
            yield Case(f"stream of {name}, {how}", partial(_sized, flood))


def frame(kind: int, data: bytes, *, last: bool = True) -> bytes:
    """Return a frame of a WebSocket as a client sends it, masked with zeros."""
    size = len(data)
    head = struct.pack("!BB", kind | 0x80 * last, 0x80 | (size if size < 126 else 126))
    return head + (struct.pack("!H", size) if size >= 126 else b"") + bytes(4) + data


FLOODS = {  # what is sent once, and again and again
    "pings": (b"", frame(9, b"x" * 125)),
    "empty pings": (b"", frame(9, b"")),
    "pongs": (b"", frame(10, b"")),
    "fragments": (frame(1, b" ", last=False), frame(0, b" ", last=False)),
    "empty fragments": (frame(1, b"", last=False), frame(0, b"", last=False)),
    "empty texts": (b"", frame(1, b"")),
    "empty messages": (b"", frame(2, b"")),
}
HANDSHAKE = (
    b"GET /lift/stream HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\n"
    b"Connection: Upgrade\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
    b"Sec-WebSocket-Version: 13\r\n\r\n"
)


def _sized(send: Send) -> tuple[Send, int]:
    return send, 0


def _flood(running: Service, first: bytes, again: bytes, reads: bool, _: httpx2.Client) -> str:
    """Send as fast as the service takes it, for a while; return how much that was."""
    sent, unsent = 0, memoryview(first)
    ends = time.monotonic() + FLOOD_SECONDS
    with socket.create_connection((running.host, running.port)) as connection:
        connection.sendall(HANDSHAKE)
        connection.recv(65536)
        connection.setblocking(False)
        try:
            while time.monotonic() < ends:
                reading = [connection] if reads else []
                readable, writable, _none = select.select(reading, [connection], [], 0.1)
                if writable:
                    count = connection.send(unsent)
                    sent += count
                    unsent = unsent[count:] or memoryview(again)
                if readable and not connection.recv(MIB):
                    return f"closed after {sent / MIB:.1f} MiB"
        except OSError:
            return f"closed after {sent / MIB:.1f} MiB"
    return f"took {sent / MIB:.1f} MiB"
