"""Lenses: from points in a camera's frame to pixels, with analytic derivatives.

One file per camera model (`pinhole`, `kannala_brandt`), one door to all of them (`projection`),
through which everybody else goes: a view's camera model is a small integer in arrays, and its name
where people or files are spoken to.

To add a camera model: write its file as `kannala_brandt` is written (`NAME`, `LIFTED_AS`,
`start_from_pinhole`, `bend`, `differentiate`); in `projection`, add it to `LENSES` and a branch to
`_bend` and to `_differentiate`; in `models.settings.calibration`, add its two names to `LensName`
and `LiftedLensName`, and its numbers of coefficients to `NUMBERS_OF_COEFFICIENTS`. Files, lifts and
the API's document follow from these; only descriptions in words name every lens.
"""
