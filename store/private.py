"""What lies in the data folder is its user's alone."""

import logging
import os

from store.settings import StoreSettings

logger = logging.getLogger(__name__)

OURS = ("records.db", "records.db-wal", "records.db-shm", "objects", "valkey", "serve.lock")


def keep_private(settings: StoreSettings) -> None:
    """Close to other users of the machine what this process will write, and what is there of ours.

    A data folder that was there is left as it is, for it may hold other things. Records and objects
    that both live elsewhere are no business of this.
    """
    if not settings.uses_data_dir:
        return
    os.umask(0o077)
    for name in OURS:
        path = settings.data_dir / name
        try:
            mode = path.stat().st_mode
            if mode & 0o077:
                path.chmod(mode & 0o700)
        except FileNotFoundError:
            continue
        except PermissionError:
            logger.warning("Other users can read %s, which is not ours to close", path)
