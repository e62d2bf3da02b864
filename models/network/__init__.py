"""Neural shape priors: the networks, their loss and gradients, and the compiled network.

Offers the priors in `priors`, `reprojection.reproject` and `losses.objective` (a training step,
with gradients), `feed_forward.feed_forward` (compiled answers of a fitted prior) and
`settling.settle`. Compiled functions are in `*_kernels` and `reprojection_gradients`. Their twins
for training on other devices than the CPU are in `reprojection_tensors` and
`losses.plain_objective`.
"""
