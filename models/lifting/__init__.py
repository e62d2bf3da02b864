"""Lifting: a fitted prior applied to any frames.

Offers `fitted_prior.FittedPrior`, the refinement of single frames (`frame_refinement`) and lifts as
JSON (`frames_json`).
"""
