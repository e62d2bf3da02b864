"""Send what schemathesis generates to a running service: `make fuzz`.

The service has a data folder of its own, a worker, and needs a key. The exit status is not zero for
what schemathesis finds, and for a service that no longer answers.
"""

import secrets
import subprocess
import sys
import tempfile
from pathlib import Path

import httpx2

from tests.service.conftest import Live, kill_service, start_service

FOLDER = Path(__file__).parent
EXAMPLES = 8  # of an operation and phase: some 5,000 requests in all


def fuzz(live: Live, token: str, arguments: list[str]) -> int:
    """Run schemathesis; return its exit status."""
    key = f"Authorization: Bearer {token}"
    command = [
        str(Path(sys.executable).with_name("schemathesis")),
        f"--config-file={FOLDER / 'fuzz.toml'}",
        "run",
        f"{live.url}/openapi.json",
        f"--header={key}",
        f"--max-examples={EXAMPLES}",
        "--continue-on-failure",
        *(arguments or ["--seed=1"]),
    ]
    return subprocess.run(command, check=False).returncode


def main() -> int:
    """Start a service, fuzz it, and see that it still answers."""
    token = secrets.token_urlsafe(32)
    with tempfile.TemporaryDirectory() as folder:
        live = start_service(Path(folder), f"--admin-key={token}", "--trust-local=false")
        try:
            status = fuzz(live, token, sys.argv[1:])
            key = {"Authorization": f"Bearer {token}"}
            answers = httpx2.get(f"{live.url}/health/ready", headers=key).status_code == 200
            return status or int(not answers)
        finally:
            kill_service(live)


if __name__ == "__main__":
    sys.exit(main())
