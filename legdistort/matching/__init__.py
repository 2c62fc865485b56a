"""Which detections are the same star.

Matching is written here and not taken from astroalign or tweakwcs: they lay one list on another by one global
transformation. Here shifts, rotations, flips and distortions of a hundred times the position errors come together,
hot pixels stay where they are while the sky moves, headers may point elsewhere, and what all exposures say of one
another must agree: pairs are registered by maps that grow with the stars found, tested against chance, and joined as a
graph in which a wrong pair contradicts the others.
"""
