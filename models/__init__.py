"""The science: the neural shape prior, cameras, fitting, lifting, triangulation and metrics.

Importing this package imports nothing heavy: ``models.settings.config`` is free of torch, so that
processes which fork (the queue's worker) can validate a configuration without loading it.
"""
