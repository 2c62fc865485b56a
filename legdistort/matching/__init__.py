"""Which detections are the same star.

Matching is written here and not taken from astroalign or tweakwcs: they lay one list on another by one global
transformation, and of fields with shifts, distortions, other scales and false detections together neither lays a single
pair right (``docs/matching.md`` has the table). Here pairs of exposures are registered by maps that grow with the stars
found, tested against chance, and joined as a graph in which a wrong pair contradicts the others.
"""
