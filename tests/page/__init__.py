"""Tests of the page, a package so that its browser is closed when the last of them ends."""
