"""Geometry of static cameras from the keypoints of all frames, without shapes or a network.

For static cameras, all keypoints of all frames are correspondences of one epipolar geometry per
pair of views. Begin with `fundamental.py`; `order_checks.py` finds views, sides and cameras that
changed between frames.
"""
