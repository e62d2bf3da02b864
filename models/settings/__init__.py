"""What a fit can be told, what is known of its cameras, and what keypoints must be like.

Offers `config.FitConfig`, `calibration.Camera` and `keypoints.check_keypoints`. Imports neither
torch nor Numba: processes that fork, or that only check, load it cheaply.
"""
