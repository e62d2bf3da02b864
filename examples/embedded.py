"""Start a Fewview of one's own: ``fewview serve`` as a child, with everything embedded."""

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

START_SECONDS = 120.0
STOP_SECONDS = 60.0


@contextmanager
def running_service(*options: str) -> Iterator[str]:
    """Run ``fewview serve`` on a free port, its data in a temporary folder; yield its address.

    `options` are further ones of ``fewview serve``.

    However the block is left, the service is stopped and its data are gone.

    Raises
    ------
    RuntimeError
        If the service does not start; the message holds what it printed.
    """
    with TemporaryDirectory(prefix="fewview-", ignore_cleanup_errors=True) as folder:
        log = Path(folder, "serve.log")
        with log.open("w") as output:
            process = subprocess.Popen(  # noqa: S603 (our own console script)
                [
                    str(Path(sys.executable).with_name("fewview")),
                    "serve",
                    *("--port", "0"),
                    *("--data-dir", str(Path(folder, "data"))),
                    *options,
                ],
                # Settings of another Fewview must not lead this one to that one's data.
                env={k: v for k, v in os.environ.items() if not k.startswith("FEWVIEW_")},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
            )
        try:
            yield _wait_for_address(process, log)
        finally:
            _stop(process)


def _wait_for_address(process: subprocess.Popen[bytes], log: Path) -> str:
    """Read the start-up text, which is printed as soon as the API answers."""
    deadline = time.monotonic() + START_SECONDS
    while time.monotonic() < deadline:
        ended = process.poll() is not None
        text = log.read_text(errors="replace")
        if found := re.search(r"^ *API +(http://\S+)", text, re.MULTILINE):
            return found[1]
        if ended:
            raise RuntimeError(f"`fewview serve` ended as it started:\n{text[-2000:]}")
        time.sleep(0.05)
    raise RuntimeError(
        f"`fewview serve` did not start within {START_SECONDS:.0f} s:\n{text[-2000:]}"
    )


def _stop(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(STOP_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()  # its children die with it
        process.wait()
