"""Tables of every version are brought to today's, by whoever comes first, or refused in words."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from alembic.script import ScriptDirectory
from sqlalchemy import Engine, text

from store import lookup, schema, usage
from store.database import Store
from store.engine import open_engine
from store.errors import StoreError
from store.records import DatasetRecord, FitRecord, ModelRecord, Record
from store.settings import StoreSettings
from tests.deployments import PostgreSQL

E3D0C35 = Path(__file__).parents[1] / "fixtures" / "records_e3d0c35"


@pytest.fixture(params=["sqlite", "postgresql"])
def own(request: pytest.FixtureRequest, tmp_path: Path) -> StoreSettings:
    """Return the settings of a database of one's own, in which there is nothing yet."""
    url = f"sqlite:///{tmp_path}/own.db"
    if request.param == "postgresql":
        postgresql: PostgreSQL = request.getfixturevalue("postgresql")
        url = postgresql.new_url()
    return StoreSettings(data_dir=tmp_path, database_url=url)


@pytest.fixture
def engine(own: StoreSettings) -> Iterator[Engine]:
    engine = open_engine(own.resolved_database_url, forks=False)
    yield engine
    engine.dispose()


def execute(engine: Engine, *statements: str) -> None:
    with engine.execution_options(writing=True).begin() as connection:
        for statement in statements:
            connection.execute(text(statement.replace(":", r"\:")))


@pytest.fixture
def of_e3d0c35(engine: Engine) -> Engine:
    files = (E3D0C35 / f"{engine.dialect.name}.sql", E3D0C35 / "rows.sql")
    execute(engine, *(part for file in files for part in file.read_text().split(";")[:-1]))
    return engine


def differences(engine: Engine) -> list[Any]:
    """Return in what the tables are not as the records say."""

    def is_of_records(_item: object, name: str | None, *_more: object) -> bool:
        return not (name or "").startswith("labels_of_")  # which PostgreSQL alone has

    with engine.connect() as connection:
        context = MigrationContext.configure(connection, opts={"include_object": is_of_records})
        return list(compare_metadata(context, Record.metadata))


def test_the_migrations_lead_to_what_the_records_say(engine: Engine) -> None:
    assert schema.migrate(engine).state == "empty"
    assert differences(engine) == []
    assert schema.look(engine).state == "current"
    script = ScriptDirectory(str(schema.MIGRATIONS))
    assert [r.revision for r in script.walk_revisions()] == list(reversed(schema.REVISIONS))


def test_records_of_e3d0c35_are_migrated_and_hold_what_they_held(
    of_e3d0c35: Engine, own: StoreSettings
) -> None:
    with pytest.raises(StoreError, match="run `fewview migrate`") as e:
        Store(own)
    assert "\n" not in str(e.value)
    assert schema.look(of_e3d0c35) == ("older", None)
    assert schema.migrate(of_e3d0c35) == ("older", None)
    assert differences(of_e3d0c35) == []
    execute(of_e3d0c35, "INSERT INTO deployment (id, created_at, marked_at) VALUES ('dep', 1, 1)")
    objects = Path(own.data_dir, "objects")
    objects.mkdir()
    (objects / "deployment.json").write_text('{"deployment": "dep"}')
    store = Store(own)
    found = lookup.page(store, DatasetRecord, lookup.Filters(tags=["old"]), limit=9, after=None)
    assert [(one.id, one.observed, one.user_metadata) for one in found] == [
        ("ds_1", [15, 15], {"subject": "M7"})
    ]
    assert lookup.get(store, FitRecord, "fit_1").config == {"seed": 1}
    assert lookup.get(store, ModelRecord, "mdl_1").fit_id == "fit_1"
    kept = usage.usage(store, 9).project  # what was stored before anything was counted
    assert kept["datasets"].size > 512 + sum(2 * count * 8 for count in found[0].observed)
    assert kept["models"].size > 512 + lookup.get(store, ModelRecord, "mdl_1").weights_bytes
    assert kept["fits"].size > 512
    store.close()


