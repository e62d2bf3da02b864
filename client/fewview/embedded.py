"""Start a Fewview of one's own: ``fewview serve`` as a child, with everything embedded."""

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from fewview.errors import FewviewError

_ADDRESS = re.compile(r"^ *+API +(http://\S+)", re.MULTILINE)
START_SECONDS = 120.0
STOP_SECONDS = 60.0


class ServiceError(FewviewError):
    """The service of one's own does not start."""


@contextmanager
def running_service(*options: str, data: Path | None = None) -> Iterator[str]:
    """Run ``fewview serve`` on a free port; yield its address, and stop it in the end.

    Parameters
    ----------
    options
        Further ones of ``fewview serve``.
    data
        The folder with what it stores, which is kept, and found again the next time. None: a
        temporary one.

    Raises
    ------
    ServiceError
        If the server is not installed or does not start; the message holds what it printed.
    """
    with ExitStack() as stack:
        if data is None:
            folder = TemporaryDirectory(prefix="fewview-", ignore_cleanup_errors=True)
            data = Path(stack.enter_context(folder), "data")
        data.mkdir(mode=0o700, parents=True, exist_ok=True)
        log = data.with_name(f"{data.name}.log")
        with log.open("w") as output:
            process = subprocess.Popen(  # noqa: S603 (our own command)
                [
                    *(sys.executable, "-P", "-m", "fewview.cli", "serve"),
                    *("--port", "0", "--data-dir", str(data)),
                    *options,
                ],
                # Settings of another Fewview must not lead this one to that one's data.
                env={k: v for k, v in os.environ.items() if not k.startswith("FEWVIEW_")},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=output,
            )
        stack.callback(_stop, process)
        yield _wait_for_address(process, log)


def _wait_for_address(process: subprocess.Popen[bytes], log: Path) -> str:
    """Read the start-up text, which is printed as soon as the API answers."""
    deadline = time.monotonic() + START_SECONDS
    while time.monotonic() < deadline:
        ended = process.poll() is not None
        text = log.read_text(errors="replace")
        if found := _ADDRESS.search(text):
            return found[1]
        if ended:
            raise ServiceError(f"`fewview serve` ended as it started:\n{text[-2000:]}")
        time.sleep(0.05)
    raise ServiceError(
        f"`fewview serve` did not start within {START_SECONDS:.0f} s:\n{text[-2000:]}"
    )


def _stop(process: subprocess.Popen[bytes]) -> None:
    process.terminate()
    try:
        process.wait(STOP_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()  # its children die with it
        process.wait()
