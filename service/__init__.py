"""The HTTP service, in packages; each imports only from those before it.

``settings``
    The settings of the service.
``http``
    The parts of any HTTP service: errors, limits, uploads, downloads, idempotency.
``wire``
    The formats of messages: arrays, captures, cameras, and the messages of a stream.
``realtime``
    Lifts that are answered at once: the engine, ``POST /lift``, ``/lift/stream``.
``resources``
    Stored resources, one module for each name in the URLs.
``process``
    ``fewview serve``: the supervisor.

``app`` combines the packages, ``cli`` is the ``fewview`` command, and ``openapi`` prints the
document.
"""
