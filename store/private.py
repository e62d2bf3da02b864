"""What is stored in files is its user's alone."""

import logging
from pathlib import Path

from store.settings import StoreSettings

logger = logging.getLogger(__name__)

OURS = ("records.db", "records.db-wal", "records.db-shm", "objects", "valkey", "serve.lock")


def keep_private(settings: StoreSettings) -> None:
    """Close to other users of the machine what is there of ours.

    What is written from now on is closed by the umask of all commands (`service.cli.run`). A folder
    that was there is left as it is, for it may hold other things, or be shared on purpose.
    """
    ours = [settings.data_dir / name for name in OURS] if settings.uses_data_dir else []
    records = settings.resolved_database_url
    if records.database is not None and records.drivername == "sqlite":
        ours += [Path(f"{records.database}{end}") for end in ("", "-wal", "-shm")]
    for path in ours:
        try:
            mode = path.stat().st_mode
            if mode & 0o077:
                path.chmod(mode & 0o700)
        except FileNotFoundError:
            continue
        except PermissionError:
            logger.warning("Other users can read %s, which is not ours to close", path)
