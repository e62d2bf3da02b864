"""Streams of frames passed on to programs that show them as they come."""
