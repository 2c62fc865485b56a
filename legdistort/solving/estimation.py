"""`solve`: from matched positions to a `Solution`."""

import logging
import warnings

import numpy as np
from astropy import units as u
from astropy.table import QTable

from ..exceptions import AssumptionWarning, InputError, LegdistortWarning, warn
from ..inputs.matches import Matches
from ..results.solution import Solution
from ..runtime import provenance
from . import model_forms, reference_tie, single_fit
from .choices import held_out_stars, prior_widths
from .equations import effective_modes
from .equations.covariances import Uncertainty
from .options import check_options, check_reference, own_degree

log = logging.getLogger(__name__)


def solve(
    matches,
    *,
    degree=3,
    prior=None,
    model=None,
    static=None,
    exposure_degree=None,
    gauge="minimal",
    method="joint",
    loss="linear",
    clip=None,
    error_floor=0.0,
    errors="stated",
    max_iterations=None,
    validate=None,
    reference=None,
    epoch=None,
    pixel_scale=None,
):
    """Estimate all star positions and all distortions at once.

    Minimises ``J = sum_ij |x_ij - D_i(X_j)|^2 / sigma_ij^2`` (Bernard et al. 2017, section 3.1) over the reference
    positions X_j and the Legendre coefficients A_i of every exposure, around the prior static distortion.

    Parameters
    ----------
    matches : Matches
    degree : int or "auto"
        Total degree of the Legendre series, 0 to 30; or the one up to 6 whose distortions serve stars best that are
        left out of the fit (`legdistort.solving.choices.held_out_stars`).
    prior : Prior or dict, optional
        Static distortion; one, or by ``detector`` or exposure name. None starts from no distortion.
    model : `~astropy.modeling.Model`, optional
        Form of the distortion of every exposure, undistorted -> detector pixels, instead of `degree` and `prior`:
        ``Identity(2) + (Mapping((0, 1, 0, 1)) | Legendre2D & Legendre2D)``, with a static part added if there is one.
        Its Legendre coefficients are fitted, those marked as ``fixed`` keep their values; the values of all are the
        static distortion from which exposures depart. `Solution.model` then gives it back fitted. A similarity in
        front is replaced by the pose of each exposure. Poses also carry shift, rotation and scale: their part of the
        coefficients c0_0, c1_0 and c0_1 stays as given.
    static : {None, "fit"}
        "fit": one static distortion for all exposures of a detector (column ``detector``, else all of one shape), and
        for each exposure its pose and the modes up to `exposure_degree` alone: the self-calibration of a camera from
        its own dithers and rolls (Anderson & King 2003). A prior is where it starts, and with ``static_sigma``
        what holds it.
    exposure_degree : int, optional
        With ``static="fit"``: 0 leaves an exposure shift, rotation and scale, 1 (default) an affine map, and so on.
    gauge : {"minimal", "mean"}
        Convention for what the data cannot tell, see `legdistort.results.gauge`.
    method : {"joint", "alternating"}
        Gauss-Newton on all unknowns, or the scheme of the paper.
    loss : {"linear", "huber", "cauchy"}
        Robust losses give deviant observations less weight. Against many gross mismatches "huber" is too mild: use
        `clip`, or "cauchy".
    clip : float, optional
        Leave out observations whose residual exceeds this many standard errors (at the observed scale, if
        that is larger than the stated errors); they are listed in ``residuals["used"]``.
    error_floor : float
        Pixels, added in quadrature to every stated error.
    errors : {"stated", "scale", "floor"}
        Take the stated errors as they are; or scale the reported errors by sqrt(chi2/dof); or find the error floor
        that makes chi2 its degrees of freedom (zero if it is smaller already). What was found is in ``settings``.
    max_iterations : int, optional
    validate : float, optional
        Keep this fraction of the stars, 0 to 0.5, out of everything, and report their scatter beside the one to be
        expected: ``settings["validation"]``. They are not in the tables of the solution.
    reference : `~astropy.table.Table` or path, optional
        Positions with errors that tie shift, rotation and scale, and the maps that the exposures do not tell; relative
        positions stay as precise as they are. Columns ``ra``, ``dec`` [deg, ICRS], ``ra_error``, ``dec_error`` [mas]
        and perhaps ``pmra``, ``pmdec``, ``pmra_error``, ``pmdec_error`` [mas/yr], ``ref_epoch`` [yr] and correlations,
        as in the Gaia catalogue; or ``x``, ``y``, ``x_err``, ``y_err`` in pixels of the reference plane; and perhaps
        ``star``, the stars of the matches, which are otherwise found by their positions.
    epoch : float or `~astropy.time.Time`, optional
        Of the exposures (a decimal year), to which proper motions carry the reference; by default from their headers.
    pixel_scale : float, optional
        Arcsec, about; helps to find the stars where no header tells the sky.

    Returns
    -------
    Solution

    Raises
    ------
    InputError
        For bad options.
    SolveError
        If an exposure has fewer stars than modes, or the unknowns are not determined.
    """
    check_options(
        degree=degree, gauge=gauge, method=method, loss=loss, clip=clip, error_floor=error_floor, errors=errors,
        max_iterations=max_iterations, validate=validate, static=static, exposure_degree=exposure_degree,
    )  # fmt: skip
    if model is not None and (degree == held_out_stars.AUTO or static is not None):
        raise InputError("a model says what is fitted in every exposure: leave degree='auto' and static out")
    catalogue, epoch = check_reference(reference, epoch=epoch, pixel_scale=pixel_scale, method=method)
    if not isinstance(matches, Matches):
        raise InputError(
            f"matches must be Matches (from match(...) or Matches.from_table(...)), got {type(matches).__name__}"
        )
    form = None if model is None else model_forms.read(model, matches, degree=degree, prior=prior, gauge=gauge)
    degree = degree if form is None else form.degree
    options = {
        "degree": degree,
        "prior": prior if form is None else form.prior(),
        "own_degree": None if degree == held_out_stars.AUTO else own_degree(static, exposure_degree, degree, method),
        "gauge": gauge,
        "method": method,
        "loss": loss,
        "clip": clip,
        "limit": {} if max_iterations is None else {"max_iterations": max_iterations},
        "scale": errors == "scale",
    }
    matches, kept_out = (matches, None) if validate is None else held_out_stars.hold_out(matches, validate)
    with single_fit.threads(matches):
        chosen = _choose(matches, error_floor, options) if degree == held_out_stars.AUTO else None
        fit = single_fit.estimate(matches, error_floor, options)
        if errors == "floor":
            fit = single_fit.estimate_with_floor(matches, fit, options)
    log.info("%s; chi2 %.1f for %d degrees of freedom", fit.result.status, fit.chi2, fit.dof)
    scale = np.sqrt(fit.chi2 / fit.dof) if errors == "scale" and fit.dof > 0 else 1.0
    settings = {
        "degree": int(options["degree"]),
        "selection": chosen,
        "gauge": gauge,
        "method": method,
        "loss": loss,
        "clip": None if clip is None else float(clip),
        "errors": errors,
        "error_floor": float(fit.error_floor),
        "error_scale": float(scale),
        "prior": _describe(prior),
        "model": None if form is None else form.describe(),
        "widths": prior_widths.describe(prior, fit.widths, scale),
        "effective_modes": dict(zip(fit.problem.names, fit.effective_modes.round(3).tolist(), strict=True)),
        "departure_ratio": effective_modes.departure_ratio(fit.problem, fit.result.gauge, fit.blocks, fit.uncertainty),
        "static": static,
        "exposure_degree": options["own_degree"],
    }
    _warn_of_untold(fit)
    if catalogue is not None:
        with single_fit.threads(matches):
            fit = reference_tie.tie_to(fit, catalogue, options, scale=scale, epoch=epoch, pixel_scale=pixel_scale)
    settings |= reference_tie.describe(fit, catalogue, matches.sky)
    solution = _solution(fit, scale, settings, form)
    if kept_out is not None:
        settings["validation"] = held_out_stars.validation(solution, kept_out, validate)
    return solution


