"""The configuration of a fit, given cameras, and checks of keypoints.

Offers `config.FitConfig`, `calibration.Camera` and `keypoints.check_keypoints`. Imports neither
torch nor Numba, so that processes that fork, or that only check, load it quickly.
"""
