"""Self-calibration: lenses, handedness, resting cameras and shapes, from keypoints alone.

Offers `self_calibration.discover` and its result, for people and for files (`result`).
"""
