"""Moffat profiles fitted to all stars of a frame.

All stars are fitted at once, in arrays, by code of our own: `photutils.psf.PSFPhotometry`, which fits one star or group
after the other, takes five to fifteen times as long (12 to 36 s for 5000 stars, against 0.45 ms a star).
"""
