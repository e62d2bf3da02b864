"""Findings: what is noticed about a capture, its cameras, a fit or a lift, in one vocabulary.

Begin with `finding.py` (the shape of a finding) and `catalogue.py` (every code, what it leads to
and what to do). Imports neither torch nor Numba. What notices a finding lives where its evidence
is: `models.capture`, `models.epipolar`, `models.calibrating`, `models.lifting`.
"""
