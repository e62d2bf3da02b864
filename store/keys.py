"""The keys of objects: ``datasets/ds_.../chunk_....SUM.safetensors`` and so on.

``SUM`` is the CRC-32 of the object, in hexadecimal, with which a reader checks that the object is
undamaged. Objects of older versions have none.
"""

import re
import zlib

from store.ids import new_id

FOLDERS = ("datasets", "fits", "models", "lifts")
_ID = "[a-z]+_[0-9a-z]{26}"
_OURS = re.compile(
    rf"(?:{'|'.join(FOLDERS)})/{_ID}/(?:{_ID}|weights)(?:\.([0-9a-f]{{8}}))?\.(?:safetensors|jsonl?)"
)


def of_chunk(dataset_id: str, data: bytes) -> str:
    """Return a new key for frames of a dataset."""
    return f"datasets/{dataset_id}/{new_id('chunk')}.{_checksum(data)}.safetensors"


def of_checkpoint(fit_id: str, data: bytes) -> str:
    """Return a new key for a checkpoint of a fit."""
    return f"fits/{fit_id}/{new_id('checkpoint')}.{_checksum(data)}.safetensors"


def of_reconstruction(fit_id: str, data: bytes) -> str:
    """Return a new key for the reconstruction of a fit."""
    return f"fits/{fit_id}/{new_id('reconstruction')}.{_checksum(data)}.safetensors"


def of_first_model(fit_id: str, data: bytes) -> str:
    """Return a new key for the model of a fit's first answer."""
    return f"fits/{fit_id}/{new_id('model')}.{_checksum(data)}.safetensors"


def of_report(fit_id: str, data: bytes) -> str:
    """Return a new key for the report on a fit."""
    return f"fits/{fit_id}/{new_id('report')}.{_checksum(data)}.json"


def of_weights(model_id: str, data: bytes) -> str:
    """Return the key for the weights of a model."""
    return f"models/{model_id}/weights.{_checksum(data)}.safetensors"


def of_lifted(lift_id: str, arrays: bytes, lines: bytes) -> tuple[str, str]:
    """Return new keys for a part of a lift's result: its arrays and its JSON lines."""
    folder = f"lifts/{lift_id}"
    return (
        f"{folder}/{new_id('arrays')}.{_checksum(arrays)}.safetensors",
        f"{folder}/{new_id('lines')}.{_checksum(lines)}.jsonl",
    )


def _checksum(data: bytes) -> str:
    return f"{zlib.crc32(data):08x}"


def checksum_of(key: str) -> int | None:
    """Return the CRC-32 that the object under a key of ours has; None for one of older versions."""
    ours = _OURS.fullmatch(key)
    return None if ours is None or ours[1] is None else int(ours[1], 16)


def is_ours(key: str) -> bool:
    """Return whether an object is one that Fewview writes; no other is ever deleted."""
    return _OURS.fullmatch(key) is not None
