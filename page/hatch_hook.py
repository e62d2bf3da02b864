"""Has wheel and sdist hold the built page, so that whoever installs them needs no node."""

import subprocess
import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class PageHook(BuildHookInterface[Any]):
    """Builds the page before anything is packed, where its sources changed."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build; where that cannot be done, what is packed has no page or the one there was."""
        if version != "editable":
            script = str(Path(self.root, "page", "build.py"))
            subprocess.run([sys.executable, script], check=False)  # noqa: S603 (our own)
