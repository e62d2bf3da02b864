"""What the cameras saw, before any learning: normalised views, denoising, baselines, metrics.

Offers `observations.as_observations`, `denoising.learn_denoiser`, `triangulation.triangulate` (the
baseline with known cameras), `metrics.pa_mpjpe`, and `synthetic.synthetic_capture`.
"""
