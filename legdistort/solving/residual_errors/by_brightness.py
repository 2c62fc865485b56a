"""Errors by brightness: one smooth law for all positions, from what the stars themselves scatter by.

For lists without errors, and for those whose errors are the scatter of a few repeats, which is uncertain by half of
itself for three. The law is that of centroids, sky and detector, photons, and a floor:
``sigma^2 = factor_i^2 ((a / flux)^2 + b^2 / flux + floor^2)``, with a factor for every exposure (King 1983).
"""

from dataclasses import replace

import numpy as np
from astropy import units as u

from ...exceptions import InputError
from ...results.diagnostics import ErrorLaw
from .. import clipping, single_fit

#: Fits one after the other: the law of each gives the weights of the next. They settle in two or three.
ROUNDS = 4
#: An exposure counts as if so many of its stars scattered as those of the others: its factor is known as well as 10 %.
COMMON_STARS = 20
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
    options = replace(options, errors="stated")
    fit, law = single_fit.estimate(matches, options), None
    for _ in range(ROUNDS):
        law = _law(fit, law)
        fit = single_fit.estimate(_with_errors(matches, law.sigma(flux, matches.table["exposure"])), options)
    if fit.dof > 0 and fit.chi2 > 0:
        law = law.scaled(np.sqrt(fit.chi2 / fit.dof))
        fit = single_fit.estimate(_with_errors(matches, law.sigma(flux, matches.table["exposure"])), options)
    return fit, law


def _fluxes(matches):
    """Fluxes of all observations; what has none gets that of the faintest."""
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
    return np.where(known, flux, flux[known].min())


def _with_errors(matches, sigma):
    table = matches.table.copy()
    for name in ("x_err", "y_err"):
        table[name] = sigma * u.pix
    return replace(matches, table=table)


def _law(fit, before):
    """The `ErrorLaw` of the residuals of a fit; `before` is that of its weights, if there is one."""
    problem, obs = fit.problem, fit.matches.observations
    names = problem.names
    pull = problem.in_table_order(clipping.deviations(problem, fit.result.state, fit.used * fit.result.robust))
    used = problem.in_table_order(fit.used)
    measured = (pull**2 / 2 * obs.covariance[:, :2].mean(axis=1))[used]
    flux, exposure = _fluxes(fit.matches)[used], obs.exposure[used]
    factor = np.array([before.factors.get(name, 1.0) if before else 1.0 for name in names])
    count = np.bincount(exposure, minlength=len(names))
    for _ in range(2):
        law = ErrorLaw.of(flux, measured / factor[exposure] ** 2)
        ratio = np.bincount(exposure, measured / law.sigma(flux) ** 2, len(names))
        factor = np.sqrt((ratio + COMMON_STARS) / (count + COMMON_STARS))
    return replace(law, factors=dict(zip(names, factor.tolist(), strict=True)))
