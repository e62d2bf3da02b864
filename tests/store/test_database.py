from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from sqlalchemy import text

from store.database import Store
from store.errors import StoreError
from store.settings import StoreSettings


def test_records_of_another_version_are_refused(store: Store, settings: StoreSettings) -> None:
    with store.engine.execution_options(writing=True).begin() as connection:
        connection.execute(text("ALTER TABLE datasets RENAME COLUMN checksum TO digest"))
    with pytest.raises(StoreError, match="another version"):
        Store(settings)


def test_columns_that_an_older_version_lacks_are_added(
    store: Store, settings: StoreSettings
) -> None:
    with store.engine.execution_options(writing=True).begin() as connection:
        connection.execute(text("ALTER TABLE datasets DROP COLUMN findings"))
        connection.execute(text("ALTER TABLE models DROP COLUMN dataset_id"))

    def opened(_: int) -> Store:
        return Store(settings)

    with ThreadPoolExecutor(4) as threads:  # processes of one deployment may start together
        stores = list(threads.map(opened, range(4)))
    with stores[0].reading() as session:
        assert session.execute(text("SELECT findings FROM datasets")).all() == []
        assert session.execute(text("SELECT dataset_id FROM models")).all() == []
    for other in stores:
        other.close()


def test_columns_that_must_hold_something_are_not_made_up(
    store: Store, settings: StoreSettings
) -> None:
    with store.engine.execution_options(writing=True).begin() as connection:
        connection.execute(text("ALTER TABLE datasets DROP COLUMN observed"))
    with pytest.raises(StoreError, match="another version"):
        Store(settings)


def test_a_data_folder_may_have_any_name(tmp_path: Path) -> None:
    folder = tmp_path / "a?b #1 %20 ü"
    store = Store(StoreSettings(data_dir=folder))
    store.objects.put("a/b", b"1")
    store.check_records()
    assert (folder / "records.db").is_file()
    assert (folder / "objects" / "a" / "b").read_bytes() == b"1"
    store.close()


def test_a_failed_transaction_leaves_nothing(store: Store) -> None:
    def count() -> int:
        with store.reading() as session:
            return int(session.execute(text("SELECT count(*) FROM idempotency_keys")).scalar_one())

    insert = text("INSERT INTO idempotency_keys VALUES ('s', 'k', 'f', 'r', 0)")
    with pytest.raises(RuntimeError), store.writing() as session:  # noqa: PT012
        session.execute(insert)
        raise RuntimeError
    assert count() == 0
    with store.writing() as session:
        session.execute(insert)
    assert count() == 1
