"""Self-calibration: lenses, handedness, static cameras and shapes, from keypoints alone.

Offers `self_calibration.self_calibrate`. Its result, for people (`result`) and for files
(`result_files`), does not depend on the search. The search has a file for each of its parts: its
data and given values (`problem`), the handedness (`handedness`), noise and shapes
(`expectation_maximisation`), static cameras (`arrangement`), and lenses (`lens_prior`).
"""
