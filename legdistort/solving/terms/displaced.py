"""Fits to positions with what terms displace taken off, as they are made again and again until nothing changes."""

import contextlib
import warnings
from dataclasses import dataclass, field, replace

import numpy as np
from astropy import units as u

from ...exceptions import LegdistortError
from ...matching.matches import DISPLACED
from ..equations.problem import by_exposure
from .observed import undistorted

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


def known_tables(prior, matches):
    """``{exposure: DisplacementTable}`` of what a prior, or dict of priors, has beside its series."""
    each = zip(matches.names, by_exposure(matches, prior), strict=True)
    return {name: known.table for name, known in each if known is not None and known.table is not None}


def by_tables(tables, fit):
    """What tables by exposure displace the observations of a fit by, at undistorted places, (2, n) pixels."""
    problem, out = fit.problem, np.zeros_like(fit.problem.xy)
    q = undistorted(problem, fit.result.state) if tables else None
    for i, name in enumerate(problem.names):
        if name in tables:
            part = problem.part(i)
            out[:, part] = tables[name](q[part]).T
    return out


def in_errors(fit, displacements):
    """The largest of displacements (2, n) of a fit, in errors."""
    (wx, wy, wxy), (x, y) = fit.problem.weight, displacements
    return float(np.sqrt(np.max(wx * x**2 + 2 * wxy * x * y + wy * y**2, initial=0.0)))


@dataclass(frozen=True, eq=False)
class Tabled:
    """What terms found, or a prior knows, that is a part of distortions beside its series.

    Attributes
    ----------
    beside : ndarray, shape (2, n)
        What all other terms displace the observations by, in the order of the table, pixels.
    static, own : dict
        ``{detector: DisplacementTable}`` and ``{exposure: DisplacementTable}``.
    errors : dict
        ``{exposure: CovarianceTable}`` of what is measured, distortion and table together.
    """

    beside: np.ndarray
    static: dict = field(default_factory=dict)
    own: dict = field(default_factory=dict)
    errors: dict = field(default_factory=dict)

    def into(self, solution, scale):
        """A solution with it in its distortions, no more in what terms displace measured positions by."""
        table = solution.residuals.copy(copy_data=False)
        for name, values in zip(DISPLACED, self.beside, strict=True):
            table[name] = values * u.pix
        errors = {name: each.scaled(scale) for name, each in self.errors.items()}
        tables = {"static_tables": self.static, "displacement_tables": self.own, "table_errors": errors}
        return replace(solution, residuals=table, estimate=replace(solution.estimate, **tables))
