"""Lifts that are answered while the client waits.

``engine``
    The threads that lift for everybody, with the ``warm_models`` they keep.
``lift``
    ``POST /lift``.
``stream``, ``stream_frames``
    ``/lift/stream``: the conversation, and its frames in and out.
``frames``
    Frames that a model can lift, for both.
"""
