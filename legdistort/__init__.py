"""Joint estimation of star positions and Legendre distortions from dithered exposures.

From positions of stars measured in many dithered exposures legdistort estimates at once the distortion-free position
of every star and the distortion of every exposure (Bernard et al. 2017), and hands the result on as astropy models,
gwcs objects, ASDF files and a co-added image.
"""

from importlib.metadata import version

from .coaddition import coadd
from .estimation import solve
from .exceptions import LegdistortError, LegdistortWarning
from .exposures import Exposure, read_exposures
from .matches import Matches
from .matching import match
from .measurement import measure
from .mosaics import Mosaic
from .pipeline import run
from .priors import Prior
from .simulation import simulate_exposures, simulate_matches
from .solution import Solution

__version__ = version("legdistort")

__all__ = [
    "Exposure",
    "LegdistortError",
    "LegdistortWarning",
    "Matches",
    "Mosaic",
    "Prior",
    "Solution",
    "coadd",
    "match",
    "measure",
    "read_exposures",
    "run",
    "simulate_exposures",
    "simulate_matches",
    "solve",
]
