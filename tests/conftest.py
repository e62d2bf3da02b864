import gc
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

# As the service and its workers do: tests must not depend on how busy the other cores are.
os.environ["OPENBLAS_NUM_THREADS"] = "1"  # NumPy's and SciPy's, before they are imported

# The processes that tests start are of this copy of the code, too, whichever is installed.
os.environ["PYTHONPATH"] = os.pathsep.join(
    str(Path(__file__).parents[1] / at) for at in (".", "client")
)

from models.numerics.threads import use_threads
from tests.deployments import PostgreSQL, postgresql_served
from tests.object_stores import S3, s3_served
from tests.sharing import forget_older_fits

use_threads(1)

# What is imported stays. To look for garbage in it takes seconds, here and in each test.
gc.disable()


@pytest.fixture(scope="session")
def s3() -> Iterator[S3]:
    """Serve an object store for this test process: `StoreSettings(store_url=s3.new_url())`."""
    with s3_served() as served:
        yield served


@pytest.fixture(scope="session")
def postgresql() -> Iterator[PostgreSQL]:
    """Run a PostgreSQL for this test process: `StoreSettings(database_url=...new_url())`."""
    with postgresql_served() as served:
        yield served


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    # Compiling takes a minute that no process can share: at the end, the others would wait for it.
    items.sort(key=lambda item: item.path.name != "test_precompile.py")


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


def pytest_sessionfinish(session: pytest.Session) -> None:
    # pytest looks for garbage five times as it ends: once is enough.
    gc.collect()
    gc.freeze()
    if not hasattr(session.config, "workerinput"):  # of xdist: once a run
        forget_older_fits()
