"""The parts of any HTTP service; nothing here depends on keypoints.

``errors``
    Every error as RFC 9457 problem details: ``ApiError``, ``invalid``, ``problems``.
``dependencies``
    Dependencies of endpoints: the settings, the store, the queue, the parameters of pages.
``hosts``, ``origins``
    Names of the service, and web pages, that requests may come by.
``connections``, ``peers``
    Connections within bounds, and which user of this machine is at the other end of one.
``authentication``, ``keyring``, ``local_owner``
    Who sends a request: the holder of a key, or the service's own user.
``safe_headers``
    What every answer forbids browsers to do with it.
``body_bytes``, ``uploads``, ``zips``, ``json_bounds``
    Bodies on their way in: their bytes in hand, what they are, how many items JSON may have.
``key_rates``, ``places``, ``fair_queue``
    How much a key may ask for in a second; places at a time, and who gets the next.
``head``
    HEAD wherever there is a GET.
``negotiation``, ``downloads``
    Which representation a client gets, and responses of bytes with ranges and entity tags.
``idempotency``
    The ``Idempotency-Key`` header.
``request_ids``, ``metrics``
    Identifiers of requests, and their counters.
``operations``
    Parts of the OpenAPI document that FastAPI cannot derive from the code.
"""
