"""The geometry of a detector: Legendre basis, poses, distortions as functions and models, the plane on the sky."""
