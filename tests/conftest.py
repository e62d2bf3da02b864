import os
from pathlib import Path

# As the service and its workers do: tests must not depend on how busy the other cores are.
os.environ["OPENBLAS_NUM_THREADS"] = "1"  # NumPy's and SciPy's, before they are imported

# The processes that tests start are of this copy of the code, too, whichever is installed.
os.environ["PYTHONPATH"] = str(Path(__file__).parent.parent)

import pytest

from models.numerics.threads import use_threads

use_threads(1)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Spread the tests that wait for worker processes among those that compute.

    Side by side, they then overlap from the first to the last. Others stay in their order, as they
    share fixtures.
    """
    waiting = [item for item in items if "worker" in item.path.parts]
    others = [item for item in items if "worker" not in item.path.parts]
    place = {
        item: (number + 0.5) / len(group)
        for group in (waiting, others)
        for number, item in enumerate(group)
    }
    items.sort(key=place.__getitem__)
