"""Options of `legdistort.solve`, checked before anything is computed."""

from numbers import Real

import numpy as np

from ..exceptions import InputError
from ..geometry import basis
from ..inputs.reference_catalogue import read_reference, year
from ..runtime.checks import check_choice
from . import minimisers
from .choices import held_out_stars
from .equations import problem_builder
from .gauge.constraints import KINDS

METHODS = ("joint", "alternating")
ERRORS = ("stated", "scale", "floor")


def check_options(*, degree=3, gauge="minimal", method="joint", loss="linear", clip=None, error_floor=0.0,
                  errors="stated", max_iterations=None, static=None, exposure_degree=None, validate=None):  # fmt: skip
    """Raise `InputError` for options of `solve` that are out of range or contradict one another."""
    held_out_stars.check_degree(degree)
    held_out_stars.check_validate(validate)
    if degree == held_out_stars.AUTO and static is not None:
        raise InputError("static='fit' needs a degree in numbers, not 'auto'")
    own_degree(static, exposure_degree, degree, method)
    check_choice(gauge, KINDS, "gauge")
    problem_builder.check_error_floor(error_floor)
    check_choice(method, METHODS, "method")
    if method == "alternating" and (loss != "linear" or clip is not None):
        raise InputError("method='alternating' is the published scheme: it takes neither loss nor clip")
    check_choice(loss, minimisers.LOSSES, "loss")
    check_choice(errors, ERRORS, "errors")
    if errors != "stated" and loss != "linear":
        raise InputError(f"errors={errors!r} compares chi2 with its expectation, which loss={loss!r} changes; use clip")
    if errors == "floor" and error_floor:
        raise InputError("errors='floor' finds the error floor itself: leave error_floor out")
    if max_iterations is not None and not (isinstance(max_iterations, int) and max_iterations > 0):
        raise InputError(f"max_iterations must be a positive integer, got {max_iterations!r}")
    if clip is not None and not (isinstance(clip, Real) and clip > 1):
        raise InputError(f"clip must be a number of standard errors above 1, got {clip!r}")


def own_degree(static, exposure_degree, degree, method):
    """Up to which degree exposures have modes of their own; None if they share nothing.

    Raises
    ------
    InputError
        For options that are out of range or contradict one another.
    """
    check_choice(static, (None, "fit"), "static")
    if static is None:
        if exposure_degree is not None:
            raise InputError("exposure_degree belongs to static='fit', where exposures share the modes above it")
        return None
    if method != "joint":
        raise InputError("static='fit' needs method='joint'")
    own = 1 if exposure_degree is None else basis.check_degree(exposure_degree, "exposure_degree")
    if own >= degree or degree < 2:
        raise InputError(
            f"static='fit' shares the modes above exposure_degree={own} up to degree={degree}: there are none; raise "
            "degree (at least 2) or lower exposure_degree"
        )
    return own


def check_reference(reference, *, epoch=None, pixel_scale=None, method="joint"):
    """The arguments of `solve` that concern a reference catalogue, checked: the catalogue read, and the epoch in years.

    Raises
    ------
    InputError
        For options out of range and for what is no catalogue.
    """
    if pixel_scale is not None and not (isinstance(pixel_scale, Real) and 0 < pixel_scale < np.inf):
        raise InputError(f"pixel_scale must be a positive number of arcsec, got {pixel_scale!r}")
    epoch = year(epoch)
    if reference is None:
        return None, epoch
    if method == "alternating":
        raise InputError("method='alternating' is the published scheme: it takes no reference")
    return read_reference(reference), epoch
