"""Which databases records may be in, and the errors for others."""

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import pytest
from pydantic import ValidationError
from sqlalchemy import URL

from store.database import Store
from store.engine import open_engine
from store.settings import StoreSettings
from tests.deployments import PostgreSQL


@pytest.mark.parametrize("scheme", ["postgresql", "postgres", "postgresql+psycopg2"])
def test_any_url_of_postgresql_takes_its_driver(
    postgresql: PostgreSQL, tmp_path: Path, scheme: str
) -> None:
    url = postgresql.new_url().replace("postgresql", scheme, 1)
    store = Store(StoreSettings(data_dir=tmp_path, database_url=url))
    store.check_records()
    assert store.engine.dialect.driver == "psycopg"
    store.close()


@pytest.mark.parametrize(
    "url",
    [
        "postgresql://fewview:pa%40s@host:54secret/records",  # a password with a /, not escaped
        "mysql://fewview:54secret@host/records",
        "54secret",
        "sqlite://",
    ],
)
def test_other_urls_are_refused_and_their_passwords_are_not_shown(url: str) -> None:
    with pytest.raises(ValidationError, match="expected a URL such as postgresql://") as refused:
        StoreSettings(database_url=url)
    assert "54secret" not in str(refused.value)


def test_a_password_is_not_shown_when_the_database_cannot_be_reached(tmp_path: Path) -> None:
    url = "postgresql://fewview:54secret@127.0.0.1:1/records"
    run = _worker(tmp_path, "", url)
    assert "Connection refused" in run
    assert "54secret" not in run


def test_a_missing_driver_is_reported_in_one_line(tmp_path: Path) -> None:
    hide = "sys.modules['psycopg'] = None;"
    message = _worker(tmp_path, hide, "postgresql://fewview:54secret@127.0.0.1:1/records")
    assert message == "PostgreSQL needs its driver: pip install 'fewview-server[postgresql]'."


def _worker(folder: Path, before: str, url: str) -> str:
    """Return the error that another process ends with when it opens the records."""
    code = (
        f"import sys; {before}"
        "from store.database import Store; from store.settings import StoreSettings\n"
        "try: Store(StoreSettings(data_dir=sys.argv[1], database_url=sys.argv[2]))\n"
        "except Exception as error: print(error)"
    )
    command = [sys.executable, "-c", code, str(folder), url]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    assert run.stderr == ""
    return run.stdout.strip()


def test_several_may_open_a_new_file_at_a_time(tmp_path: Path) -> None:
    def opened(path: Path, together: Barrier) -> None:
        engine = open_engine(URL.create("sqlite", database=str(path)), forks=False)
        together.wait()
        engine.connect().close()
        engine.dispose()

    with ThreadPoolExecutor(6) as threads:
        for number in range(100):  # SQLite refuses one in some of them
            path, together = tmp_path / f"{number}.db", Barrier(6, timeout=20)
            list(threads.map(opened, 6 * [path], 6 * [together]))
