"""Backups of one project."""

from pathlib import Path
from typing import Any

from store import access_keys, audit, datasets, fits, lookup, models
from store.authors import Author
from store.database import Store
from store.datasets import Description
from store.records import Dataset, FitJob, Model
from store.settings import StoreSettings
from tests.service.process.test_keeping import CAPTURE, done, here, refused, store

__all__ = ["here", "store"]  # fixtures


def names_of(store: Store, kind: type[Any]) -> list[str]:
    return [found.name for found in lookup.page(store, kind, limit=9, after=None)]


def test_a_backup_of_one_project_has_nothing_of_the_others(
    store: Store, here: tuple[str, ...], weights: bytes, tmp_path: Path
) -> None:
    gait = store.on_behalf_of(Author("gait"))
    dataset = datasets.create(gait, CAPTURE, Description("mine"))
    models.create(gait, weights, name="mine", keypoints=5, config={}, training_curve=[], metrics={})
    fits.create(gait, dataset_id=dataset.id, name="mine", config={})
    key, _ = access_keys.create(gait, name="mine", scopes=["read"], project="gait")
    access_keys.create(store, name="others", scopes=["read"])
    assert "2 objects: 2 copied" in done("backup", *here, "--project=gait")
    assert "project 'gait'" in refused("backup", *here)
    assert "project 'gait'" in refused("backup", *here, "--project=default")
    assert "no project 'none'" in refused("backup", tmp_path / "none", here[1], "--project=none")
    done("restore", here[0], f"--data-dir={tmp_path / 'back'}")
    restored = Store(StoreSettings(data_dir=tmp_path / "back"))
    kinds: list[Any] = [Dataset, Model, FitJob]
    assert [names_of(restored, kind) for kind in kinds] == [["mine"]] * 3
    assert [found.id for found in access_keys.page(restored, limit=9)] == [key.id]
    assert {entry.project for entry in audit.page(restored, limit=99)} == {"gait"}
    assert datasets.load(restored, dataset.id).frames == len(CAPTURE.keypoints)
    (model,) = lookup.page(restored, Model, limit=9, after=None)
    assert models.load_weights(restored, model) == weights
    restored.close()
