"""How the detectors of a camera lie to each other, so far as matching needs it: by the stars and the dithers."""
