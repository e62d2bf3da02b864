"""The shape priors that a fit can train, one file each, and their interface.

Offers `registry.make_prior` and `registry.lay_out`, which choose a prior by the configuration;
`prior.Prior`, the interface; and `dispatch`, through which compiled functions call their prior.
"""
