"""Findings about a capture, its cameras, a fit or a lift, in one form and one vocabulary.

Begin with `finding.py` (the fields of a finding) and `catalogue.py` (every code, its effect and its
remedy). Imports neither torch nor Numba. The checks that make findings are where their evidence is:
`models.capture`, `models.epipolar`, `models.calibrating`, `models.lifting`.
"""
