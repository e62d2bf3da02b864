"""Self-calibration: lenses, handedness, resting cameras and shapes, from keypoints alone.

Offers `self_calibration.self_calibrate`; its result, for people (`result`) and for files
(`result_files`), knows nothing of how it was found. The search has a file for each of its parts:
what is known at its start (`problem`), which mirror image is right (`handedness`), noise and shapes
(`expectation_maximisation`), which cameras rest (`arrangement`), and lenses (`lens_prior`).
"""
