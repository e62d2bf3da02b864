"""All that a key keeps counts for its quota: objects, records, jobs of any state, and the audit."""

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import orjson
import pytest
from sqlalchemy import JSON, Text, select

from store import aliases, audit, datasets, fits, idempotency, lookup, models, usage, webhooks
from store.attempts import claim, end, save_checkpoint
from store.authors import Author
from store.capture import Capture
from store.database import Store
from store.datasets import CaptureDescription
from store.errors import QuotaError
from store.labels import Labels
from store.quotas import Quotas
from store.records import AuditRecord, DatasetRecord, FitRecord

CAPTURE = Capture(np.zeros((2, 2, 5, 2), np.float32))
NOTES = {"log": "x" * 5000}


def author(store: Store, stored_bytes: int | None = None, key: str = "key_a") -> Store:
    quotas = Quotas(stored_bytes=stored_bytes)
    return store.on_behalf_of(Author(project="lab", key_id=key, quotas=quotas))


def make(store: Store, metadata: Any = NOTES, **more: Any) -> DatasetRecord:
    labels = Labels(metadata=metadata)
    return datasets.create(store, CAPTURE, CaptureDescription("walk", labels=labels), **more)


def own(store: Store) -> dict[str, usage.Kept]:
    return usage.usage(store, 5).own


def kept(store: Store) -> int:
    return sum(each.size for each in own(store).values())


def test_every_free_column_counts() -> None:
    for kind in usage.ACCOUNTED:
        table: Any = kind.__table__
        counts = str(table.c.kept_bytes.computed.sqltext)
        free = [c.name for c in table.c if isinstance(c.type, JSON | Text)]
        assert [name for name in free if name not in counts] == [], kind


def test_all_kinds_count_until_they_are_deleted(store: Store) -> None:
    lab = author(store)
    assert kept(lab) == 0
    key = idempotency.Idempotency("create_dataset", "k", "f")
    dataset = make(lab, idempotency=key)
    size = own(lab)["datasets"].size
    assert size > 5000 + CAPTURE.keypoints.nbytes
    assert own(lab)["idempotency_keys"].records == 1
    datasets.append(lab, dataset.id, CAPTURE, max_frames=100)
    assert own(lab)["datasets"].size > size + CAPTURE.keypoints.nbytes

    webhooks.create(lab, "https://lab.example/x", ["fit.cancelled"])
    fit = fits.create(
        lab, dataset_id=dataset.id, name="f", config={}, labels=Labels(metadata=NOTES)
    )
    waits = own(lab)["fits"].size
    assert waits > 5000 + len(orjson.dumps(fit.config))
    attempt = claim(store, fit.id, lease_seconds=60)
    assert attempt is not None
    save_checkpoint(store, attempt, b"0" * 3000)
    assert own(lab)["fits"].size >= waits + 3000
    end(store, attempt, "cancelled")
    assert abs(own(lab)["fits"].size - waits) < 100
    assert own(lab)["deliveries"].records == 1
    assert own(lab)["deliveries"].size > own(lab)["webhooks"].size > 512

    model = models.create(lab, b"weights", keypoints=5, name="m", **OF_MODEL)
    aliases.put(lab, "walk@best", model.id)
    assert {name for name, each in own(lab).items() if not each.records} == {"lifts"}
    assert kept(author(store, key="key_b")) == 0
    assert usage.usage(author(store, key="key_b"), 5).project == own(lab)
    assert usage.usage(lab, 1).largest[0].id in (dataset.id, fit.id)

    aliases.delete(lab, "walk@best")
    models.delete(lab, model.id)
    fits.delete(lab, fit.id)
    datasets.delete(lab, dataset.id)
    left = {name for name, each in own(lab).items() if each.records}
    assert left == {"webhooks", "deliveries", "idempotency_keys", "audit"}


OF_MODEL: dict[str, Any] = {"config": {}, "training_curve": [], "metrics": {}}


def test_a_full_account_stops_what_adds_to_it_and_no_deletion(store: Store) -> None:
    lab = author(store, 20_000)
    made = [make(lab), make(lab)]
    with pytest.raises(QuotaError, match=r"may keep 20000 bytes.*3 datasets with \d+ bytes"):
        make(lab, {"log": "x" * 10_000})
    fit = fits.create(lab, dataset_id=made[0].id, name="f", config={})
    objects = {key for key, _ in store.objects.list()}
    full = author(store, kept(lab))  # to the last byte
    with pytest.raises(QuotaError):
        make(full, {})
    assert {key for key, _ in store.objects.list()} == objects
    for more in (
        lambda: datasets.append(full, made[0].id, CAPTURE, max_frames=100),
        lambda: fits.create(full, dataset_id=made[0].id, name="f", config={}),
        lambda: lookup.change(full, DatasetRecord, made[0].id, {"name": "run"}),
        lambda: webhooks.create(full, "https://lab.example/x", ["fit.failed"]),
        lambda: models.create(full, b"weights", keypoints=5, name="m", **OF_MODEL),
    ):
        with pytest.raises(QuotaError):
            more()
    assert kept(full) == full.author.quotas.stored_bytes  # type: ignore[union-attr]
    lookup.change(full, DatasetRecord, made[0].id, {"user_metadata": {}})  # which makes space
    fuller = author(store, 1)
    fits.cancel(fuller, fit.id)
    fits.delete(fuller, fit.id)
    for dataset in made:
        datasets.delete(fuller, dataset.id)
    with store.reading() as session:
        noted = session.scalars(select(AuditRecord.action).where(AuditRecord.project == "lab"))
        assert list(noted).count("dataset.delete") == len(made)


def test_what_changes_nothing_is_not_noted(store: Store) -> None:
    lab = author(store)
    dataset = make(lab)
    fit = fits.create(lab, dataset_id=dataset.id, name="f", config={})
    assert claim(store, fit.id, lease_seconds=60) is not None
    same = {"name": "walk", "user_metadata": NOTES}
    for _ in range(3):
        lookup.change(lab, DatasetRecord, dataset.id, same)
        fits.cancel(lab, fit.id)  # a running fit stops later
    assert [entry.action for entry in audit.page(store, limit=9)] == [
        "fit.cancel",
        "fit.create",
        "dataset.create",
    ]
    assert lookup.get(store, FitRecord, fit.id).revision == 3  # made, claimed, asked to stop


def test_side_by_side_no_more_is_kept_than_may_be(store: Store) -> None:
    lab = author(store, 20_000)

    def one(number: int) -> bool:
        try:
            make(lab, NOTES | {"number": number})
        except QuotaError:
            return False
        return True

    with ThreadPoolExecutor(6) as threads:
        made = sum(threads.map(one, range(6)))
    assert 2 <= made <= 3
    assert kept(lab) <= 20_000
