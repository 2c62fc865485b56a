"""The mathematics of one detector: basis, poses, distortion, sky. No files, no tables."""
