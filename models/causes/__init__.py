"""Faults of one view's pixels: hypotheses, their evidence, and the maps that undo them."""
