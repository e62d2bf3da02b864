"""What the cameras saw, before any learning: normalised views, checks, denoising, baselines.

Offers `observations.as_observations`, `checks.capture_findings`,
`noise_removal.learn_noise_removal`, `triangulation.triangulate` (the baseline with known cameras),
`metrics.pa_mpjpe`, and `synthetic.synthetic_capture`.
"""
