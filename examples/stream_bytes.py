"""A capture loop in bytes (docs/streaming.md): `stream_bytes.py URL MODEL FILE [RATE]`.

URL is ws://127.0.0.1:8000/lift/stream, FILE a npy of keypoints (N, K, P, 2), RATE the frames per
second (100). Needs numpy and websockets. Prints how long each answer took.
"""

import asyncio
import json
import struct
import sys
import time
from typing import Any

import numpy as np
from websockets.asyncio.client import connect

HEADER = struct.Struct("<BBHI")
VIEW = np.dtype(
    [
        ("camera", "<i4"),
        ("rotation", "<f4", (3, 3)),
        ("scale", "<f4"),
        ("translation", "<f4", 3),
        ("focal", "<f4", 2),
        ("principal_point", "<f4", 2),
        ("distortion", "<f4", 8),
        ("reprojection_error", "<f4"),
    ]
)
Array = np.ndarray[Any, Any]


def write_frame(sequence: int, keypoints: Array) -> bytes:
    """Return a frame: keypoints (K, P, 2), pixels, NaN where not observed."""
    return HEADER.pack(1, 0, len(keypoints), sequence) + keypoints.astype("<f4").tobytes()


def read_answer(message: bytes, keypoints: int) -> tuple[int, bool, Array, Array]:
    """Return sequence, whether the frame was lifted, points3d (P, 3), and views (K,) as `VIEW`."""
    _kind, flags, views, sequence = HEADER.unpack_from(message)
    points3d = np.frombuffer(message, "<f4", 3 * keypoints, HEADER.size).reshape(-1, 3)
    cameras = np.frombuffer(message, VIEW, views, HEADER.size + points3d.nbytes)
    return sequence, bool(flags & 1), points3d, cameras


async def main(url: str, model: str, path: str, rate: str = "100") -> None:
    """Send a file of keypoints at the pace of cameras, and print the answers."""
    keypoints = np.load(path)
    sent: dict[int, float] = {}
    async with connect(url, compression=None) as socket:
        start = {"model": model, "on_overload": "latest", "continuity": True}
        await socket.send(json.dumps(start))
        ready = json.loads(await socket.recv())
        if ready["type"] == "error":
            sys.exit(ready["detail"])

        async def send() -> None:
            begun = time.perf_counter()
            for sequence, frame in enumerate(keypoints):
                await asyncio.sleep(begun + sequence / float(rate) - time.perf_counter())
                sent[sequence] = time.perf_counter()
                await socket.send(write_frame(sequence, frame))

        sending = asyncio.create_task(send())
        left = len(keypoints)
        while left:
            message = await socket.recv()
            if isinstance(message, str):  # dropped frames, or what is wrong with one
                print(message)
                left -= len(json.loads(message).get("sequences", [None]))
                continue
            sequence, lifted, points3d, views = read_answer(message, ready["keypoints"])
            left -= 1
            took = 1000 * (time.perf_counter() - sent[sequence])
            pixels = np.nanmean(views["reprojection_error"]) if lifted else np.nan
            print(f"frame {sequence}: {took:.1f} ms, {pixels:.1f} px, first point {points3d[0]}")
        await sending


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
