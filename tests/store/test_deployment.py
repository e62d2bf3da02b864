"""Records and objects that do not belong together are refused, and nothing of them is deleted."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from sqlalchemy import text

from store import datasets, housekeeping
from store.capture import Capture
from store.database import Store
from store.datasets import CaptureDescription
from store.deployment import MARK
from store.errors import DeploymentError
from store.objects import Objects
from store.settings import StoreSettings


@pytest.fixture
def full(store: Store, capture: Capture) -> Store:
    """Store a dataset in the records and objects of one deployment."""
    datasets.create(store, capture, CaptureDescription("season"))
    return store


def keys(store: Store) -> list[str]:
    return [key for key, _ in store.objects.list()]


def beside(store: Store, tmp_path: Path) -> StoreSettings:
    """Return the settings of a worker with the objects, and without the records."""
    return StoreSettings(data_dir=tmp_path / "elsewhere", store_url=store.objects.url)


def forget_identity(store: Store) -> None:
    """Make of the deployment one that an older version wrote, its tables brought to today's."""
    with store.writing() as session:
        session.execute(text("DELETE FROM deployment"))
    store.objects.delete(MARK)


def test_records_that_do_not_know_the_objects_are_refused(full: Store, tmp_path: Path) -> None:
    with pytest.raises(DeploymentError, match="FEWVIEW_DATABASE_URL"):
        Store(beside(full, tmp_path))
    assert len(keys(full)) == 1


def test_so_are_those_of_an_older_version(full: Store, tmp_path: Path) -> None:
    forget_identity(full)
    with pytest.raises(DeploymentError, match="records are empty"):
        Store(beside(full, tmp_path))


def test_objects_that_the_records_do_not_know_are_refused(
    full: Store, settings: StoreSettings, tmp_path: Path
) -> None:
    other = settings.model_copy(update={"store_url": (tmp_path / "empty").as_uri()})
    with pytest.raises(DeploymentError, match="FEWVIEW_STORE_URL"):
        Store(other)
    forget_identity(full)
    with pytest.raises(DeploymentError, match="FEWVIEW_STORE_URL"):
        Store(other)


def test_an_older_deployment_gets_its_identity_and_keeps_it(
    full: Store, settings: StoreSettings
) -> None:
    forget_identity(full)

    def opened(_: int) -> str:
        store = Store(settings)
        store.close()
        return store.identity

    with ThreadPoolExecutor(4) as threads:  # processes of one deployment may start together
        identities = set(threads.map(opened, range(4)))
    assert len(identities) == 1
    assert opened(0) in identities


def test_a_start_that_was_killed_before_the_mark_was_written_is_finished(
    full: Store, settings: StoreSettings
) -> None:
    full.objects.delete(MARK)
    with full.writing() as session:
        session.execute(text("UPDATE deployment SET marked_at = NULL"))
    again = Store(settings)
    assert again.identity == full.identity
    again.close()
    Store(settings).close()


def test_objects_that_answer_late_keep_nobody_from_writing(
    full: Store, settings: StoreSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def late(objects: Objects, key: str) -> bytes:
        with full.writing() as session:  # another process writes while this one waits
            session.execute(text("UPDATE datasets SET name = 'renamed'"))
        asked.append(key)
        return get(objects, key)

    get = Objects.get
    monkeypatch.setattr(Objects, "get", late)
    Store(settings).close()
    assert asked == [MARK]


def test_a_sweep_stops_when_the_objects_have_become_others(full: Store) -> None:
    full.objects.put(MARK, b'{"deployment": "dep_other"}')
    with pytest.raises(DeploymentError):
        housekeeping.sweep(full, orphan_seconds=-1, grace_seconds=-1)
    full.objects.put(MARK, b"[]")
    with pytest.raises(DeploymentError, match="backup"):
        housekeeping.sweep(full, orphan_seconds=-1, grace_seconds=-1)
    assert len(keys(full)) == 1
