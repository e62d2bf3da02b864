"""The one import name of the server's distribution.

The server's own packages are `models`, `store`, `worker` and `service`: names that others have,
too. Installed, they lie in this folder, and only processes of the server look for modules there.
"""

import os
import sys
from pathlib import Path

_HERE = Path(__file__).parent
PACKAGES = _HERE if (_HERE / "service").is_dir() else _HERE.parent  # a checkout has them beside it


def run(command: str, arguments: list[str]) -> None:
    """Run a command of the server, which finds its packages before all others.

    So do the processes that it starts. See `service.cli.run` for the commands and how they end.
    """
    known = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join((str(PACKAGES), *([known] if known else ())))
    sys.path.insert(0, str(PACKAGES))
    from service.cli import run as run_command  # noqa: PLC0415 (found only from here on)

    run_command(command, arguments)
