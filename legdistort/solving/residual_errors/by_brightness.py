"""Errors by brightness: one smooth law for all positions, from what the stars themselves scatter by.

For lists without errors, and for those whose errors are the scatter of a few repeats, which is uncertain by half of
itself for three. The law is that of centroids, sky and detector, photons, and a floor:
``sigma^2 = factor_i^2 ((a / flux)^2 + b^2 / flux + floor^2)``, with a factor for every exposure (King 1983).
"""

from dataclasses import replace

import numpy as np
from astropy import units as u

from ...cameras.star_scales import flux_levels
from ...exceptions import InputError
from ...results.diagnostics import ErrorLaw, filled
from .. import clipping, single_fit

#: Fits one after the other: the law of each gives the weights of the next. They settle in two or three.
ROUNDS = 4
#: Observations that are needed for a law.
FEWEST = 20


def estimate_by_brightness(matches, options):
    """The fit whose errors follow a law of brightness that its own residuals determine.

    The squares of the residuals, their share in their own fit allowed for (`clipping.deviations`), are measurements of
    the variance; the law is fitted to them as the mean of a gamma distribution. In the end it is multiplied so that
    chi2 is its degrees of freedom. The errors stated serve as a start.

    Parameters
    ----------
    matches : Matches
        With fluxes or magnitudes.
    options : SolveOptions
        With ``errors="by-brightness"``.

    Returns
    -------
    Fit
    ErrorLaw

    Raises
    ------
    InputError
        Without fluxes, or with too few observations.
    """
    flux = _fluxes(matches)
    options, levels = replace(options, errors="stated"), _levels(matches, flux)
    fit = single_fit.estimate(matches, options)
    for _ in range(ROUNDS):
        law = _law(fit, levels)
        fit = single_fit.estimate(_with_errors(matches, law, flux), options)
    if fit.dof > 0 and fit.chi2 > 0:
        law = law.scaled(np.sqrt(fit.chi2 / fit.dof))
        fit = single_fit.estimate(_with_errors(matches, law, flux), options)
    return fit, law


def _fluxes(matches):
    """Fluxes of all observations, NaN for what has none."""
    table = matches.table
    flux = np.full(len(table), np.nan)
    if "flux" in table.colnames:
        flux = np.asarray(table["flux"], dtype=float)
    known = np.isfinite(flux) & (flux > 0)
    if np.count_nonzero(known) < FEWEST:
        raise InputError(
            f"errors='by-brightness' needs the brightness of the stars, and {np.count_nonzero(known)} of {len(table)} "
            f"positions have a positive flux: give a column flux or mag, by its name in the list if it has another "
            f"(--columns flux=..., --columns mag=...), for at least {FEWEST}"
        )
    return np.where(known, flux, np.nan)


def _levels(matches, flux):
    """The `flux_levels` of matches with fluxes (n,), ``{exposure: factor}``."""
    obs, detector = matches.observations, None
    if matches.camera.has_focal_plane:
        detector = np.unique(matches.camera.ids(matches.table), return_inverse=True)[1]
    levels = flux_levels(obs.exposure, obs.star, flux, len(obs.names), detector)
    return dict(zip(obs.names, levels.tolist(), strict=True))


def _with_errors(matches, law, flux):
    """The matches with the errors of a law, at fluxes (n,)."""
    table, names = matches.table.copy(), matches.table["exposure"]
    level = law.at_level(np.ones(len(table)), names)
    for name in ("x_err", "y_err"):
        table[name] = law.sigma(filled(flux, level), names) * u.pix
    return replace(matches, table=table)


def _law(fit, levels):
    """The `ErrorLaw` of the residuals of a fit."""
    problem, obs = fit.problem, fit.matches.observations
    pull = problem.in_table_order(clipping.deviations(problem, fit.result.state, fit.used * fit.result.robust))
    used = problem.in_table_order(fit.used)
    measured = (pull**2 / 2 * obs.covariance[:, :2].mean(axis=1))[used]
    levels = np.array([levels[name] for name in problem.names])
    law, *found = ErrorLaw.likelier(_fluxes(fit.matches)[used], measured, obs.exposure[used], levels)
    factors, by_exposure = (dict(zip(problem.names, each.tolist(), strict=True)) for each in found)
    return replace(law, factors=factors, levels={} if np.all(found[1] == 1) else by_exposure)
