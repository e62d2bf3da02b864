"""What is stored, by the names in the URLs: a module each, with its JSON form and its routes.

``datasets``, ``models``, ``fits``, ``lifts``, ``reconstructions``, ``health``.
Beneath them ``pages``, ``changes`` and ``jobs``, which several share.
"""
