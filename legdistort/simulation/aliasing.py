"""An assumed spectrum of distortions, and how the modes that are not fitted fold into the answer.

Modes beyond the fitted degree are *aliased* (Bernard et al. 2017, section 4.3): the fit takes part of them for modes
that it has, the rest stays in the corrected positions. To first order all this is linear in their amplitudes, so what
it costs follows from the normal equations alone, exactly as the noise does.
"""

from dataclasses import dataclass, replace
from numbers import Real

import numpy as np

from ..exceptions import InputError
from ..geometry import basis
from ..results.errors.coefficient_covariance import times
from ..solving.equations import criterion, elimination
from ..solving.equations.covariances import Uncertainty
from ..solving.equations.problem import State


def spectrum_of(given, degree, name="spectrum"):
    """Standard deviations of coefficients per axis and mode, up to the fitted degree at least.

    Parameters
    ----------
    given : number, dict, array_like or None
        One for all modes up to `degree`; ``{degree: value}``, one for all modes of a degree, degrees not named 0;
        or per mode, (n_modes,) or (2, n_modes), of any degree. Pixels; NaN where it is not known.
    degree : int
        That is fitted. A dict that names no degree up to it leaves the modes that are fitted unknown.
    name : str
        How messages call it.

    Returns
    -------
    ndarray, shape (2, n_modes)
        NaN where nothing is known; the constant mode, which is pointing, is 0.

    Raises
    ------
    InputError
        For a wrong shape, degree or value.
    """
    n_fit = basis.n_modes(degree)
    if given is None or isinstance(given, Real):
        out = np.full((2, n_fit), np.nan if given is None else float(given))
    elif isinstance(given, dict):
        degrees = [basis.check_degree(key, f"a degree in {name}") for key in given]
        out = np.zeros((2, basis.n_modes(max([degree, *degrees]))))
        if not any(d <= degree for d in degrees):
            out[:, :n_fit] = np.nan
        for d, value in zip(degrees, given.values(), strict=True):
            out[:, d * (d + 1) // 2 : basis.n_modes(d)] = value
    else:
        values = np.asarray(given, dtype=float)
        if values.ndim not in (1, 2) or values.shape[:-1] not in ((), (2,)):
            raise InputError(f"{name} must be a dict {{degree: pixels}}, (n_modes,) or (2, n_modes), got {given!r}")
        top = max(degree, basis.degree_of(values.shape[-1]))
        out = basis.change_degree(np.broadcast_to(values, (2, values.shape[-1])), top)
        if values.shape[-1] > 1 and np.isnan(values[..., 1:]).all():  # nothing is known of modes that are fitted
            out[:, values.shape[-1] : n_fit] = np.nan
    if np.any(out < 0) or np.any(np.isinf(out)):
        raise InputError(f"{name} holds standard deviations in pixels, finite and not negative, got {given!r}")
    out[:, 0] = 0
    return out


def assumed_spectra(plan):
    """Spectra (2, n_modes) of the independent and the common distortions of a `Plan`, NaN where unknown."""
    degree = plan.degree
    n_fit = basis.n_modes(degree)
    independent = spectrum_of(plan.spectrum, degree)
    stated = np.isfinite(independent[:, 1:n_fit]).any()
    if plan.dynamic is not None:
        fitted = spectrum_of(plan.dynamic, degree, "dynamic")
        if stated or fitted.shape[1] != n_fit:
            raise InputError(
                f"dynamic states the scatter of the {n_fit} modes that are fitted and spectrum, beside it, that of "
                f"degree {degree + 1} and more: leave one out, or cut it there"
            )
        independent, stated = np.concatenate([fitted, independent[:, n_fit:]], axis=1), True
    if stated and plan.prior is not None and plan.prior.sigma is not None:
        raise InputError(
            "the widths of the prior state the scatter of the modes that are fitted: leave dynamic out, and let "
            f"spectrum begin at degree {degree + 1}"
        )
    common = spectrum_of(0.0 if plan.static_spectrum is None else plan.static_spectrum, degree, "static_spectrum")
    if plan.terms:
        if any(np.nan_to_num(each[:, n_fit:]).any() for each in (independent, common)):
            raise InputError(
                "beside terms nothing is foreseen of degrees beyond the fitted one: cut the spectrum at degree "
                f"{degree}, or leave terms out; turbulence states what is beyond the fit"
            )
        independent, common = independent[:, :n_fit], common[:, :n_fit]
    return independent, common


@dataclass(frozen=True, eq=False)
class Aliasing:
    """Errors that modes beyond the fitted degree make, expected over their random amplitudes.

    Attributes
    ----------
    covariance : ndarray, shape (n_exposures * 2 n_modes,) squared
        Of (unmodelled minus estimated) coefficients of all degrees, px^2, x modes first: what is left in the
        corrected positions.
    stars : ndarray, shape (2, n_stars)
        Variance of the reference positions under the convention of the gauge, x and y, px^2.
    folded : ndarray, shape (2, n_fitted)
        Rms error of the fitted coefficients, over the exposures, pixels: where the energy goes.
    """

    covariance: np.ndarray
    stars: np.ndarray
    folded: np.ndarray


def alias(problem, state, gauge, covariance, *, independent, common):
    """How distortions beyond the fitted degree propagate.

    With S the normal equations of a fit of *all* degrees, stars eliminated, amplitudes c of the modes left out pull
    the fitted coefficients by ``C S_c c``, C their covariance in the gauge and S_c the block that couples the two;
    what remains of all modes is carried on to stars and corrected positions.

    Parameters
    ----------
    problem : Problem
        Of the fit.
    state : State
    gauge : Gauge
    covariance : ndarray
        Of the fitted coefficients.
    independent, common : ndarray, shape (2, n_modes)
        Standard deviation of the amplitudes, pixels, of which those beyond the fitted degree count: drawn anew for
        every exposure, and shared by all (an unknown static distortion).

    Returns
    -------
    Aliasing
    """
    n_fit, n_exposures = problem.n_modes, problem.n_exposures
    degree = basis.degree_of(max(independent.shape[1], common.shape[1]))
    mean = basis.change_degree(problem.prior_mean, max(degree, basis.degree_of(problem.prior_mean.shape[2])))
    full = replace(problem, degree=degree, prior_mean=mean, prior_sigma=None, static_covariance=None)
    blocks = criterion.linearise(full, State(state.stars, mean, state.poses))
    normal = elimination.reduced_matrix(full, blocks)
    fitted = np.tile(np.arange(full.n_modes) < n_fit, 2 * n_exposures)
    left = np.zeros((len(normal), np.count_nonzero(~fitted)))  # of all modes, for unit amplitudes of those left out
    left[fitted] = -times(covariance, normal[np.ix_(fitted, ~fitted)])
    left[~fitted] = np.eye(left.shape[1])
    independent, common = (basis.change_degree(a, degree)[:, n_fit:].ravel() for a in (independent, common))
    together = left.reshape(len(left), n_exposures, -1).sum(axis=1)
    factor = np.hstack([left * np.tile(independent, n_exposures), together * common])
    spread = Uncertainty(full, blocks, gauge, coefficients=factor @ factor.T)
    noise = Uncertainty(full, blocks, gauge, coefficients=np.zeros_like(blocks.u))
    all_errors, own = (each.stars[:2] for each in (spread, noise))
    folded = np.einsum("kc,kc->k", factor, factor)[fitted].reshape(n_exposures, 2, n_fit)
    return Aliasing(spread.coefficients, all_errors - own, np.sqrt(folded.mean(axis=0)))
