"""One module a format: `fits` says whether a source is of it, `read` gives its views."""
