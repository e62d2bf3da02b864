"""One module a revision; ``store.schema`` has them in their order."""
