"""The HTTP service, in rooms; each imports only from those before it.

``settings``
    What can be set.
``http``
    What any HTTP service needs: errors, limits, uploads, downloads, idempotency.
``wire``
    What travels: arrays, captures, cameras, and the messages of a stream.
``realtime``
    Lifts that are answered at once: the engine, ``POST /lift``, ``/lift/stream``.
``resources``
    What is stored, one module for each name in the URLs.
``process``
    ``fewview serve``: the supervisor.

``app`` puts the rooms together, ``cli`` is the ``fewview`` command, and ``openapi`` prints the
document.
"""
