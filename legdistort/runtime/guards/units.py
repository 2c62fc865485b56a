"""Units at the border: what callers give with a unit becomes the plain number that the documentation states.

The unit belongs to the name of an argument, whatever function or class takes it: one name has one meaning.
"""

import inspect
from collections.abc import Mapping
from functools import wraps
from typing import TypeVar

import numpy as np
from astropy import units as u
from astropy.table import Column
from astropy.time import Time, TimeDelta

from ...exceptions import InputError
from .offline import offline

_COUNT = u.adu, u.ct, u.dimensionless_unscaled
#: Units of the arguments that have one; several that astropy does not convert mean the same.
UNITS = {
    **dict.fromkeys(("fwhm", "tolerance", "error_floor", "night_sigma", "box", "half", "offset"), (u.pix,)),
    **dict.fromkeys(("mean", "sigma", "static_sigma", "common_sigma", "common_map", "static", "dynamic"), (u.pix,)),
    **dict.fromkeys(("spectrum", "static_spectrum", "dither", "dithers", "margin", "pose_error"), (u.pix,)),
    **dict.fromkeys(("stars", "positions", "xy", "f", "errors", "parallax"), (u.pix,)),
    **dict.fromkeys(("motion", "motion_sigma"), (u.pix / u.yr,)),
    **dict.fromkeys(("epoch", "epochs", "motion_epoch", "date"), (u.yr,)),
    **dict.fromkeys(("saturation", "fluxes"), _COUNT),
    **dict.fromkeys(("covariance", "static_covariance", "layout_covariance"), (u.pix**2,)),
    "shift": (u.pix,),
    "rotation": (u.deg,),
    "gain": tuple(u.electron / each for each in _COUNT),
    "read_noise": (u.electron,),
    "exposure_time": (u.s,),
    "rotations": (u.deg,),
    "parallactic_angle": (u.deg,),
    "pixel_scale": (u.arcsec, u.arcsec / u.pix),
    "zero_point": (u.mag,),
    "mag": (u.mag,),
    "sky_brightness": (u.mag / u.arcsec**2,),
    "dark_current": (u.electron / u.s,),
    "full_well": (u.electron,),
    "psf_scale": (u.arcsec,),
}
#: These read units themselves.
_OWN = frozenset({"reference_error", "data", "mask", "uncertainty"})
_WHOLE = frozenset({"box"})
_Takes = TypeVar("_Takes")


def plain_numbers(takes: _Takes) -> _Takes:
    """A function, or a class, that takes its arguments with units too.

    Lengths are converted to pixels, angles by ``pixel_scale`` where that is given, or by the scale of a sky that one of
    the arguments has; epochs to years, from `~astropy.time.Time` too.

    Raises
    ------
    InputError
        From what is decorated, naming an argument whose unit is none of those in `UNITS`.
    """
    if isinstance(takes, type):
        takes.__init__ = plain_numbers(takes.__init__)
        return takes
    signature = inspect.signature(takes)
    (words,) = [p.name for p in signature.parameters.values() if p.kind is p.VAR_KEYWORD] or [None]

    @wraps(takes)
    def bordered(*args, **kwargs):
        if any(map(_has_unit, (*args, *kwargs.values()))):
            try:
                bound = signature.bind_partial(*args, **kwargs)
            except TypeError:  # what Python says of it is better than anything
                return takes(*args, **kwargs)
            given, scalable = bound.arguments, "pixel_scale" in signature.parameters
            if _has_unit(given.get("pixel_scale")):
                given["pixel_scale"] = plain(given["pixel_scale"], "pixel_scale")
            scale = _scale(given)
            for name, value in given.items():
                given[name] = plain(value, name, scale, scalable=scalable, inside=name == words)
            return takes(*bound.args, **bound.kwargs)
        return takes(*args, **kwargs)

    return bordered


def plain(value, name, pixel_scale=None, *, scalable=False, inside=False):
    """The plain number, array, list or dict that a value with units is, in the unit of its name.

    Parameters
    ----------
    value : object
        What has no unit anywhere comes back as it is.
    name : str
        Of the argument.
    pixel_scale : float, optional
        Arcsec, for angles that stand for lengths.
    scalable : bool
        Whether the message may ask for one.
    inside : bool
        Whether the value is a dict of arguments with names of their own.

    Raises
    ------
    InputError
        Naming the argument.
    """
    how = {"scalable": scalable}
    if isinstance(value, Mapping) and _has_unit(value):
        return {
            key: plain(each, key if inside or key in UNITS else name, pixel_scale, **how) for key, each in value.items()
        }
    if isinstance(value, (list, tuple)) and _has_unit(value):
        return type(value)(plain(each, name, pixel_scale, **how) for each in value)
    if not _has_unit(value) or name in _OWN:
        return value
    units = UNITS.get(name, ())
    value = u.Quantity(value) if isinstance(value, Column) else value
    if isinstance(value, Time) and not isinstance(value, TimeDelta):
        if u.yr not in units:
            raise InputError(f"{name} is no time: got {value!r}")
        with offline():
            return np.asarray(value.jyear)[()]
    value = value.to(u.day) if isinstance(value, TimeDelta) else value
    if value.unit.is_equivalent(u.dimensionless_unscaled):
        return _numbers(value, u.dimensionless_unscaled, name)
    for unit in units:
        if value.unit.is_equivalent(unit):
            return _numbers(value, unit, name)
    if pixel_scale and units and value.unit.is_equivalent(units[0] * u.arcsec / u.pix):
        return _numbers(value / (pixel_scale * u.arcsec / u.pix), units[0], name)
    angle = scalable and bool(units) and value.unit.is_equivalent(units[0] * u.arcsec / u.pix)
    wanted = f"in {units[0].to_string()}" if units else "a number without a unit"
    cure = ", or give pixel_scale, by which angles are lengths" if angle else ""
    raise InputError(f"{name} must be {wanted}{cure}; got {value if value.isscalar else value.unit}")


def _numbers(value, unit, name):
    numbers = value.to_value(unit)
    return int(numbers) if name in _WHOLE and np.ndim(numbers) == 0 and numbers == int(numbers) else numbers


def _has_unit(value):
    """Whether something has a unit, or holds what has one."""
    if isinstance(value, Mapping):
        return any(map(_has_unit, value.values()))
    if isinstance(value, (list, tuple)):
        return any(map(_has_unit, value))
    return isinstance(value, (u.Quantity, Time, TimeDelta)) or (isinstance(value, Column) and value.unit is not None)


def _scale(given):
    """Arcsec a pixel, of the arguments of a function; None if nothing says it."""
    if given.get("pixel_scale") is not None:
        return given["pixel_scale"]
    if hasattr(given.get("instrument"), "pixel_scale"):
        return given["instrument"].pixel_scale
    skies = [getattr(value, "sky", None) for value in given.values()]
    return next((sky.pixel_scale for sky in skies if hasattr(sky, "pixel_scale")), None)
