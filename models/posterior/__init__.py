"""How far answers may be off: the posterior of frames and cameras about the answers.

The factors of a frame and their elimination are in `frame`, compiled; `frames` takes many frames,
and `answers` makes them of what a lift answered. `learning` measures noise, shapes and cameras on
the frames of a fit, and `responses` what its lifts do besides. `posterior` is what a fit keeps of
all this, and `deviations` and `quality` are what lifts ask of it. `views_worth` asks what other
cameras would leave.
"""
