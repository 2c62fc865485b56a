"""Options of `legdistort.coadd`, checked as far as they can be before there are exposures."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS

from ..exceptions import InputError
from ..runtime.checks import check_choice
from .grids import checked_wcs
from .resampling.drizzling import Drop

METHODS = ("mean", "median", "clipped")
ALGORITHMS = ("interp", "adaptive", "exact", "drizzle")
ORDERS = {"nearest-neighbor": 0, "bilinear": 1, "biquadratic": 2, "bicubic": 3}  # of splines, as reproject names them
CONSERVE = ("flux", "surface_brightness")
WEIGHTS = ("noise", "variance", "exptime", "seeing", "sigma_map")
SCALES = ("auto", "exptime", "stars")
EXTRAPOLATED = ("flag", "mask", "keep")


@dataclass(frozen=True)
class CoaddOptions:
    """How exposures become a mosaic, see `legdistort.coadd` for what each option means.

    Attributes
    ----------
    method, algorithm, conserve, match_background, extrapolated, pixfrac, kernel, scratch
        As given.
    order : int
        Of the spline; its name becomes its number.
    grid : `~astropy.wcs.WCS`, `~astropy.io.fits.Header` or None
    weights, scale : str, None or dict
        A dict by exposure has positive numbers; whether it has the right names only the exposures tell.

    Raises
    ------
    InputError
        Naming the option that is not sound; or if a package is missing that it needs.
    """

    method: str = "mean"
    order: int | str = 3
    algorithm: str = "interp"
    grid: WCS | fits.Header | None = None
    conserve: str = "flux"
    match_background: bool = True
    weights: str | Mapping | None = "noise"
    scale: str | Mapping | None = "auto"
    extrapolated: str = "flag"
    pixfrac: float = 1.0
    kernel: str = "square"
    scratch: object = None

    def __post_init__(self):
        check_choice(self.method, METHODS, "method")
        check_choice(self.algorithm, ALGORITHMS, "algorithm")
        check_choice(self.conserve, CONSERVE, "conserve")
        check_choice(self.extrapolated, EXTRAPOLATED, "extrapolated")
        order = ORDERS.get(self.order, self.order) if isinstance(self.order, str) else self.order
        if isinstance(order, bool) or order not in range(6):
            raise InputError(f"order must be an integer from 0 to 5 or one of {', '.join(ORDERS)}, got {order!r}")
        object.__setattr__(self, "order", int(order))
        object.__setattr__(self, "weights", _choice_or_numbers("weights", self.weights, WEIGHTS))
        object.__setattr__(self, "scale", _choice_or_numbers("scale", self.scale, SCALES))
        if self.grid is not None:
            checked_wcs(self.grid)
        if self.algorithm == "drizzle":
            Drop(self.kernel, self.pixfrac)

    @property
    def drop(self):
        """The `~legdistort.coaddition.resampling.drizzling.Drop` of drizzle, None for other algorithms."""
        return Drop(self.kernel, self.pixfrac) if self.algorithm == "drizzle" else None


def _choice_or_numbers(argument, given, allowed):
    """A choice as it is given, or a copy of the numbers by exposure; `InputError` for what is neither."""
    if isinstance(given, Mapping):
        return by_name(argument, given, given)
    if given is not None and given not in allowed:
        raise InputError(
            f"{argument} must be one of {', '.join(map(repr, allowed))}, None or a dict by exposure, got {given!r}"
        )
    return given


def by_name(argument, given, names):
    """A dict of positive numbers by exposure, checked.

    Parameters
    ----------
    argument : str
        Its name, for the message.
    given : mapping
    names : iterable of str

    Returns
    -------
    dict

    Raises
    ------
    InputError
        If a number is missing or not positive.
    """
    for name in names:
        value = given.get(name)
        if not (isinstance(value, (int, float, np.number)) and np.isfinite(value) and value > 0):
            raise InputError(f"{argument} of exposure {name} must be a positive number, got {value!r}")
    return {name: float(given[name]) for name in names}
