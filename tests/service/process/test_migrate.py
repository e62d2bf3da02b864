"""`fewview migrate`, and what others say of tables that wait for it."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from sqlalchemy import Engine, text

from store import schema
from store.engine import open_engine
from store.settings import StoreSettings
from tests import fork_server
from tests.deployments import PostgreSQL
from tests.service.process.test_keeping import run
from worker.process import python

E3D0C35 = Path(__file__).parents[2] / "fixtures" / "records_e3d0c35"


@pytest.fixture
def url(postgresql: PostgreSQL) -> str:
    return postgresql.new_url()


@pytest.fixture
def engine(url: str) -> Iterator[Engine]:
    engine = open_engine(StoreSettings(database_url=url).resolved_database_url, forks=False)
    yield engine
    engine.dispose()


def test_it_makes_tables_in_an_empty_database(url: str, engine: Engine) -> None:
    given = f"--database-url={url}"
    newest = schema.REVISIONS[-1]
    checked = run("migrate", given, "--check")
    assert (checked.status, schema.look(engine).state) == (1, "empty")
    made = run("migrate", given)
    assert made.status == 0
    assert f"Made tables {newest}" in made.stdout
    assert run("migrate", given, "--check").status == 0
    assert f"of this version (tables {newest})" in run("migrate", given).stdout


def test_a_service_refuses_older_tables_until_it_was_run(
    url: str, engine: Engine, tmp_path: Path
) -> None:
    with engine.begin() as connection:
        for statement in (E3D0C35 / "postgresql.sql").read_text().split(";")[:-1]:
            connection.execute(text(statement))
    given, folder = f"--database-url={url}", f"--data-dir={tmp_path}"
    assert run("migrate", given, "--check").status == 1
    serve = python("-m", "service.cli", "serve", given, folder, "--port=0")
    refused = fork_server.run(serve, timeout=60)
    assert refused.returncode == 2
    assert "run `fewview migrate`" in refused.stderr
    assert refused.stderr.count("\n") == 1
    migrated = run("migrate", given)
    assert migrated.status == 0
    assert f"from tables without a number to {schema.REVISIONS[-1]}" in migrated.stdout
    assert schema.look(engine).state == "current"


def test_it_says_in_a_line_why_it_cannot() -> None:
    ended = run("migrate", "--database-url=postgresql://a:54secret@127.0.0.1:1/records")
    assert ended.status == 2
    assert len(ended.stderr.splitlines()) == 1
    assert "54secret" not in ended.stderr
    unknown = run("migrate", "--database-url=mysql://a:54secret@host/records")
    assert unknown.status == 2
    assert "expected a URL such as postgresql://" in unknown.stderr
    assert "54secret" not in unknown.stderr