def test_columns_and_tables_that_older_versions_lack_are_added(of_e3d0c35: Engine) -> None:
    execute(
        of_e3d0c35,
        "ALTER TABLE datasets DROP COLUMN findings",
        "DROP INDEX ix_lifts_model_id",
        "DROP TABLE condemned_objects",
    )
    schema.migrate(of_e3d0c35)
    assert differences(of_e3d0c35) == []


def test_columns_that_must_hold_something_are_not_made_up(of_e3d0c35: Engine) -> None:
    execute(of_e3d0c35, "ALTER TABLE datasets DROP COLUMN observed")
    with pytest.raises(StoreError, match="another version"):
        schema.migrate(of_e3d0c35)
    assert schema.look(of_e3d0c35) == ("older", None)  # nothing was changed


def test_processes_that_start_together_make_one_deployment(own: StoreSettings) -> None:
    def opened(_: int) -> str:
        store = Store(own)
        store.close()
        return store.identity

    with ThreadPoolExecutor(6) as threads:
        assert len(set(threads.map(opened, range(6)))) == 1


def test_of_processes_that_migrate_together_one_does_it(of_e3d0c35: Engine) -> None:
    with ThreadPoolExecutor(4) as threads:
        found = list(threads.map(lambda _: schema.migrate(of_e3d0c35).state, range(4)))
    assert sorted(found) == ["current"] * 3 + ["older"]


def test_records_of_a_newer_version_are_refused(engine: Engine, own: StoreSettings) -> None:
    schema.migrate(engine)
    execute(engine, "UPDATE alembic_version SET version_num = '9999'")
    for open_them in (lambda: Store(own), lambda: schema.migrate(engine)):
        with pytest.raises(StoreError, match="a newer version of Fewview"):
            open_them()


OF_KEYS = ("project", "key_id", "stored_bytes")
OF_CORRECTIONS = ("corrections", "corrections_count", "corrections_checksum")


def test_a_data_folder_is_migrated_as_it_is_opened(tmp_path: Path) -> None:
    settings = StoreSettings(data_dir=tmp_path)
    Store(settings).close()
    older = open_engine(settings.resolved_database_url, forks=False)
    tables_since = ("keys", "audit", "aliases", "deliveries", "webhooks")
    execute(older, *(f"DROP TABLE {name}" for name in ("alembic_version", *tables_since)))
    for kind in ("datasets", "fits", "lifts", "models", "idempotency_keys"):
        execute(older, f"DROP INDEX account_of_{kind}")
        execute(older, f"ALTER TABLE {kind} DROP COLUMN kept_bytes")
        execute(older, *(f"ALTER TABLE {kind} DROP COLUMN {name}" for name in OF_KEYS))
    for kind in ("datasets", "fits", "lifts"):
        execute(older, *(f"ALTER TABLE {kind} DROP COLUMN {name}" for name in OF_CORRECTIONS))
    for column in ("findings", "calibration"):
        execute(older, f"ALTER TABLE datasets DROP COLUMN {column}")
    execute(older, *(f"ALTER TABLE {kind} DROP COLUMN version" for kind in ("fits", "models")))
    execute(older, "ALTER TABLE lifts DROP COLUMN uncertainty")
    added = (
        "report_key",
        "report_words",
        "first_key",
        "first_model_key",
        "first_bytes",
        "priority",
    )
    execute(older, *(f"ALTER TABLE fits DROP COLUMN {name}" for name in added))
    execute(older, *(f"DROP INDEX ix_{kind}_name" for kind in ("datasets", "fits", "lifts")))
    execute(older, "DROP INDEX ix_models_name", "DROP INDEX ix_models_fit_id")
    execute(older, "DROP INDEX ix_models_dataset_id", "DROP INDEX ix_fits_from_model")
    execute(older, "DROP INDEX ix_fits_model_id")
    with ThreadPoolExecutor(4) as threads:
        for store in threads.map(lambda _: Store(settings), range(4)):
            store.close()
    assert schema.look(older).state == "current"
    assert differences(older) == []
    older.dispose()
