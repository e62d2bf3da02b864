from pathlib import Path

import pytest
from sqlalchemy import text

from store.database import Store
from store.settings import StoreSettings


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

    insert = text(
        "INSERT INTO idempotency_keys (scope, key, fingerprint, resource_id, created_at)"
        " VALUES ('s', 'k', 'f', 'r', 0)"
    )
    with pytest.raises(RuntimeError), store.writing() as session:  # noqa: PT012
        session.execute(insert)
        raise RuntimeError
    assert count() == 0
    with store.writing() as session:
        session.execute(insert)
    assert count() == 1
