"""One module for each format: `fits` tests whether a source is of it, `read` returns its views."""
