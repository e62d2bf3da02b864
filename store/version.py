"""Which version of Fewview this code is of."""

from importlib.metadata import version
from typing import Final

VERSION: Final = version("fewview-server")
