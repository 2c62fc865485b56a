"""Joint estimation of star positions and Legendre distortions from dithered exposures.

From positions of stars measured in many dithered exposures legdistort estimates at once the distortion-free position
of every star and the distortion of every exposure (Bernard et al. 2017), and hands the result on as astropy models,
gwcs objects, ASDF files and a co-added image.
"""

from importlib import import_module
from importlib.metadata import version

__version__ = version("legdistort")

# Loaded when first asked for: astropy.modeling looks into this package for a fitter while it is itself half imported,
# and a program that only fits models should not wait for the rest.
_PLACES = {
    "Camera": "cameras.camera",
    "Detector": "cameras.detector",
    "EffectivePSF": "measurement.effective.model",
    "Exposure": "inputs.exposures",
    "LegdistortError": "exceptions",
    "LegdistortWarning": "exceptions",
    "Matches": "inputs.matches",
    "Mosaic": "coaddition.mosaic",
    "Prior": "priors.prior",
    "Solution": "results.solution",
    "calibrate_noise": "measurement.noise_calibration",
    "coadd": "coaddition.mosaicking",
    "effective_psf": "measurement.positions",
    "match": "matching.matcher",
    "measure": "measurement.positions",
    "open_exposures": "inputs.exposure_files",
    "predict": "simulation.prediction",
    "read_exposures": "inputs.exposure_files",
    "read_wcs": "wcs.storage",
    "refine": "wcs.refinement",
    "run": "pipeline",
    "simulate_exposures": "simulation.observations",
    "simulate_matches": "simulation.observations",
    "solve": "solving.estimation",
}

__all__ = sorted(_PLACES)


def __getattr__(name):
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(f".{_PLACES[name]}", __name__), name)
    return value


def __dir__():
    return sorted({*globals(), *__all__})
