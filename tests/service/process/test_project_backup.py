"""Backups of one project."""

from pathlib import Path
from typing import Any

from store import access_keys, aliases, audit, datasets, fits, lookup, models, webhooks
from store.authors import Author
from store.database import Store
from store.datasets import CaptureDescription
from store.records import DatasetRecord, FitRecord, ModelRecord
from store.settings import StoreSettings
from tests.service.process.test_keeping import CAPTURE, done, here, refused, store

__all__ = ["here", "store"]  # fixtures


def names_of(store: Store, kind: type[Any]) -> list[str]:
    return [found.name for found in lookup.page(store, kind, limit=9, after=None)]


def test_a_backup_of_one_project_has_nothing_of_the_others(
    store: Store, here: tuple[str, ...], weights: bytes, tmp_path: Path
) -> None:
    gait = store.on_behalf_of(Author("gait"))
    dataset = datasets.create(gait, CAPTURE, CaptureDescription("mine"))
    model = models.create(
        gait, weights, name="mine", keypoints=5, config={}, training_curve=[], metrics={}
    )
    fit = fits.create(gait, dataset_id=dataset.id, name="mine", config={})
    aliases.put(gait, "walk@production", model.id)
    webhook = webhooks.create(gait, "https://lab.example/", ["fit.cancelled"])
    webhooks.create(store, "https://lab.example/", webhooks.EVENTS)
    fits.cancel(gait, fit.id)
    assert webhooks.any_due(store)
    key, _ = access_keys.create(gait, name="mine", scopes=["read"], project="gait")
    access_keys.create(store, name="others", scopes=["read"])
    assert "2 objects: 2 copied" in done("backup", *here, "--project=gait")
    assert "project 'gait'" in refused("backup", *here)
    assert "project 'gait'" in refused("backup", *here, "--project=default")
    assert "no project 'none'" in refused("backup", tmp_path / "none", here[1], "--project=none")
    done("restore", here[0], f"--data-dir={tmp_path / 'back'}")
    restored = Store(StoreSettings(data_dir=tmp_path / "back"))
    kinds: list[Any] = [DatasetRecord, ModelRecord, FitRecord]
    assert [names_of(restored, kind) for kind in kinds] == [["mine"]] * 3
    assert [found.id for found in access_keys.page(restored, limit=9)] == [key.id]
    assert list(aliases.targets(restored)) == [("gait", "walk@production")]
    assert [found.id for found in webhooks.page(restored, limit=9)] == [webhook.id]
    assert not webhooks.any_due(restored)  # which the other deployment sends
    assert {entry.project for entry in audit.page(restored, limit=99)} == {"gait"}
    assert datasets.load(restored, dataset.id).frames == len(CAPTURE.keypoints)
    (copy,) = lookup.page(restored, ModelRecord, limit=9, after=None)
    assert models.load_weights(restored, copy) == weights
    restored.close()
