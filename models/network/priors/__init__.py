"""The shape priors that a fit can train, a file each."""
