"""The geometry of a detector: Legendre basis, poses, distortions as functions and models, the plane on the sky."""

import astropy.modeling.fitting  # noqa: F401  (it loads our fitter: before that is being imported by anybody else)
