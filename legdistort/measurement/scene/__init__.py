"""Crowded frames: all stars fitted together with one PSF, subtracted, and the rest searched for more."""
