"""Moffat profiles fitted to all stars of a frame.

All stars are fitted at once, in arrays, by code of our own: `photutils.psf.PSFPhotometry`, which fits one star or group
after the other, takes five to fifteen times as long for the same positions.
"""
