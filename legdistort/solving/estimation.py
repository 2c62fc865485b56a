"""`solve`: from matched positions to a `Solution`."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import fields, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from ..cameras import ties
from ..cameras.exchanged import check_places
from ..cameras.stated_errors import undetermined_degree, with_errors_times
from ..exceptions import AssumptionWarning, InputError, LegdistortWarning, SolveError, warn
from ..geometry import basis
from ..matching.header_poses import header_map_by, pointing_by_layout, sky_by_layout
from ..matching.matches import Matches
from ..priors.prior import Prior, has_distortion
from ..results.diagnostics import Diagnostics
from ..results.errors.common_distortion import with_common_map
from ..results.errors.pose_errors import mean_pose_errors, pose_variances
from ..results.gauge import warning_of
from ..results.in_tables import goodness
from ..results.settings import Settings
from ..runtime.guards.units import plain_numbers
from ..runtime.words import UNSTATED
from . import agreement, minimisers, model_forms, reference_tie, single_fit, star_motions
from .assembly import assemble
from .camera_fit import CameraFit, Sought, common_widths, held, with_declared_size
from .choices import prior_widths
from .choices.degree_choice import choose_degree
from .choices.held_out import hold_out, validation
from .equations import effective_modes
from .gauge import known_poses
from .knowledge.base_solution import with_base
from .knowledge.static_departure import static_departures
from .motion_choice import resolve as resolve_motion
from .options import CLIP, DEGREE, SolveOptions, Unasked, check_detectors, check_tie, prior_as_asked, with_stated
from .residual_errors.by_brightness import estimate_by_brightness
from .residual_errors.correlated import estimate_with_correlations
from .single_detectors import by_detector, headers_of_parts
from .terms.fitting import fit_with
from .terms.term import of_motion, terms_of

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord
    from astropy.modeling import Model
    from astropy.table import Table
    from astropy.time import Time
    from astropy.units import Quantity

    from ..results.solution import Solution
    from ..runtime.annotations import StrPath
    from .terms.term import Term

log = logging.getLogger(__name__)


@plain_numbers
@with_base
@agreement.undetermined_left_out  # by a reference too
def solve(
    matches: Matches,
    *,
    base: Solution | StrPath | None = None,
    degree: int | str = DEGREE,
    prior: Prior | Mapping[str, Prior] | None = None,
    model: Model | None = None,
    static: str | None = None,
    layout: str | None = None,
    layout_sigma: Mapping[str, float | Quantity] | None = None,
    dynamic: str | None = None,
    exposure_degree: int | None = None,
    gauge: str = "minimal",
    method: str = "joint",
    loss: str = "linear",
    clip: float | None = CLIP,
    error_floor: float = 0.0,
    errors: str = "stated",
    max_iterations: int | None = None,
    validate: float | None = None,
    motion: str | None = None,
    motion_sigma: float | str | None = None,
    motion_epoch: float | Time | None = None,
    night_sigma: float | None = None,
    pose_sigma: Mapping[str, float | Quantity] | None = None,
    reference: Table | SkyCoord | Solution | StrPath | None = None,
    reference_error: float | Quantity | str | None = None,
    reference_degree: int | None = None,
    epoch: float | Time | None = None,
    pixel_scale: float | None = None,
    terms: str | Term | Iterable[str | Term] = (),
    progress: bool = False,
) -> Solution:
    """Estimate all star positions and all distortions at once.

    Minimises ``J = sum_ij |x_ij - D_i(X_j)|^2 / sigma_ij^2`` (Bernard et al. 2017, section 3.1) over the reference
    positions X_j and the Legendre coefficients A_i of every exposure, around the prior static distortion.

    Parameters
    ----------
    matches : Matches
    base : Solution or path, optional
        A finished solution, its file or folder, that the exposures of `matches` come into: of one of its fields or of
        its camera, a single one too. Their stars are found among its own, whose names and plane stay; of stars that it
        does not have those join that two of the exposures see. All are solved together, so that the old ones move as
        far as the new ones tell. The options of the base hold but for those that are given; a `prior`, `model` or
        `reference` that it had is to be given again. What came in when is in ``provenance["added"]``.
    degree : int or "auto"
        Total degree of the Legendre series, 0 to 30; or the one up to 6 whose distortions serve stars best that are
        left out of the fit (`legdistort.solving.choices.degree_choice`). 3 if neither it nor a `model` is given.
    prior : Prior or dict, optional
        Static distortion; one, or by ``detector`` or exposure name. None: nothing is known of it. The null space of the
        problem may then leave absolute positions undetermined (``gauge.unknown``), which is logged as a warning. With a
        camera of several detectors it is of the focal plane, but ``Prior(None, static_sigma=...)`` is the size, or the
        uncertainty, of the static distortion of every detector, which is then fitted with it.
    model : `~astropy.modeling.Model`, optional
        Form of the distortion of every exposure, undistorted -> detector pixels, instead of `degree` and `prior`:
        ``Identity(2) + (Mapping((0, 1, 0, 1)) | Legendre2D & Legendre2D)``, with a static part added if there is one.
        Its Legendre coefficients are fitted, those marked as ``fixed`` keep their values; the values of all are the
        static distortion from which exposures depart. `View.model` then gives it back fitted. A similarity in
        front is replaced by the pose of each exposure. Poses also carry shift, rotation and scale: their part of the
        coefficients c0_0, c1_0 and c0_1 stays as given.
    static : {None, "hold", "prior", "fit"}
        What is done about the static distortion of a detector. "hold": what is known of it (the prior; with a camera
        that of its detectors) is exact; "prior": it has the uncertainties that are stated (``static_sigma``); "fit":
        one for all exposures is found. None: "prior" where uncertainties are stated, else "hold"; where nothing is
        known of it, it is what the exposures have in common.
        With a camera "fit" is up to `degree`, from nothing, and exposures keep a distortion of the focal plane. Of
        single detectors (column ``detector``, else all of one shape) each exposure then has its pose and the modes up
        to `exposure_degree` alone: the self-calibration of a camera from its own dithers and rolls (Anderson & King
        2003); a prior is its start value and, with ``static_sigma``, constrains it.
    layout : {None, "hold", "prior", "fit"}
        The same for the layout of the detectors of a camera: as exact, with the uncertainties that are stated of it
        (the default where any are), or without any. That of headers has infinite ones, so that it is fitted by default.
        The result is in ``solution.camera``, with its errors.
    layout_sigma : dict, optional
        How well that layout is known, in place of what the camera states: standard errors of the ``shift`` [px, both
        axes] and the ``rotation`` [deg] of every detector, and of its ``scale`` and shear (relative; by default as
        large as those of the rotation); infinite for what is left out. Detectors that no star ties have finite errors
        then.
    dynamic : {None, "focal_plane", "detector"}
        With a camera: what an exposure adds is a distortion of the focal plane as a whole (None does the same), or one
        for every detector by itself, which then is an exposure of its own, ``NAME-DETECTOR``, with a pose of its own;
        the result is a solution without a camera, and `layout` has no meaning.
    exposure_degree : int, optional
        With ``static="fit"``: 0 leaves an exposure shift, rotation and scale, 1 (default) an affine map, and so on.
    gauge : {"minimal"}
        Convention (datum) for what the data do not determine (their null space), see `legdistort.results.gauge`. That
        of the paper, and its scheme of minimisation, are in `legdistort.paper`.
    method : {"joint"}
        Gauss-Newton on all unknowns.
    loss : {"linear", "huber", "cauchy"}
        Robust losses give deviant observations less weight. Against many gross mismatches "huber" is too mild: use
        `clip`, or "cauchy".
    clip : float or None
        Leave out observations whose residual exceeds this many standard errors (at the observed scale, if
        that is larger than the stated errors), where chance does not explain what a plain fit leaves; they are listed
        in ``residuals["used"]``. Stars and exposures that contradict the others are left out as a whole, with a
        warning. None keeps all.
    error_floor : float
        Pixels, added in quadrature to every stated error.
    errors : {"stated", "scale", "floor", "by-brightness", "correlated"}
        Take the stated errors as they are; or scale the reported errors by sqrt(chi2/dof); or find the error floor
        that makes chi2 its degrees of freedom (zero if it is smaller already); or let a smooth law of brightness, found
        from the residuals, take the place of the stated ones (`legdistort.solving.residual_errors.by_brightness`; needs
        fluxes); or find the floor, and the errors that a star has in common in neighbouring exposures and that do not
        average down (`legdistort.solving.residual_errors.correlated`; 8 exposures and 50 stars at least).
        What was found is in ``diagnostics``.
    max_iterations : int, optional
    validate : float, optional
        Keep this fraction of the stars, 0 to 0.5, out of the fit, and report their scatter beside the one to be
        expected: ``diagnostics.validation``. They are not in the tables of the solution.
    motion : {None, "proper", "parallax", "acceleration", "auto"}
        Fit a proper motion of every star beside its position, a parallax too, or decide by the evidence of the set
        whether stars move. "acceleration" is "proper" with the term of that name beside those of `terms`. The times of
        the exposures are those of their headers or of the column ``epoch``.
    motion_sigma : float or "evidence", optional
        Scatter of the proper motions of stars around their mean, per axis, pixels a year: known, or found from the set.
        None: nothing is known of them.
    motion_epoch : float or `~astropy.time.Time`, optional
        Of the positions in ``stars``; by default the mean of the observations, where they are most precise.
    night_sigma : float, optional
        What the exposures of a night (`Matches.blocks`) have in common beside the static distortion: standard deviation
        of every normalised coefficient, pixels. None: found from the nights, where there are several; 0: nothing.
    pose_sigma : dict, optional
        Errors of the poses of the matches, if these are known and no mere start values, as `Matches.from_table` takes
        them, in place of what the matches state. Absolute errors then include shift, rotation and scale. Not for poses
        that `match` found from the positions themselves.
    reference : `~astropy.table.Table`, `~astropy.coordinates.SkyCoord`, Solution, path or "gaia", optional
        Positions with errors: what is known beforehand of its stars, and so of shift, rotation and scale, and of maps
        that the exposures do not determine. Columns ``ra``, ``dec`` [deg, ICRS], ``ra_error``, ``dec_error``
        [mas] and perhaps ``pmra``, ``pmdec``, ``pmra_error``, ``pmdec_error`` [mas/yr], ``parallax``,
        ``parallax_error`` [mas], ``ref_epoch`` [yr] and correlations, as in the Gaia catalogue; or ``x``, ``y``,
        ``x_err``, ``y_err`` in pixels of the reference plane, perhaps with ``vx``, ``vy`` and their errors; and perhaps
        ``star``, the stars of the matches, which are otherwise found by their positions. A column that holds a
        `~astropy.coordinates.SkyCoord` stands for positions, motions and epoch. With `motion` its motions and
        parallaxes are known beforehand too. Errors that prove too small are taken larger, with a warning.
        A `Solution`, its file or folder: the stars of that, found by their positions, and its plane with its errors.
        "gaia": the stars of Gaia DR3 around the field, from the archive or, if they were asked for before, from a file
        (`legdistort.inputs.references.gaia`); needs the extra ``gaia``.
    reference_error : float, `~astropy.units.Quantity` or "found", optional
        Error per axis of its positions where it states none: mas on the sky, else pixels. Found: the size of its errors
        is the one at which its stars agree with the exposures, and stated errors count relative to one another alone.
    reference_degree : int, optional
        Degree of a map that belongs to the catalogue alone, up to 30, as if it had been made with another distortion.
        Nothing is known of it but that shift, rotation and scale over the field are none of it, so that these alone are
        known from the catalogue up to that degree. None: it has no such map.
    epoch : float or `~astropy.time.Time`, optional
        Of the exposures (a decimal year), to which proper motions carry the reference; by default from their headers.
    pixel_scale : float, optional
        Arcsec. Figures are printed in mas too, see `legdistort.results.in_tables.in_mas`; it helps to find the stars of
        a reference, to the nearest 20 per cent, where no header has a WCS on the sky.
    terms : str, Term, or a list of them, optional
        What displaces stars beside the distortion, found with everything else and left away where the positions do not
        show it: "refraction" by the colours of stars, "differential_refraction" over the field, "pixel_phase",
        "rough_static" (the static distortion beyond the degree, as rough as it is), "turbulence" (a random field of
        every exposure), or a `legdistort.Term`. In `Solution.terms`.
    progress : bool
        Show a progress bar of the iterations where they take more than a second.

    Returns
    -------
    Solution

    Raises
    ------
    InputError
        For bad options.
    SolveError
        If half of the exposures or more have fewer stars than modes, the unknowns are not determined, or exposures
        contradict one another and no majority shows which are right.
    MatchError
        For one exposure without a reference.

    See Also
    --------
    legdistort.match : Makes the matches.
    legdistort.Solution : What comes out.
    legdistort.predict : Expected errors before anything is observed.

    Examples
    --------
    >>> import legdistort as ld
    >>> sim = ld.simulate_matches(n_stars=50, n_exposures=8, sigma=0.02, seed=1)
    >>> solution = ld.solve(sim.matches, degree=3)
    >>> bool(abs(solution.residuals["dx"].value).max() < 0.1)
    True
    >>> [check.name for check in solution.checks if check.state == "fail"]
    []
    """
    motion, terms = of_motion(motion, terms)
    matches = with_stated(matches, pose_sigma, layout, layout_sigma)
    whole, (matches, prior, static) = matches, _of_detectors(matches, prior, layout, static, dynamic, degree)
    sought, prior = _of_camera(matches, prior, model, degree, layout, static, exposure_degree)
    asked = SolveOptions(
        degree=degree, prior=prior, model=model, static=static, layout=layout, layout_sigma=layout_sigma,
        dynamic=dynamic, exposure_degree=exposure_degree,
        gauge=gauge, method=method, loss=loss, clip=clip, error_floor=error_floor, errors=errors,
        max_iterations=max_iterations, validate=validate, motion=motion, motion_sigma=motion_sigma,
        motion_epoch=motion_epoch, night_sigma=night_sigma, pose_sigma=matches.pose_sigma,
        pixel_scale=pixel_scale, terms=terms_of(terms, matches.table),
    )  # fmt: skip
    tying = {"error": reference_error, "degree": reference_degree, "epoch": epoch}
    catalogue, epoch = check_tie(matches, asked, reference, **tying)
    if model is None:
        _tell_of_prior(matches, prior, degree)
    is_prior = matches.camera.has_focal_plane or static in ("hold", "prior")  # of the camera, or the prior, by now
    options, form = replace(asked, static=None, layout=None) if is_prior else asked, None
    if model is not None:
        form = model_forms.read(model, matches, degree=None if isinstance(degree, Unasked) else degree)
        options = replace(options, degree=form.degree, model=None, prior=form.prior())
    given, kept_out = (matches, None) if validate is None else hold_out(matches, validate)
    with single_fit.threads(given), minimisers.iterations_shown(progress):
        join, tie = reference_tie.ties_to(catalogue, epoch=epoch, pixel_scale=pixel_scale)
        fit, found, (options, chosen) = fit_with(asked.terms, tie, _fitted, given, options, sought, join)
        _tell(fit, given, tied=tie is not None)
        scale = float(np.sqrt(fit.chi2 / fit.dof)) if errors == "scale" and fit.dof > 0 else 1.0
        diagnostics = _diagnostics(given, fit, prior, scale, pointing=given.pointing, terms=found(scale), **chosen)
        fit = _placed(fit, sought, given, whole) if tie is None else tie(fit, scale=scale)
    epoch = fit.matches.epoch if epoch is None else epoch
    sky = {"sky": _source_of_sky(given, fit, tie), "pointing": fit.matches.pointing}
    found = replace(diagnostics, **sky, reference=reference_tie.used_reference(fit, catalogue), epoch=epoch)
    solution = _with_camera(_solution(fit, scale, _settings(asked, options, form), found, form), given)
    if words := warning_of(solution):
        log.warning("%s", words)
    if kept_out is None:
        return solution
    if sought is not None:
        kept_out = solution.camera.in_focal_plane(matches.camera.on_detectors(kept_out))
    return replace(solution, diagnostics=replace(found, validation=validation(solution, kept_out, validate)))


def _source_of_sky(given, fit, tie):
    """Whether the sky is that of the exposures, which a reference may bear out, or that of the reference; or None."""
    if given.sky is not None and (tie is None or fit.matches.sky is given.sky):
        return "exposures"
    return None if fit.matches.sky is None else "reference"


def _with_camera(solution, given):
    """The solution whose camera has what a reference told of its focal plane, for exposures of another field."""
    camera = with_common_map(solution.camera, solution)
    if camera.has_focal_plane and solution.gauge.n_fields == 1:
        found, *mean = header_map_by(given, solution.poses, solution.sky, pose_variances(solution))
        camera = camera if found is None else camera.with_header_map(found, mean_pose_errors(solution, *mean))
    return replace(solution, camera=camera)


def solution_of(fit, asked, **settings):
    """The `Solution` of a `Fit` to matches that were given, with some `SolveOptions`; words in its `Settings`."""
    diagnostics = replace(_diagnostics(fit.matches, fit, asked.prior, 1.0), epoch=fit.matches.epoch)
    found = replace(diagnostics, sky=None if fit.matches.sky is None else "exposures")
    return _solution(fit, 1.0, replace(_settings(asked, asked, None), **settings), found)


def _of_detectors(matches, prior, layout, static, dynamic, degree):
    """The matches, of single detectors if they are asked for, what is known of these, and what to do about statics."""
    check_detectors(matches.camera.has_focal_plane, layout, static, dynamic)
    matches, prior, static = with_declared_size(matches, prior, static, dynamic=dynamic, degree=degree)
    if dynamic == "detector" and matches.pose_sigma is not None:
        raise InputError(
            "pose_sigma is for whole exposures, and with dynamic='detector' every detector has a pose: leave it out"
        )
    if dynamic != "detector":
        return held(matches, layout, static), prior, static
    if layout is not None:
        raise InputError(
            "with dynamic='detector' every detector of every exposure has a pose of its own: leave layout out"
        )
    if prior is not None:
        raise InputError(
            "with dynamic='detector' (--dynamic detector) every detector of every exposure has a distortion of its "
            "own: leave prior and its sizes out (--prior, --prior-sigma, --static-sigma); what is known of detectors "
            "the camera has (Detector(..., static=))"
        )
    return *by_detector(matches, static), "fit" if static == "fit" else None


def _of_camera(matches, prior, model, degree, layout, static, exposure_degree):
    """What is sought of a camera, if anything, and the prior where positions are those in its focal plane.

    That has no distortion of its own: its detectors have theirs, and what is not known of them.

    Raises
    ------
    InputError
        For what is known of single detectors: the camera has it; for modes of exposures alone.
    """
    camera = matches.camera
    if not camera.has_focal_plane:
        prior = _of_detector(camera, prior, model)
        prior = prior if model is not None else prior_as_asked(prior, static)  # with a model static is refused
        each = prior.values() if isinstance(prior, dict) else [prior]
        if static == "fit" and any(_knows_nothing_of_a_mode(p) for p in each):
            raise InputError("static='fit' needs a finite static_sigma of the prior: make it finite, or leave it out")
        return None, prior
    if isinstance(prior, dict):
        raise InputError(
            "with a camera, give what is known of its detectors to the camera (Detector(..., static=)), not as prior"
        )
    if exposure_degree is not None:
        raise InputError(
            "exposure_degree is for single detectors; with a camera every exposure has a distortion of the focal plane "
            "of the whole degree, which prior=Prior(None, sigma='evidence') (--prior-sigma evidence) keeps as small as "
            "it is: leave exposure_degree out, or take every detector by itself (static='fit' and dynamic='detector')"
        )
    check_places(matches)
    sought = Sought.of(matches, layout, static, 3 if isinstance(degree, str) else degree)
    if prior is not None and prior.table is not None:
        raise InputError(
            "the prior has a table beside its series, which is of one detector, and not of a focal plane: take every "
            "detector by itself (dynamic='detector', --dynamic detector), or give the series alone "
            "(dataclasses.replace(prior, table=None))"
        )
    widths = common_widths(camera, sought)
    of_plane = {"source": f"camera {camera.name}"}
    if camera.common_map is not None:
        mean = basis.change_degree(camera.common_map, basis.degree_of(widths.shape[1]))
        of_plane |= {"mean": mean, "static_sigma": widths}
        if prior is not None and prior.source == UNSTATED:
            return sought, replace(prior, **of_plane)
    if prior is not None or model is not None:
        return sought, prior
    # nothing known of it is not the same as none; of detectors that no star ties their layout is all that holds them
    if static is None and not camera.states_static and len(camera.groups(matches.table)) == 1:
        return sought, None
    if widths is None:
        return None, Prior(np.zeros((2, 1)), **of_plane)
    return sought, Prior(**{"mean": np.zeros_like(widths), "static_sigma": widths} | of_plane)


def _of_detector(camera, prior, model):
    """The prior of plain images: what their one detector states of its static distortion, or else the one given.

    Raises
    ------
    InputError
        If both are there.
    """
    (detector,) = camera.detectors.values()
    if not np.any(detector.static) and detector.static_sigma is None:
        return prior
    if prior is not None or model is not None:
        raise InputError(
            f"camera {camera.name} has a static distortion of its own: leave prior and model out, or take that off"
        )
    known = {"shape": detector.shape, "static_sigma": detector.static_sigma}
    known |= {"static_covariance": detector.static_covariance}
    return Prior(detector.static, source=f"camera {camera.name}", **known)


def _knows_nothing_of_a_mode(prior):
    if prior is None or prior.static_sigma is None or prior.static_covariance is not None:
        return False
    return bool(np.isinf(prior.static_sigma).any())


def _fitted(matches, options, sought, join):
    """The fit, its options, and what was chosen and found for the `Diagnostics`; with the camera that is `sought`.

    Groups of detectors that a star or two tie to each other, wrongly, would slide to where these have them, off where
    the headers do: they are left as they were then, without a tie.
    """
    thin = np.zeros(len(matches.table), dtype=bool)
    if sought is not None and np.isinf(sought.prior[:, :, :3][sought.free[:, :, :3]]).any():
        thin = ties.alone(matches.camera, matches.table)
    if not thin.any():
        return _in_camera(matches, options, sought, join)
    try:
        found = _in_camera(matches, options, sought, join)
        fit = found[0]
        used, camera = fit.matches.table[fit.problem.order][fit.used], fit.matches.camera
        if len(camera.groups(used)) == len(camera.groups(fit.matches.table)):
            return found
        why = "were left out of the fit as deviant"
    except SolveError:
        why = "contradict all others"
    listed = ties.in_words(ties.few(matches.camera, matches.table))
    warn(
        f"how groups of detectors lie to each other rests on {listed}, which {why}: they are left out, and what is not "
        f"determined then stays as the layout of camera {matches.camera.name} has it",
        AssumptionWarning,
    )
    return _in_camera(replace(matches, table=matches.table[~thin]), options, sought, join)


@agreement.undetermined_left_out
def _in_camera(matches, options, sought, join):
    """What `_fitted` gives, all ties of detectors believed."""
    camera, selection = None if sought is None else CameraFit(sought, join), None
    if camera is not None:  # to a layout that is wrong by pixels all observations seem to deviate
        plain, known = partial(single_fit.estimate, options=_plain(options)), matches.pose_sigma
        anywhere = replace(matches, pose_sigma=None)  # what is wrong of the layout would turn the plane
        matches = camera.settle(camera.settle(anywhere, plain, layout_alone=True), plain)
        matches = replace(matches, pose_sigma=known)
    if options.chooses_degree:
        selection = _choose_degree(
            replace(matches, pose_sigma=None), options
        )  # stars agree or not wherever the plane is
        options = replace(options, degree=selection.degree)
    options, scatter = resolve_motion(matches, options)
    if camera is not None:
        matches = camera.settle(matches, lambda part: _estimate(part, options)[0])
    fit, errors_found = _estimate(matches, options)
    fit = fit if camera is None else camera.finished(fit)
    return fit, options, {"selection": selection, "motion_scatter": scatter, **errors_found}


def _placed(fit, sought, matches, whole):
    """The fit with motions relative to the mean of the stars.

    Of a camera that was sought, or whose detectors were taken one by one from `whole` matches, with the sky of the
    headers that have its detectors where they were found.
    """
    fit = replace(fit, result=star_motions.at_rest(fit.problem, fit.result))
    apart = whole.camera.has_focal_plane and not matches.camera.has_focal_plane
    if matches.sky is None or (sought is None and not apart):
        return fit
    headers, poses = fit.matches.camera.headers, fit.result.state.poses
    if apart:
        headers = headers_of_parts(whole, dict(zip(fit.problem.names, poses, strict=True)))
        poses = np.array(list(whole.poses.values()))
    sky = sky_by_layout(whole if apart else matches, headers, poses)
    pointing = pointing_by_layout(fit.matches.pointing, headers)
    return replace(fit, matches=replace(fit.matches, sky=sky, pointing=pointing))


def _plain(options):
    """Options that leave nothing out, choose nothing and let no star move."""
    degree = 3 if options.chooses_degree else options.degree
    known = {"motion": None, "motion_sigma": None, "motion_epoch": None}
    return replace(options, degree=degree, clip=None, loss="linear", errors="stated", **known)


def _estimate(matches, options):
    """The fit with the errors that were asked for, and what was found of them for the `Diagnostics`."""
    if options.errors == "by-brightness":
        fit, law = estimate_by_brightness(matches, options)
        return fit, {"error_law": law}
    if options.errors == "correlated":
        fit, found = estimate_with_correlations(matches, options)
        return fit, {"correlated": found}
    fit = single_fit.estimate(matches, options)
    if options.errors == "floor":
        fit = single_fit.estimate_with_floor(matches, fit, options)
    return fit, {}


def _tell_of_prior(matches, prior, degree):
    """Say what the degree leaves of a prior or camera of a higher one; warn of an unused distortion of headers."""
    each = prior.values() if isinstance(prior, dict) else [prior]
    highest = max((p.degree for p in each if isinstance(p, Prior) and p.states_mean), default=0)
    found = undetermined_degree(matches.camera)
    if not isinstance(degree, str) and found > degree:
        log.warning(
            "exposures are fitted to degree %d%s: camera %s was found with degree %d, and what all exposures share up "
            "to there was not determined, which exposures of that degree alone can take over: degree=%d (--degree %d)",
            degree, ", the default" * isinstance(degree, Unasked), matches.camera.name, found, found, found,
        )  # fmt: skip
    elif isinstance(degree, Unasked) and highest > degree:
        log.info(
            "exposures are fitted to degree %d, the default: what the prior has beyond, up to degree %d, is held as "
            "given; degree=%d (--degree %d) fits that too", degree, highest, highest, highest,
        )  # fmt: skip
    if matches.header_distortion and not has_distortion(prior):
        warn(
            f"the headers have a distortion ({matches.header_distortion}) that is not used; --prior header takes it as "
            "the static distortion (in Python: Prior.from_headers(exposures))",
            AssumptionWarning,
        )


def _choose_degree(matches, options):
    """The `DegreeChoice`, with a warning where it has an alarm."""
    if options.motion is not None:  # motions, if there are any, are taken off the stars that are kept out
        star_motions.check_epochs(matches, options.motion)
        kind = "parallax" if options.motion == "parallax" else "proper"
        options = replace(options, motion=kind, motion_sigma=None)

    def fit(part, degree, clip, near=None):
        asked = replace(options, degree=degree, clip=clip)
        return single_fit.estimate(part, asked, near=near, trial=True)

    def solution(trial):
        settings = Settings(trial.options.degree, method=options.method)
        return _solution(trial, 1.0, settings, Diagnostics(error_floor=options.error_floor))

    found = bool(prior_widths.sought(options.prior))
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", LegdistortWarning)  # of fits that are thrown away
        chosen = choose_degree(matches, fit, solution, clip=options.clip, found=found)
    if chosen.alarm:
        warn(f"degree {chosen.sentence}", AssumptionWarning)
    return chosen


def _tell(fit, matches, *, tied):
    """Log how the fit ended and what it left out, and warn of what these exposures cannot determine.

    A reference to which it will be `tied` adds to the data.
    """
    log.info("%s; %s%s", fit.result.status, "without the reference " * (tied and fit.dof < 1), goodness(fit))
    agreement.warn_of_lost_exposures(fit, matches)
    agreement.warn_of_lost_stars(fit)
    fields = None if fit.tabled is None else fit.tabled.errors
    if why := known_poses.contradiction(fit.problem, fit.result.state, fit.uncertainty, fields):
        warn(why, AssumptionWarning)
    if fit.problem.unknowns.shared and (n_weak := fit.result.n_weak):
        warn(
            f"static='fit': {n_weak} of {fit.problem.unknowns.n_common} unknowns of the shared distortion are not "
            "determined by these exposures and stay where the prior has them; dithers with rolls determine more",
            AssumptionWarning,
        )


def _diagnostics(given, fit, prior, scale, **found):
    """What was found in matches that were given, before a reference is used, beside what is found already."""
    each = prior.values() if isinstance(prior, dict) else [prior]
    return Diagnostics(
        error_floor=float(fit.options.error_floor),
        error_scale=scale,
        widths=None if fit.widths is None else fit.widths.describe(prior, scale),
        prior_has_widths=any(p is not None and p.sigma is not None for p in each),
        effective_modes=dict(zip(fit.problem.names, fit.effective_modes.round(3).tolist(), strict=True)),
        higher_static=_higher(fit.problem),
        static_departure=static_departures(given, fit, scale),
        departure_ratio=effective_modes.departure_ratio(fit.problem, fit.result.gauge, fit.blocks, fit.uncertainty),
        **found,
    )


def _higher(problem):
    """Rms per axis of what was found that exposures have in common beyond the degree, pixels; None for nothing."""
    if problem.centre is None or not (higher := problem.centre[:, :, problem.n_modes :]).any():
        return None
    return float(np.sqrt(np.sum(higher**2) / len(higher) / 8))  # a mode has mean square 1/4


def _settings(asked, options, form):
    """The options in plain numbers and strings.

    The mean of a prior is in the solution already, by exposure.
    """
    made = {field.name: getattr(asked, field.name) for field in fields(Settings)}
    made |= {"degree": int(options.degree), "exposure_degree": options.own_degree}
    made |= {name: getattr(options, name) for name in ("motion", "motion_sigma")}
    made["terms"] = tuple(term.name for term in asked.terms)
    for name in ("clip", "error_floor", "validate", "motion_sigma", "night_sigma", "pixel_scale"):
        made[name] = None if made[name] is None else float(made[name])
    prior = asked.prior
    if isinstance(prior, dict):
        prior = {str(name): None if each is None else each.describe() for name, each in prior.items()}
    elif prior is not None:
        prior = prior.describe()
    return Settings(**made | {"prior": prior, "model": None if form is None else form.describe()})


def _solution(fit, scale, settings, diagnostics, form=None):
    uncertainty, matches = (fit.uncertainty if scale == 1 else fit.uncertainty_at(scale)), fit.matches
    if scale != 1 and matches.camera.has_focal_plane and uncertainty.camera is not None:
        matches = replace(matches, camera=with_errors_times(matches.camera, uncertainty.camera.free, scale))
    solution = assemble(
        matches,
        fit.weighted,
        fit.result.state,
        fit.blocks,
        fit.result.gauge,
        uncertainty,
        settings=settings,
        diagnostics=diagnostics,
        status=fit.result.status,
        dof=fit.dof,
        form=form,
    )
    return solution if fit.tabled is None else fit.tabled.into(solution, scale)
