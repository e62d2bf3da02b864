"""What machine a job needs, and so on which queue it waits."""

from pydantic import ValidationError

from models.settings.config import FitConfig
from store import lookup
from store.database import Store
from store.errors import NotFoundError
from store.records import DatasetRecord, FitRecord, LiftRecord
from worker.settings import QueueName

GPU_MULTIPLICATIONS = 200_000_000  # in a step: about what a core does while a GPU is given its work
KEYPOINT_MULTIPLICATIONS = 1000  # as long as a core takes for a keypoint, beside the network


def gpu_pays(config: FitConfig, frames: int, views: int, keypoints: int) -> bool:
    """Return whether a GPU takes such training steps faster than a processor core.

    For small dictionaries, starting a step on a GPU takes longer than the whole step on a CPU.
    `benchmarks/devices.py` measures both.
    """
    from models.network.priors.registry import outline  # noqa: PLC0415 (torch takes seconds)

    network = outline(config, keypoints).multiplications()
    frame = views * (network + KEYPOINT_MULTIPLICATIONS * keypoints)
    return frame * config.batch_of(frames) >= GPU_MULTIPLICATIONS


def queue_for(store: Store, record: FitRecord | LiftRecord) -> QueueName:
    """Return the queue on which a fit or a call for help with a lift is to wait."""
    if isinstance(record, LiftRecord):
        return "lifts"
    try:
        dataset = lookup.get(store, DatasetRecord, record.dataset_id)
        config = FitConfig.model_validate(record.config)
    except (NotFoundError, ValidationError):  # which the fit will report
        return "fits"
    pays = gpu_pays(config, dataset.frames, dataset.views, dataset.keypoints)
    return "gpu-fits" if pays else "fits"
