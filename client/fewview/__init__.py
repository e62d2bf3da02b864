"""The client of Fewview: captures from files, fits and lifts over HTTP, animations to files."""

from fewview.capture import Capture

__all__ = ["Capture"]
