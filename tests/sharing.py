"""What one test process has fitted, and the others of the session need as well."""

import fcntl
import os
from collections.abc import Callable

import pytest

from models.lifting.fitted_prior import FittedPrior


def fitted_once(
    folders: pytest.TempPathFactory, name: str, make: Callable[[], FittedPrior]
) -> FittedPrior:
    """Return the prior that `make` fits; of test processes side by side, the first one fits it."""
    if "PYTEST_XDIST_WORKER" not in os.environ:
        return make()
    shared = folders.getbasetemp().parent  # of this session's test processes
    file = shared / f"{name}.safetensors"
    with (shared / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not file.exists():
            file.write_bytes(make().to_bytes())
    return FittedPrior.from_bytes(file.read_bytes())