def _choose(matches, error_floor, options):
    """Put the degree that serves best into the options, and return how it was found."""

    def fit(part, degree):
        trial = single_fit.estimate(part, error_floor, options | {"degree": degree, "trial": True})
        return _solution(trial, 1.0, {"error_floor": error_floor}, None)

    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", LegdistortWarning)  # of fits that are thrown away
        chosen = held_out_stars.choose_degree(matches, fit)
    options["degree"] = chosen["degree"]
    if chosen["alarm"]:
        warn(f"degree {chosen['sentence']}", AssumptionWarning)
    return chosen


def _warn_of_untold(fit):
    """Say how much of a shared distortion these exposures cannot tell."""
    if fit.problem.unknowns.shared and (n_weak := fit.result.n_weak):
        warn(
            f"static='fit': {n_weak} of {fit.problem.unknowns.n_common} unknowns of the shared distortion are not told "
            "by these exposures and stay where the prior has them; dithers with rolls tell more",
            AssumptionWarning,
        )


def _describe(prior):
    """A prior as plain numbers and strings, by detector or exposure if it was given so; None if there is none.

    Its mean is in the solution already, by exposure.
    """
    if prior is None or not isinstance(prior, dict):
        return None if prior is None else prior.describe()
    return {str(name): None if each is None else each.describe() for name, each in prior.items()}


def _solution(fit, scale, settings, form):
    """Bring the solver's arrays back into the order and the words of the user."""
    matches, problem, result = fit.matches, fit.problem, fit.result
    table = QTable(matches.table, copy=False)
    back = np.empty_like(fit.blocks.residual)
    back[:, problem.order] = fit.blocks.residual
    table["dx"], table["dy"] = back * u.pix
    table["used"] = np.zeros(len(table), dtype=bool)
    table["used"][problem.order] = fit.used
    positions = result.state.positions.T.copy()
    positions[fit.blocks.v[0] <= 0] = np.nan
    return Solution(
        names=problem.names,
        degree=problem.degree,
        shapes=dict(matches.shapes),
        poses=dict(zip(problem.names, result.state.poses, strict=True)),
        coefficients=result.state.coefficients if form is None else form.hold(problem.names, result.state.coefficients),
        prior_mean=problem.prior_mean,
        star_names=np.asarray(matches.stars),
        positions=positions,
        observations=table,
        chi2=fit.chi2,
        dof=fit.dof,
        status=result.status,
        gauge=result.gauge,
        uncertainty=fit.uncertainty if scale == 1 else Uncertainty(fit.weighted, fit.blocks, result.gauge, scale=scale),
        sky=matches.sky,
        left_out=dict(matches.left_out),
        settings=settings,
        form=form,
        provenance=provenance.stamp(),
    )
