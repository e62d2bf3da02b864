"""The HTTP service: one module per resource, thin endpoints over the store and the queue."""
