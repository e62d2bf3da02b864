"""How far answers may be off: the posterior of frames and cameras about the answers.

The factors of a frame and their elimination are in `frame`, compiled. `cameras` adds frames up to
the covariance of the cameras that all of them share, `learning` measures noise and shapes on the
frames of a fit, and `uncertainty` is what lifts ask.
"""
