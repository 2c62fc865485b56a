"""Fits to positions with what terms displace taken off, as they are made again and again until nothing changes."""

import contextlib
import warnings
from dataclasses import replace

import numpy as np
from astropy import units as u

from ...exceptions import LegdistortError
from ...matching.matches import DISPLACED

#: Fits at most, and the largest change of a number, or of displacements, in errors, at which they end.
FITS, SMALL = 10, 0.02


def unclipped(estimate, matches, options, *how):
    """The estimate with all observations, for a beginning: what a term displaces far seems to deviate. None if none."""
    with warnings.catch_warnings(action="ignore"), contextlib.suppress(LegdistortError):
        return estimate(matches, replace(options, clip=None, errors="stated"), *how)


def displaced(fit, displacements):
    """The matches of a fit with displacements (2, n), in the order of its problem, taken off their positions."""
    table = fit.matches.table.copy(copy_data=False)
    for name, values in zip(DISPLACED, fit.problem.in_table_order(displacements), strict=True):
        table[name] = values * u.pix
    return replace(fit.matches, table=table, observations=None)


def taken_off(fit):
    """Displacements (2, n) that are taken off the positions of a fit, in the order of its problem, pixels."""
    table = fit.matches.table
    if DISPLACED[0] not in table.colnames:
        return np.zeros_like(fit.problem.xy)
    return np.stack([table[name].to_value(u.pix)[fit.problem.order] for name in DISPLACED])
