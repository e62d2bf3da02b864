"""The client of Fewview: captures from files, fits and lifts over HTTP, animations to files."""

from fewview.animation import Animation
from fewview.capture import Capture
from fewview.writers import write

__all__ = ["Animation", "Capture", "write"]
