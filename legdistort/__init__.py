"""Joint estimation of star positions and Legendre distortions from dithered exposures.

From positions of stars measured in many dithered exposures legdistort estimates at once the distortion-free position
of every star and the distortion of every exposure (Bernard et al. 2017), and hands the result on as astropy models,
gwcs objects, ASDF files and a co-added image.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # what type checkers and editors read; `_PLACES` states the same for Python
    from .assessment.map_difference import difference as difference
    from .assessment.nights.camera_memory import CombinedNights as CombinedNights
    from .assessment.nights.camera_memory import combine_nights as combine_nights
    from .cameras.camera import Camera as Camera
    from .cameras.detector import Detector as Detector
    from .coaddition.mosaic import Mosaic as Mosaic
    from .coaddition.mosaicking import coadd as coadd
    from .exceptions import LegdistortError as LegdistortError
    from .exceptions import LegdistortWarning as LegdistortWarning
    from .inputs.exposure_files import open_exposures as open_exposures
    from .inputs.exposure_files import read_exposures as read_exposures
    from .inputs.exposures import Exposure as Exposure
    from .matching.matcher import match as match
    from .matching.matches import Matches as Matches
    from .measurement.effective.model import EffectivePSF as EffectivePSF
    from .measurement.noise_calibration import calibrate_noise as calibrate_noise
    from .measurement.positions import effective_psf as effective_psf
    from .measurement.positions import measure as measure
    from .photometry.catalogue import Catalogue as Catalogue
    from .photometry.catalogue import catalogue as catalogue
    from .pipeline import run as run
    from .priors.prior import Prior as Prior
    from .results.solution import Solution as Solution
    from .simulation.instruments.instrument import Instrument as Instrument
    from .simulation.observations import simulate_exposures as simulate_exposures
    from .simulation.observations import simulate_matches as simulate_matches
    from .simulation.prediction import predict as predict
    from .solving.estimation import solve as solve
    from .solving.terms.term import Term as Term
    from .wcs.refinement import refine as refine
    from .wcs.storage import read_wcs as read_wcs

__version__: str  # of the package as it is installed, see `__getattr__`

# Loaded when first asked for: astropy.modeling looks into this package for a fitter while it is itself half imported,
# and a program that only fits models should not wait for the rest.
_PLACES = {
    "Camera": "cameras.camera",
    "Catalogue": "photometry.catalogue",
    "CombinedNights": "assessment.nights.camera_memory",
    "Detector": "cameras.detector",
    "EffectivePSF": "measurement.effective.model",
    "Exposure": "inputs.exposures",
    "Instrument": "simulation.instruments.instrument",
    "LegdistortError": "exceptions",
    "LegdistortWarning": "exceptions",
    "Matches": "matching.matches",
    "Mosaic": "coaddition.mosaic",
    "Prior": "priors.prior",
    "Solution": "results.solution",
    "Term": "solving.terms.term",
    "calibrate_noise": "measurement.noise_calibration",
    "catalogue": "photometry.catalogue",
    "coadd": "coaddition.mosaicking",
    "combine_nights": "assessment.nights.camera_memory",
    "difference": "assessment.map_difference",
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


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        value = globals()[name] = version("legdistort")
        return value
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(f".{_PLACES[name]}", __name__), name)
    return value


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})
