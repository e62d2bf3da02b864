"""Neural shape priors: what is trained, its loss and gradients, and the compiled network.

Offers the priors in `priors`, `reprojection.reproject` and `losses.objective` (a training step,
with gradients), `feed_forward.feed_forward` (compiled answers of a fitted prior) and
`settling.settle`.
"""
