"""What two views of all frames say together, for cameras at rest, without shapes or a network.

For cameras at rest, all keypoints of all frames are correspondences of one epipolar geometry per
pair of views. Begin with `fundamental.py`; `order_checks.py` finds what
changed places or moved between frames.
"""
