"""Fitting: from a capture to a fitted prior.

Offers `trainer.fit` and `trainer.Trainer`, which can be paused and resumed bit for bit.
"""
