"""An object store that speaks S3, as a process of the test session's own."""

import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.error import URLError
from urllib.request import Request, urlopen
from uuid import uuid4

from tests.processes import free_port, tied


@dataclass(frozen=True)
class S3:
    """A running object store.

    Attributes
    ----------
    environment
        Says where it is and with which keys, to processes that shall use it.
    """

    endpoint: str
    environment: dict[str, str]
    process: "subprocess.Popen[bytes]"

    def new_url(self) -> str:
        """Return the store URL of an empty place of its own, for one deployment."""
        return f"s3://captures/{uuid4().hex}"


@contextmanager
def s3_served() -> Iterator[S3]:
    """Serve a bucket, and have this process and its children know where: by ``AWS_*``."""
    port = free_port()
    endpoint = f"http://127.0.0.1:{port}"
    environment = {
        "AWS_ENDPOINT_URL": endpoint,
        "AWS_ACCESS_KEY_ID": "fewview",
        "AWS_SECRET_ACCESS_KEY": "a secret of tests",
        "AWS_REGION": "eu-central-1",
    }
    process = subprocess.Popen(
        tied("-m", "moto.server", "--host=127.0.0.1", f"--port={port}"),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={"PATH": os.environ["PATH"]},
    )
    before = {name: os.environ.get(name) for name in environment}
    try:
        _make_bucket(f"{endpoint}/captures")
        os.environ |= environment
        yield S3(endpoint, environment, process)
    finally:
        process.kill()
        process.wait()
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _make_bucket(url: str) -> None:
    deadline = time.monotonic() + 60
    while True:
        try:
            with urlopen(Request(url, method="PUT")) as answer:  # noqa: S310 (it is HTTP)
                assert answer.status == 200
                return
        except URLError:
            assert time.monotonic() < deadline, "the object store did not start"
            time.sleep(0.05)


@contextmanager
def folder_away(folder: Path) -> Iterator[None]:
    """Have nothing but errors from a folder of objects."""
    kept = folder.with_name(f"{folder.name}.away")
    folder.rename(kept)
    folder.write_text("no folder")
    try:
        yield
    finally:
        folder.unlink()
        kept.rename(folder)
