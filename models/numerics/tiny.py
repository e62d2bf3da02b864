"""The least divisor: what keeps quotients and roots finite where there is nothing to divide by."""

TINY = 1e-12
