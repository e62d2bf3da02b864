"""Lenses: from points in a camera's frame to pixels, with analytic derivatives.

There is one file for each camera model (`pinhole`, `kannala_brandt`), and one interface to all of
them (`projection`), which all other code uses. A view's camera model is a small integer in arrays,
and a name in files and the API.

To add a camera model: write its file as `kannala_brandt` is written (`NAME`, `LIFTED_AS`,
`start_from_pinhole`, `bend`, `differentiate`); in `projection`, add it to `LENSES` and a branch to
`_bend` and to `_differentiate`; in `models.settings.calibration`, add its two names to `LensName`
and `LiftedLensName`, and its numbers of coefficients to `NUMBERS_OF_COEFFICIENTS`. Files, lifts and
the API's document follow from these; only descriptions in prose list every lens by hand.
"""
