"""Labels for detectors: which images are worth labelling, and which keypoints a fit accepts.

Offers `filmed.as_filmed` (the answer of a fit in the frames of each view's own film),
`evidence.weigh` (what supports each keypoint), `worth.rank` and `accepted.accept`. All of it is
arithmetic on arrays of a stored reconstruction; no network is needed.
"""
