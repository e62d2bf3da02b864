"""The formats of messages: JSON, npz, safetensors, and the bytes of a stream.

``arrays``
    Arrays from and to bytes, and from nested lists.
``captures``
    Keypoints of a request, checked against the limits.
``detector_files``, ``reading_apart``, ``file_readers``
    Files as detectors write them, read in the sandbox.
``sandbox``, ``confinement``, ``system_calls``, ``libc``
    Processes for the files and bodies of strangers, and what they cannot do.
``schemas``, ``skeletons``, ``cameras``
    The JSON forms of keypoints and lifts, of skeletons, and of a model's cameras.
``representations``
    Answers that carry a lift's arrays, in the form that the client accepts.
``stream_messages``, ``watch_messages``
    The messages of a stream of frames, and those to who watches one.
"""
