"""Downloads to files, which go on where they broke off: in the same call or in a later one."""

import glob
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote, unquote

import httpx2

from fewview.api.retries import patiently
from fewview.api.steps import Open, Read, Request, Steps, nothing
from fewview.errors import ConnectionFailed, InvalidRequest


class _Part(NamedTuple):
    """What has been downloaded of one version of a file, which its entity tag names."""

    file: Path
    tag: str

    @classmethod
    def find(cls, target: Path) -> "_Part | None":
        """Return what an earlier call left beside the target."""
        for file in sorted(target.parent.glob(f"{glob.escape(target.name)}.*.part")):
            tag = file.name.removeprefix(f"{target.name}.").removesuffix(".part")
            return cls(file, unquote(tag))
        return None

    @classmethod
    def of(cls, target: Path, response: httpx2.Response) -> "_Part":
        """Return the part that a response belongs to."""
        tag = response.headers.get("ETag", "")
        return cls(target.with_name(f"{target.name}.{quote(tag, safe='')}.part"), tag)


def download(where: str, target: Path, patience: float, **params: str) -> Steps[Path]:
    """Download a file; a part that is there already is kept, if it is of the same version.

    Until the file is complete, it has another name beside the target.

    Raises
    ------
    ApiError
        The service refused.
    ConnectionFailed
        The service was away for longer than ``patience``; call again to continue.
    OSError
        The file cannot be written.
    """
    while True:
        part = _Part.find(target)
        done = part.file.stat().st_size if part else 0
        headers = {"Accept-Encoding": "identity"}
        if part and part.tag and done:
            headers |= {"Range": f"bytes={done}-", "If-Range": part.tag}
        request = Request("GET", where, nothing, params=params, headers=headers)
        try:
            response = yield from patiently(Open(request), patience)
        except InvalidRequest as error:
            if error.status == 416 and part:  # no more to come, and never put into its place
                part.file.unlink()
                continue
            raise
        resumed = response.status_code == 206
        if part and not resumed:
            part.file.unlink()
        part = _Part.of(target, response)
        try:
            with part.file.open("ab" if resumed else "wb") as file:
                while (piece := (yield Read())) is not None:
                    file.write(piece)
        except ConnectionFailed:
            if part.file.stat().st_size == (done if resumed else 0):
                raise  # or it would break off forever
        else:
            return part.file.replace(target)
