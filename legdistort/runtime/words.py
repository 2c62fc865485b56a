"""The words that arguments can take.

They stand apart from the functions that act on them, so that the command line can list them without loading those.
"""

# -- simulating
EXAMPLES = ("frames", "camera", "headers", "gwcs", "keck-lists", "hst-lists")

# -- priors
DIRECTIONS = ("detector_to_reference", "reference_to_detector")

# -- measuring
PROFILES = ("own", "shared", "linear")
BLENDS = ("together", "alone")
POSITION_ERRORS = ("fit", "injected", "scaled")

# -- solving
METHODS = ("joint", "alternating")
GAUGES = ("minimal", "mean")
LOSSES = ("linear", "huber", "cauchy")
ERRORS = ("stated", "scale", "floor", "by-brightness", "correlated")
MOTIONS = ("proper", "parallax", "acceleration", "auto")
TERMS = (
    "refraction",
    "differential_refraction",
    "pixel_phase",
    "acceleration",
    "orbits",
    "rough_static",
    "turbulence",
)
#: Those that a forecast takes by their sizes.
SIZED_TERMS = ("refraction", "pixel_phase", "turbulence")
#: What is done about layouts and static distortions of a camera; without one a static distortion can only be fitted.
CAMERA = ("hold", "prior", "fit")
#: What of a camera has a distortion of its own in every exposure.
DYNAMIC = ("focal_plane", "detector")

# -- the catalogue of all exposures, as the last step of a run
CATALOGUES = ("none", "joint")

# -- co-adding
COMBINATIONS = ("mean", "median", "clipped")
ALGORITHMS = ("interp", "adaptive", "exact", "drizzle")
ORDERS = {"nearest-neighbor": 0, "bilinear": 1, "biquadratic": 2, "bicubic": 3}  # of splines, as reproject names them
KERNELS = ("square", "turbo", "point")  # of drizzle, those that conserve flux
CONSERVE = ("flux", "surface_brightness")
WEIGHTS = ("noise", "variance", "exptime", "seeing", "sigma_map")
SCALES = ("auto", "exptime", "stars")
#: Source of the mean of a prior whose source is not stated.
UNSTATED = "unstated"
#: What a file can have beside the image, and the attribute of a mosaic that each is.
PLANES = {
    "UNCERT": "variance", "MASK": "mask", "WEIGHT": "weight", "FOOTPRINT": "footprint", "FLAGS": "flags",
    "EXTRAPOLATED": "extrapolated", "REJECTED": "rejected", "CONTEXT": "context",
}  # fmt: skip
#: Those that it has if nothing is said, and the word for all.
USUAL_PLANES, ALL_PLANES = ("UNCERT", "MASK", "FOOTPRINT"), "all"
EXTRAPOLATED = ("flag", "mask", "keep")
