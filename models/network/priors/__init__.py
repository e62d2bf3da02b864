"""The shape priors that a fit can train, a file each, and the socket that they fit in.

Offers `registry.make_prior` and `registry.lay_out`, which choose by the configuration;
`prior.Prior`, what each of them gives; `dispatch`, by which compiled functions call the one that
they are for.
"""
