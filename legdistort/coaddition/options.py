"""Options of `legdistort.coadd`, checked as far as they can be before there are exposures."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS

from ..exceptions import InputError
from ..runtime.checks import check_choice
from ..runtime.scratch import scratch_folder
from ..runtime.words import (
    ALGORITHMS,
    ALL_PLANES,
    COMBINATIONS,
    CONSERVE,
    EXTRAPOLATED,
    KERNELS,
    ORDERS,
    PLANES,
    SCALES,
    USUAL_PLANES,
    WEIGHTS,
)
from .grids import checked_wcs
from .resampling.engines import Resampling, uses_compiled_splines


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
        A dict by exposure has positive numbers; whether it has the right names is seen with the exposures.
    planes : tuple of str
        Keys of `legdistort.runtime.words.PLANES`; None becomes the usual ones, "all" becomes all.

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
    planes: tuple | str | None = None

    def __post_init__(self):
        choices = {"method": COMBINATIONS, "algorithm": ALGORITHMS, "conserve": CONSERVE, "extrapolated": EXTRAPOLATED}
        for name, allowed in choices.items():
            check_choice(getattr(self, name), allowed, name)
        order = ORDERS.get(self.order, self.order) if isinstance(self.order, str) else self.order
        if isinstance(order, bool | np.ndarray) or order not in range(6):
            raise InputError(f"order must be an integer from 0 to 5 or one of {', '.join(ORDERS)}, got {order!r}")
        object.__setattr__(self, "order", int(order))
        for name, allowed in (("weights", WEIGHTS), ("scale", SCALES)):
            object.__setattr__(self, name, _choice_or_numbers(name, getattr(self, name), allowed))
        object.__setattr__(self, "planes", _named_planes(self.planes))
        if self.grid is not None:
            checked_wcs(self.grid)
        if self.scratch is not None:
            with scratch_folder(self.scratch, 0):  # tried before hours of work
                pass
        if self.algorithm == "drizzle":
            self._check_drops()

    def _check_drops(self):
        check_choice(self.kernel, KERNELS, "kernel")
        is_number = isinstance(self.pixfrac, (int, float, np.number)) and not isinstance(self.pixfrac, bool)
        if not (is_number and 0 < self.pixfrac <= 1):
            raise InputError(f"pixfrac must be a number above 0 and up to 1, got {self.pixfrac!r}")
        try:
            import drizzle.resample  # noqa: F401
        except ImportError:
            raise InputError("algorithm='drizzle' needs the package drizzle: pip install legdistort[drizzle]") from None

    def resampling(self, n_pixels):
        """The `~legdistort.coaddition.resampling.engines.Resampling` of so many pixels of all exposures."""
        compiled = uses_compiled_splines(self.algorithm, self.order, n_pixels)
        return Resampling(self.algorithm, self.order, self.kernel, self.pixfrac, compiled)

    def check_names(self, names):
        """Raise `InputError` if weights or flux scales are given for other exposures than these."""
        for argument, given in (("weights", self.weights), ("scale", self.scale)):
            unknown = [str(name) for name in given if name not in names] if isinstance(given, Mapping) else []
            if unknown:
                raise InputError(f"{argument}: no exposure of that name is co-added: {', '.join(unknown)}")


def _named_planes(given):
    """The names of the planes that are asked for, as a tuple; `InputError` for those that there are not."""
    if given is None:
        return USUAL_PLANES
    planes = tuple(given) if isinstance(given, (list, tuple, set)) else (given,)
    for plane in planes:
        check_choice(plane, (*PLANES, ALL_PLANES), "planes")
    return tuple(PLANES) if ALL_PLANES in planes else planes


def _choice_or_numbers(argument, given, allowed):
    """A choice as it is given, or a copy of the numbers by exposure; `InputError` for what is neither."""
    if isinstance(given, Mapping):
        return by_name(argument, given, given)
    if isinstance(given, np.ndarray) or (given is not None and given not in allowed):
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
