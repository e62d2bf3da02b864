"""Animations to files: a module for each format, put together in `registry.py`."""

from fewview.writers.registry import FORMATS, write

__all__ = ["FORMATS", "write"]
