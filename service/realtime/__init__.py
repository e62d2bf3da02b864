"""Lifts that are answered while the client waits.

``engine``
    The threads that lift for everybody, with the ``warm_models`` they keep.
``lift``
    ``POST /lift``.
``stream``, ``conversation``, ``stream_frames``
    ``/lift/stream``: how it begins, how it goes, and its frames in and out.
``watch``, ``open_streams``
    ``/lift/streams``: which are open in all processes, and watching one.
``sockets``
    What their WebSockets share.
``frames``
    Frames that a model can lift, for both.
"""
