"""Under which keys objects lie: ``datasets/ds_.../chunk_....safetensors`` and so on."""

import re

from store.ids import new_id

FOLDERS = ("datasets", "fits", "models", "lifts")
_ID = "[a-z]+_[0-9a-z]{26}"
_OURS = re.compile(rf"(?:{'|'.join(FOLDERS)})/{_ID}/(?:{_ID}|weights)\.(?:safetensors|jsonl)")


def of_chunk(dataset_id: str) -> str:
    """Return a new key for frames of a dataset."""
    return f"datasets/{dataset_id}/{new_id('chunk')}.safetensors"


def of_checkpoint(fit_id: str) -> str:
    """Return a new key for a checkpoint of a fit."""
    return f"fits/{fit_id}/{new_id('checkpoint')}.safetensors"


def of_reconstruction(fit_id: str) -> str:
    """Return a new key for the reconstruction of a fit."""
    return f"fits/{fit_id}/{new_id('reconstruction')}.safetensors"


def of_weights(model_id: str) -> str:
    """Return the key for the weights of a model."""
    return f"models/{model_id}/weights.safetensors"


def of_lifted(lift_id: str) -> tuple[str, str]:
    """Return new keys for a part of a lift's result: its arrays and its JSON lines."""
    folder = f"lifts/{lift_id}"
    return f"{folder}/{new_id('arrays')}.safetensors", f"{folder}/{new_id('lines')}.jsonl"


def is_ours(key: str) -> bool:
    """Tell whether an object is one that Fewview writes; no other is ever deleted."""
    return _OURS.fullmatch(key) is not None
